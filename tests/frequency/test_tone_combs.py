"""Combs: lines at equal distances, with or without some between them, and no others."""

import numpy as np
import pytest

from ctid_cli.frequency.tone_combs import find_combs, refute


def combs_of(omega, error=1e-5):
    """Distances and bands that are found in one window."""
    row = np.array([omega], dtype=float)
    gap, low, high = np.zeros((3, *row.shape))
    find_combs(row, np.argsort(row, axis=1), np.where(np.isnan(row), np.nan, error), gap, low, high)
    return gap[0], low[0], high[0]


@pytest.mark.parametrize("places", [[0, 1, 2], [2, 0, 1], [0, 1, 2, 4, 5], [0, 1, 3, 20, 21, 29, 33, 40]])
def test_lines_at_multiples_of_a_distance_are_a_comb(places):
    omega = 0.6 + 0.01 * np.array(places)
    gap, low, high = combs_of([*omega, np.nan])
    assert gap[:-1] == pytest.approx(0.01)
    assert gap[-1] == 0.0
    assert (low[0], high[0]) == pytest.approx((0.57, omega.max() + 0.03))


@pytest.mark.parametrize(
    "omega",
    [[0.6], [0.6, 0.61], [0.6, 0.61, 0.63], [0.6, 0.61, 0.62 + 0.0012], [0.6, 0.61, 0.64, 0.65], [0.6, 0.6, 0.7]],
)
def test_other_lines_are_none(omega):
    assert not combs_of(omega)[0].any()


def test_a_line_far_away_belongs_to_no_comb():
    gap, _, _ = combs_of([0.6, 0.61, 0.62, 1.3])
    assert gap.tolist() == pytest.approx([0.01, 0.01, 0.01, 0.0])


def test_a_line_is_refuted_by_a_shorter_window_whose_tone_is_elsewhere():
    omega = np.array([0.600, 0.610, 0.620, 0.6151, 0.6151])
    window = np.array([4096, 4096, 4096, 256, 2048])
    gap = np.array([0.01, 0.01, 0.01, 0.0, 0.0])
    low, high = np.where(gap > 0.0, 0.57, 0.0), np.where(gap > 0.0, 0.65, 0.0)
    refuted = np.zeros(5, np.bool_)
    refute(omega, np.array([1e-5] * 3 + [2e-3, 1e-5]), window, gap, low, high, np.array([0, 5]), refuted)
    # Of 256 samples the error is too large for two of them; 2048 samples would tell the lines apart.
    assert refuted.tolist() == [True, False, False, False, False]
