"""All tones of a record: valid rows are right, whatever else the record contains."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from ctid_cli.errors import DataError
from ctid_cli.frequency.flags import Flag
from ctid_cli.tones.summary import summarise
from ctid_cli.tones.track import track as follow_record

INTERVAL = 0.001
T = INTERVAL * np.arange(4000)
NOISE = 0.01 * np.random.default_rng(2).standard_normal(T.size)
HERTZ = 2.0 * np.pi
TRUE = [0.6, 1.1, 1.9]


def tone(hertz, amplitude=1.0, phase=0.0):
    return amplitude * np.cos(HERTZ * np.cumsum(np.broadcast_to(hertz, T.shape)) * INTERVAL + phase)


def follow_tones(y, interval, tones=None, **options):
    return follow_record(SimpleNamespace(samples=y, interval=interval), tones, **options)


def follow(y, tones=None, **options):
    return follow_tones(y + NOISE, INTERVAL, tones, every=0.02, **options)


def wrong(track, column, truth):
    """Return the valid rows whose errors exceed the accuracy and 3.3 standard errors."""
    off = np.abs(track.omega[:, column] - HERTZ * np.interp(track.t, T, np.broadcast_to(truth, T.shape)))
    limit = np.maximum(3.3 * track.error[:, column], 1e-3 * track.omega[:, column])
    return int((track.valid[:, column] & (off > limit)).sum())


def test_a_steady_tone_is_known_as_well_as_can_be():
    """Cramer-Rao bound of the frequency from a whole record: 24 s^2/(A^2 N^3) [rad/sample]^2."""
    track = follow(tone(60.0, phase=0.4), 1)
    bound = np.sqrt(24.0 * 1e-4 / T.size**3) / INTERVAL
    middle = track.t.size // 2
    assert track.error[middle, 0] == pytest.approx(bound, rel=0.2)
    assert abs(track.omega[middle, 0] - HERTZ * 60.0) < 3.3 * bound
    assert track.amplitudes[middle, 0] == pytest.approx(1.0, abs=2e-3)
    assert np.angle(np.exp(1j * (track.phase[:, 0] - 0.4 - np.pi / 2 - HERTZ * 60.0 * (track.t + INTERVAL)))) == (
        pytest.approx(0.0, abs=0.02)
    )
    assert track.valid.all()


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_the_errors_of_clean_tones_are_those_of_their_scatter(pole):
    """Monte Carlo: three tones of 60 records, median standard errors; the ratio is within the 99.9 % limits of 180."""
    off, errors = np.empty((2, 2, 60, 3))
    rng = np.random.default_rng(12)
    for k in range(60):
        noise = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(700))[200:]
        phase = np.outer(np.arange(500), TRUE) + rng.uniform(0.0, HERTZ, 3)
        found = summarise(follow_tones(np.cos(phase).sum(axis=1) + 0.01 * noise, 1.0, 3, every=12.5))
        off[:, k] = np.transpose(
            [(tone.omega - true, tone.amplitude - 1.0) for tone, true in zip(found, TRUE, strict=True)]
        )
        errors[:, k] = np.transpose([(HERTZ * tone.standard_error_hz, tone.amplitude_error) for tone in found])
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], 180) / 180)
    for scatter in np.sqrt(np.mean((off / np.median(errors, axis=1, keepdims=True)) ** 2, axis=(1, 2))):
        assert low < scatter < high


@pytest.mark.parametrize("other", [53.7, 85.0])
def test_a_weaker_tone_does_not_pull_the_stronger_one(other):
    track = follow(tone(50.0) + tone(other, 0.1), 1)
    assert track.valid.all()
    assert wrong(track, 0, 50.0) == 0
    (line,) = track.missing
    assert line.omega / HERTZ == pytest.approx(other, abs=0.01)
    assert (line.share, line.amplitude) == (1.0, pytest.approx(0.1, rel=0.02))


def test_the_number_of_tones_is_found():
    track = follow(tone(50.0) + tone(53.7, 0.1, 1.0) + tone(200.0, 0.02))
    assert np.median(track.omega, axis=0) / HERTZ == pytest.approx([50.0, 53.7, 200.0], abs=0.01)
    assert track.missing == ()
    assert "Tones: 3, from the record" in track.reasons[0]


@pytest.mark.parametrize("degrees", [10.0, 45.0, 90.0])
def test_no_window_straddles_a_step_of_phase(degrees):
    track = follow(tone(60.0, phase=np.deg2rad(degrees) * (T > 1.7)), 1)
    assert wrong(track, 0, 60.0) == 0
    assert track.valid.mean() > 0.9
    assert not track.valid[np.abs(track.t - 1.7) < 0.004].any()


def test_a_tone_keeps_its_column_over_a_step_of_frequency():
    hertz = np.where(T < 2.2, 60.0, 63.0)
    track = follow(tone(hertz) + tone(30.0, 0.5), 2)
    assert wrong(track, 1, hertz) == wrong(track, 0, 30.0) == 0
    assert track.valid.mean() > 0.9
    assert np.nanmax(np.abs(track.omega[:, 0] - HERTZ * 30.0)) < 0.5


@pytest.mark.parametrize(
    "hertz", [60.0 + 2.0 * T, 100.0 * (1.0 + 0.02 * np.sin(HERTZ * 0.5 * T))], ids=["chirp", "vibrato"]
)
def test_a_tone_that_moves_is_followed(hertz):
    track = follow(tone(hertz), 1)
    assert wrong(track, 0, hertz) <= 0.01 * track.t.size
    assert track.valid.mean() > 0.9


@pytest.mark.parametrize("tones", [1, None])
@pytest.mark.parametrize(
    ("deviation", "rate"),
    [
        (2.5, 0.5),
        pytest.param(5.0, 1.0, marks=pytest.mark.slow),
        (2.5, 2.0),
        pytest.param(20.0, 0.5, marks=pytest.mark.slow),
    ],
)
def test_a_tone_whose_frequency_swings_is_not_the_lines_that_it_makes(deviation, rate, tones):
    """At 2.5 Hz and .5 Hz, 13 lines exceed a tenth of the tone; at 20 Hz, more lines than a window resolves."""
    t = INTERVAL * np.arange(10_000)
    hertz = 100.0 + deviation * np.sin(HERTZ * rate * t)
    y = np.sin(HERTZ * 100.0 * t - deviation / rate * np.cos(HERTZ * rate * t))
    y += 0.01 * np.random.default_rng(3).standard_normal(t.size)
    track = follow_tones(y, INTERVAL, tones, every=0.02)
    off = np.abs(track.omega / HERTZ - np.interp(track.t, t, hertz)[:, None])
    bad = track.valid & (off > 3.3 * track.error / HERTZ) & (off > 0.1)
    assert track.omega.shape[1] == 1
    assert track.valid.mean() > 0.4
    assert bad.sum() <= 0.02 * track.valid.sum()


def test_three_tones_that_short_windows_tell_apart_are_no_comb():
    track = follow(tone(60.0) + tone(90.0, 0.8, 1.0) + tone(120.0, 0.5, 2.0))
    assert [wrong(track, k, 60.0 + 30.0 * k) for k in range(3)] == [0, 0, 0]
    assert track.valid.mean() > 0.95


def test_crossing_tones_keep_their_columns():
    up, down = 60.0 + 10.0 * T, 100.0 - 10.0 * T
    track = follow(tone(up) + tone(down, 0.5, 1.0), 2)
    assert (track.valid.mean(axis=0) > 0.9).all()
    rising = int(np.nanmean(track.rate[:, 0]) < np.nanmean(track.rate[:, 1]))
    assert wrong(track, rising, up) + wrong(track, 1 - rising, down) == 0
    sure = track.valid[:, rising]
    assert track.rate[sure, rising] / HERTZ == pytest.approx(10.0, abs=0.5)


def test_a_decaying_tone_is_valid_as_long_as_it_is_heard():
    track = follow(np.exp(-T / 0.5) * tone(82.0), 1)
    assert wrong(track, 0, 82.0) == 0
    assert track.valid[track.t < 1.5].mean() > 0.95
    assert not track.valid[track.t > 3.5].any()
    assert np.nanmedian(track.growth) == pytest.approx(-2.0, rel=0.05)


def test_a_decay_in_two_stages_is_one_tone_for_each_harmonic():
    """A least-squares fit that adds every line of the residual divides each into several."""
    envelope = 0.7 * np.exp(-T / 0.2) + 0.3 * np.exp(-T / 1.6)
    track = follow(10.0 * envelope * (tone(60.0) + tone(120.0, 0.5, 1.0) + tone(180.0, 0.3, 2.0)))
    assert [wrong(track, k, 60.0 * (k + 1)) for k in range(track.omega.shape[1])] == [0, 0, 0]
    assert track.valid.mean() > 0.9


def test_a_spike_spoils_no_valid_row():
    y = tone(60.0)
    y[2000] += 1e6
    track = follow(y, 1)
    assert wrong(track, 0, 60.0) == 0
    assert track.valid.mean() > 0.95
    assert any("Spikes" in reason for reason in track.reasons)


def test_a_gap_is_flagged_and_no_more_than_the_gap():
    y = tone(60.0)
    y[1500:2000] = np.nan
    track = follow(y, 1)
    inside = (track.t > 1.52) & (track.t < 1.98)
    assert (track.flags[inside, 0] & Flag.GAP).all()
    assert track.valid[(track.t < 1.49) | (track.t > 2.01)].all()


def test_noise_alone_has_no_tone():
    rng = np.random.default_rng(5)
    for _ in range(5):
        with pytest.raises(DataError, match="no tone stands out"):
            follow_tones(rng.standard_normal(2000), INTERVAL)
    track = follow_tones(rng.standard_normal(2000), INTERVAL, 1)
    assert (track.flags == Flag.ABSENT).all()
    assert "No tone stands out" in track.warnings[0]


def test_units_only_scale():
    y = tone(50.0) + tone(80.0, 0.3) + NOISE
    one = follow_tones(y, INTERVAL, 2)
    other = follow_tones(1e6 * y, 1e3 * INTERVAL, 2)
    assert other.omega == pytest.approx(one.omega / 1e3, rel=1e-9)
    assert other.amplitudes == pytest.approx(1e6 * one.amplitudes, rel=1e-9)


def test_a_long_record_is_thinned_and_its_amplitudes_are_of_before():
    t = np.arange(200_000) / 48_000.0
    y = np.sin(HERTZ * 440.0 * t) + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    track = follow_tones(y, 1 / 48_000.0, 1)
    assert "samples is kept" in " ".join(track.reasons)
    assert track.valid.all()
    middle = track.t.size // 2
    assert abs(track.omega[middle, 0] / HERTZ - 440.0) < 1e-3
    assert track.amplitudes[middle, 0] == pytest.approx(1.0, abs=1e-3)
    assert np.angle(np.exp(1j * (track.phase[:, 0] - HERTZ * 440.0 * track.t))) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("length", "window"), [(20, None), (1000, 0.01), (1000, 3.0)])
def test_what_cannot_be_followed(length, window):
    with pytest.raises(DataError, match=r"too few|longest window must be"):
        follow_tones((tone(60.0) + NOISE)[:length], INTERVAL, 1, window=window)


def test_the_track_does_not_depend_on_blocks(monkeypatch):
    rng = np.random.default_rng(5)
    y = np.cos(0.3 * np.arange(6000)) + 0.2 * np.cos(0.9 * np.arange(6000) + 2e-6 * np.arange(6000) ** 2)
    y += 0.05 * rng.standard_normal(6000)
    y[3000:3040] = np.nan
    tracks = []
    for block in (2**17, 2**12):
        monkeypatch.setattr("ctid_cli.tones.constants.BLOCK_SAMPLES", block)
        tracks.append(follow_tones(y, 1.0))
    for name in ("omega", "error", "amplitudes", "phase"):
        np.testing.assert_allclose(getattr(tracks[0], name), getattr(tracks[1], name), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(tracks[0].flags, tracks[1].flags)
