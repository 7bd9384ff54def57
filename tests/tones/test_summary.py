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
    """Full-length windows in all rows: the mean is as good as one row; disjoint windows: as sqrt(N) rows."""
    error = np.full((ROWS, 2), 2 * np.pi * 0.01)
    one = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.1 * ROWS)))
    assert [tone.standard_error_hz for tone in one] == pytest.approx([0.01, 0.01])
    apart = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.05)))
    assert apart[0].standard_error_hz == pytest.approx(0.01 / np.sqrt(ROWS))
    # Half of each window is shared with each neighbour: the variance of the mean is twice as large.
    half = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.2)))
    assert half[1].standard_error_hz == pytest.approx(0.01 * np.sqrt(2 / ROWS))
    assert np.isnan(summarise(make_track())[0].standard_error_hz)


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
