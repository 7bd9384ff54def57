"""Tones over their valid rows, with the standard errors of their means."""

import numpy as np
import pytest

from ctid_cli.frequency.flags import Flag
from ctid_cli.tones.summary import summarise
from tests.tones.made_tracks import HERTZ, ROWS, coming_later, make_track, some_invalid


def test_a_summary_is_over_valid_rows():
    first, second = summarise(make_track(some_invalid()))
    assert first.frequency_hz == pytest.approx(np.median(HERTZ[12:, 0]))
    assert first.omega == pytest.approx(2 * np.pi * first.frequency_hz)
    low, high = np.percentile(HERTZ[12:, 0], [16, 84])
    assert first.spread_hz == pytest.approx((high - low) / 2)
    assert (second.frequency_hz, second.spread_hz, second.amplitude) == (pytest.approx(30.0), 0.0, 0.5)
    assert first.valid_percent == pytest.approx(70.0)
    _, later = summarise(coming_later())
    assert (later.valid_percent, later.begins, later.ends) == (75.0, pytest.approx(2.0), pytest.approx(3.9))


def test_the_error_of_the_mean_counts_common_samples_once():
    """The mean of a window is its middle; disjoint windows are independent; half-overlapping ones are correlated.

    Weights of the samples: P1 for a frequency, with products of -1/4 over half a window, and P0 for an amplitude, 1/2.
    """
    t = 0.1 * np.arange(ROWS)[:, None]
    ones, centre = np.ones((ROWS, 2)), 0.5 * t[-1]

    def errors(window, middle, at=ones):
        known = {"error": 2 * np.pi * 0.01 * at, "amplitude_error": 0.02 * at}
        one, _ = summarise(make_track(**known, window=window * ones, middle=middle * ones))
        return one.standard_error_hz, one.amplitude_error

    # In units of half the window, the variance of a frequency is 1 + 15 u^2, and the middle is not among the rows.
    u = (t - centre) / (0.05 * ROWS)
    steep = np.sqrt((1 + 15 * u**2) / (1 + 15 * (u**2).min())) * ones
    assert errors(0.1 * ROWS, centre, steep) == pytest.approx([0.01, 0.02])
    assert errors(0.05, t) == pytest.approx([0.01 / np.sqrt(ROWS), 0.02 / np.sqrt(ROWS)])
    assert errors(0.2, t)[0] == pytest.approx(0.01 * np.sqrt(ROWS - 0.5 * (ROWS - 1)) / ROWS, rel=0.02)
    assert errors(0.2, t)[1] == pytest.approx(0.02 * np.sqrt(ROWS + (ROWS - 1)) / ROWS)
    # The mean of rows on one side of the middle is as uncertain as the value half-way between the first and the last.
    u = t / (0.1 * ROWS)
    one_side = errors(0.2 * ROWS, t[0], np.sqrt(1 + 15 * u**2) * ones)
    assert one_side[0] == pytest.approx(0.01 * np.sqrt(1 + 15 * u.mean() ** 2))
    assert np.isnan(summarise(make_track(error=0.01 * ones))[0].standard_error_hz)


@pytest.mark.parametrize(("accuracy", "bad"), [(None, [0, 1]), (0.011, [0, 0]), (0.005, [1, 1])])
def test_a_row_whose_standard_error_is_too_large_is_not_valid(accuracy, bad):
    hertz = np.full((ROWS, 2), 0.01)
    hertz[:, 1] = 0.031 if accuracy is None else 0.01
    track = make_track(error=2 * np.pi * hertz).of_accuracy(accuracy)
    late = slice(25, None)  # the first tone is above 10 Hz there
    assert (~track.valid[late]).mean(axis=0).tolist() == bad
    assert (track.flags[late] & int(Flag.INACCURATE) > 0).mean(axis=0).tolist() == bad
    assert track.of_accuracy(1.0).valid.all()
    assert make_track().of_accuracy(accuracy).valid.all()  # nothing is known to be too large
