"""Further minima that are nearly as low as the least one."""

import numpy as np

from ctid_cli import DelayProfile, Record


def test_minima_nearly_as_low_are_reported_and_converged():
    rng = np.random.default_rng(3)
    t, u = 0.2 * np.arange(150), np.repeat(rng.choice([-1.0, 1.0], 30), 5)
    y = np.interp(t - 3.0, t, np.cumsum(u) * 0.05) + rng.standard_normal(150)
    measured = DelayProfile(2, 1, (0.0, 20.0)).prepare(Record.from_arrays(t, u, y)).laid_out
    found = measured.best()
    assert found.others
    for other in found.others:
        assert found.squared_error < other.squared_error <= found.squared_error * (1 + 3 * 3.84 / t.size)
        assert measured.local(other.start).squared_error <= other.squared_error * (1 + 1e-9)
