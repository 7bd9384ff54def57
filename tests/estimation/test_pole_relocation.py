"""Poles from the spectra of a record."""

import numpy as np
import pytest

from ctid_cli.estimation import pole_relocation
from ctid_cli.estimation.pole_relocation import (
    _gain,
    _residual,
    find_poles,
    local_weights,
    relocate,
    residual_weights,
    spectral_lines,
)
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.additive_records import FOUR_MODES, TWO_MODES, coloured_record, open_record


def upper(model):
    """One pole of each pair and the real ones but the origin, slowest first."""
    poles = model.poles
    return sorted((complex(p) for p in poles if p.imag >= 0 and p != 0), key=abs)


def squared_error(lines, poles):
    residual, _ = _residual(lines, poles)
    return float(residual @ residual)


def test_noise_free_poles_come_out_from_a_rough_start():
    # What remains is the output between the samples, which the spectra take as straight lines.
    for interval, tolerance in ((0.05, 1e-3), (0.02, 1e-4)):
        record = open_record(TWO_MODES, int(25 / interval), 0.0, 1, interval=interval)
        lines = spectral_lines(record, 0.0)
        found = relocate(lines, [1.3 * pole for pole in upper(TWO_MODES)], 15)
        np.testing.assert_allclose(found, upper(TWO_MODES), rtol=tolerance)


def test_settled_poles_are_a_minimum_of_the_squared_error(monkeypatch):
    # Instruments without noise: least squares on sigma Y instead of them ends elsewhere.
    monkeypatch.setattr(pole_relocation, "SETTLED", 1e-12)
    lines = spectral_lines(open_record(TWO_MODES, 800, 0.2, 3), 0.0)
    poles = relocate(lines, upper(TWO_MODES), 60)
    least = squared_error(lines, poles)
    for k in range(len(poles)):
        for direction in (1.0, 1j):
            step = 0.01 * abs(poles[k].real) * direction
            above, below = (squared_error(lines, [*poles[:k], poles[k] + s, *poles[k + 1 :]]) for s in (step, -step))
            bending = above + below - 2.0 * least
            assert bending > 0
            assert abs(above - below) < 0.05 * bending


def test_moves_end_at_the_best_poles_on_the_way():
    lines = spectral_lines(open_record(TWO_MODES, 300, 1.0, 5), 0.0)
    errors = []
    for moves in range(8):
        errors.append(squared_error(lines, relocate(lines, [-2 + 12j, -3 + 20j], moves)))
    assert (np.diff(errors) <= 0).all()


def test_gain_is_the_fall_of_the_squared_error():
    lines = spectral_lines(open_record(TWO_MODES, 800, 0.2, 4), 0.0)
    first, second = upper(TWO_MODES)
    for pole in (second, complex(-3.0)):
        residual, known = _residual(lines, [first])
        expected = squared_error(lines, [first]) - squared_error(lines, [first, pole])
        np.testing.assert_allclose(_gain(lines, residual, known, pole), expected, rtol=1e-8)


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_a_weak_mode_is_found_where_the_noise_is_low(seed):
    # With equal weights a line of the strong noise at low frequencies is taken for the fourth mode.
    lines = spectral_lines(coloured_record(seed), 0.0)
    found = find_poles(lines.weighted(local_weights(lines)), 4, 0)
    np.testing.assert_allclose(np.abs(found), np.abs(upper(FOUR_MODES)), rtol=0.1)
    assert not np.allclose(np.abs(find_poles(lines, 4, 0)), np.abs(upper(FOUR_MODES)), rtol=0.1)


def test_both_noise_levels_follow_the_noise():
    lines = spectral_lines(coloured_record(5, 8000), 0.0)
    z = np.exp(1j * 0.05 * lines.frequencies)
    expected = np.abs((z - 0.85) / (z + 0.5))
    local = local_weights(lines)
    for weights in (local, residual_weights(lines.weighted(local), upper(FOUR_MODES))):
        ratio = np.log(weights / expected)
        # Twenty-four real numbers make one level: a standard deviation of 0.14, less where neighbours are medians.
        assert np.std(ratio) < 0.25
        assert np.ptp([np.mean(part) for part in np.array_split(ratio, 4)]) < 0.25


def test_long_records_are_searched_at_their_beginning():
    record = open_record(TWO_MODES, 10_000, 1.0, 10)
    lines = spectral_lines(record, 0.0)
    np.testing.assert_allclose(np.diff(lines.frequencies), 2 * np.pi / record.t[8191], rtol=1e-9)
    # White input and noise: the mode at 2 pi rad/s is the last to stand out, so the upper half of the band goes.
    assert 1.5 * 6.3 < lines.frequencies[-1] < 0.5 * np.pi / 0.05


def test_poles_are_stable_whatever_the_noise():
    record = Record(0.1 * np.arange(60), np.random.default_rng(11).standard_normal(60), HeldSignal([0.0, 2.0], [1, -1]))
    lines = spectral_lines(record, 0.0)
    for reals in (0, 1, 3):
        poles = find_poles(lines, 2, reals)
        assert sum(2 if pole.imag else 1 for pole in poles) == 4 + reals
        assert all(pole.real < 0 <= pole.imag for pole in poles)


def test_too_short_for_any_line():
    t = np.arange(4.0)
    record = Record.from_arrays(t, t, t)
    assert spectral_lines(record, 0.5) is not None
    assert spectral_lines(record, 2.5) is None
