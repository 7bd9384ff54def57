"""Weights of held steps against 60 digits: one step, and blocks of steps of different lengths."""

import mpmath as mp
import numpy as np
import pytest

from ctid_cli.filtering.kernels import (
    BLOCK,
    CHANGE,
    DECAY_IM,
    DECAY_RE,
    DOUBLE_IM,
    DOUBLE_RE,
    GAP,
    MOST_DOUBLINGS,
    PARTS,
    SINGLE_IM,
    SINGLE_RE,
    VALUE,
    _held_steps,
    step_weights,
)


def exact(pole, step):
    """The weights, each over its own power of the step, from the definitions."""
    with mp.workdps(60):
        x = mp.mpc(pole) * mp.mpf(step)
        decay = mp.exp(x)
        f = (decay - 1 - x) / x**2
        slope = (decay - 1) / x**2 - 2 * f / x
        return [complex(value) for value in (decay, 1 + x * f, f, f + x * slope, slope)]


def in_block(pole, steps):
    """The weights of a block of steps over the powers of each, shape (BLOCK, 5)."""
    found = []
    for value, change in ((1.0, 0.0), (0.0, 1.0)):
        block = np.zeros((PARTS, BLOCK))
        block[GAP], block[VALUE], block[CHANGE] = steps, value, change
        _held_steps(pole, steps.max(), BLOCK, block)
        pairs = ((DECAY_RE, DECAY_IM), (SINGLE_RE, SINGLE_IM), (DOUBLE_RE, DOUBLE_IM))
        found.append([block[re] + 1j * block[im] for re, im in pairs])
    (decay, start, w_start), (_, change, w_change) = found
    return np.array([decay, start / steps, change / steps, w_start / steps**2, w_change / steps**2]).T


LONGEST = [1e-11, 1e-6, 0.03, 0.9, 1.1, 3.0, 9.0, 31.0, 33.0, 1e3, 1e6, 1e8]
DIRECTIONS = [-1.0, 1j, -0.6 + 0.8j, -0.02 + 1j, 0.01 + 1j]


@pytest.mark.parametrize(
    ("direction", "longest"),
    [(direction, longest) for direction in DIRECTIONS for longest in LONGEST if direction.real * longest < 100],
)
def test_weights_are_exact_for_slow_and_for_stiff_poles(direction, longest):
    # Steps that differ a thousandfold share their number of doublings.
    steps = longest * np.geomspace(1e-3, 1, BLOCK)
    expected = np.array([exact(direction, step) for step in steps])
    single = np.array([step_weights(direction, step) for step in steps])
    single = single[:, [0, 2, 3, 4, 5]] / np.stack((steps**0, steps, steps, steps**2, steps**2), axis=1)
    # Where exp(x) turns, what it adds to a weight may cancel; a decay is as good as the 1 from which it comes.
    terms = np.abs(expected[:, :1]) / np.maximum(1.0, steps)[:, None] ** [0, 1, 2, 1, 2]
    size = np.maximum(np.abs(expected), terms)
    size[:, 0] = np.maximum(size[:, 0], 1.0)
    # A doubling squares what came before: it doubles its relative error, and adds a few roundings.
    doublings = np.ceil(np.log2(longest)) if 1.0 < longest <= 2.0**MOST_DOUBLINGS else 0.0
    tolerance = (20 + 6 * 2.0**doublings) * np.finfo(float).eps
    for found in (in_block(direction, steps), single):
        assert (np.abs(found - expected) / size).max() < tolerance
