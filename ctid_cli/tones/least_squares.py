"""Least-squares fits of sums of decaying chirps to windows of one length, all windows together."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.tones import constants as c
from ctid_cli.tones.tone_kernels import PARAMETERS, normal_equations

BOUNDS = np.array(c.BOUNDS)


class Fits(NamedTuple):
    """Windows and their tones, modified in place."""

    #: First sample, number of present samples, and number of tones of each window, shape (R,).
    first: IndexArray
    present: IndexArray
    used: IndexArray
    #: Parameters of the tones, shape (R, n, 5), and the constant of each window, shape (R,).
    parameters: Array
    constants: Array
    #: Whether the iterations reached a minimum, shape (R,).
    converged: BoolArray


def fit_windows(samples: Array, length: int, fits: Fits, chosen: IndexArray, most_steps: int) -> None:
    """Fit the tones of the windows ``chosen`` by Levenberg-Marquardt steps; a stage takes at most ``most_steps``."""
    fits.converged[chosen] = False
    chosen = chosen[fits.present[chosen] > PARAMETERS * fits.used[chosen] + 1]
    if not chosen.size:
        return
    first, used, n = fits.first[chosen], fits.used[chosen], fits.used[chosen].max()
    tones, constants = fits.parameters[chosen, :n], fits.constants[chosen]
    equations = list(normal_equations(samples, length, first, used, tones, constants)[:3])
    for stage, steps in c.STAGES:
        damping, taken, done = np.full(chosen.size, c.DAMPING), np.zeros(chosen.size, int), np.zeros(chosen.size, bool)
        while (rows := np.flatnonzero(~done & (taken < min(steps, most_steps)))).size:
            costs, right, gram = (each[rows] for each in equations)
            free = _free_parameters(tones[rows], used[rows], right, stage)
            step = _damped_steps(gram, right, free, damping[rows])
            moved = step[:, 1:].reshape(rows.size, n, PARAMETERS)
            trial = np.clip(tones[rows] + moved, -BOUNDS, BOUNDS)
            moved = np.abs(trial - tones[rows])
            turned = moved[:, :, 2:].max(axis=(1, 2), initial=0.0)
            height = np.hypot(tones[rows, :, 0], tones[rows, :, 1])
            still = (moved[:, :, :2] <= c.SMALL_STEP * height[:, :, None]).all(axis=(1, 2)) & (turned <= c.SMALL_STEP)
            gain = (step * right).sum(axis=1)
            small = (gain <= c.SMALL_GAIN * costs / fits.present[chosen[rows]]) | still
            done[rows] = ((gain >= 0.0) & small) | (damping[rows] > c.MOST_DAMPING)
            tried = ~done[rows] & (turned < c.LONGEST_STEP)
            damping[rows] *= c.RAISED
            if not tried.any():
                continue
            rows, trial, levels = rows[tried], trial[tried], constants[rows[tried]] + step[tried, 0]
            new = normal_equations(samples, length, first[rows], used[rows], trial, levels)
            lower = new[0] <= equations[0][rows]
            rows = rows[lower]
            tones[rows], constants[rows] = trial[lower], levels[lower]
            for values, each in zip(equations, new, strict=False):
                values[rows] = each[lower]
            damping[rows] = np.maximum(damping[rows] * c.LOWERED / c.RAISED, c.LEAST_DAMPING)
            taken[rows] += 1
    fits.parameters[chosen, :n], fits.constants[chosen], fits.converged[chosen] = tones, constants, done


def _free_parameters(tones: Array, used: IndexArray, right: Array, stage: int) -> BoolArray:
    """Return the free parameters of a stage and the constant, except those that a step would move out of bounds."""
    slopes = right[:, 1:].reshape(tones.shape)
    free = (np.abs(tones) < BOUNDS) | (tones * slopes < 0.0)
    free &= (np.arange(PARAMETERS) < stage) & (np.arange(tones.shape[1]) < used[:, None])[:, :, None]
    return np.concatenate((np.ones((used.size, 1), bool), free.reshape(used.size, -1)), axis=1)


def _damped_steps(gram: Array, right: Array, free: BoolArray, damping: Array) -> Array:
    """Solve normal equations scaled to a unit diagonal; the step of a parameter that is not free is zero."""
    matrix, scales = _scaled(gram, free, damping)
    return np.asarray(np.linalg.solve(matrix, np.where(free, right / scales, 0.0)[:, :, None])[:, :, 0] / scales)


def _scaled(gram: Array, free: BoolArray, added: Array) -> tuple[Array, Array]:
    """Return normal matrices of the free parameters with a unit diagonal increased by ``added``, and their scales."""
    squares = np.einsum("rii->ri", gram)
    scales = np.sqrt(np.where(free & (squares > 0.0), squares, 1.0))
    weights = free / scales
    matrix = gram * weights[:, :, None] * weights[:, None, :]
    np.einsum("rii->ri", matrix)[:] = 1.0 + added[:, None]
    return matrix, scales


def covariances_of(gram: Array, used: IndexArray) -> Array:
    """Return the blocks of the inverse normal matrices that belong to one tone each, shape (R, n, 5, 5)."""
    n = gram.shape[1] // PARAMETERS
    free = np.arange(gram.shape[1]) <= PARAMETERS * used[:, None]
    matrix, scales = _scaled(gram, free, np.full(used.size, c.RIDGE))
    inverse = np.linalg.inv(matrix) / (scales[:, :, None] * scales[:, None, :])
    # Tones that depend on each other to rounding have no certain errors.
    inverse[~(np.einsum("rii->ri", inverse) > 0.0).all(axis=1)] = np.nan
    blocks = inverse[:, 1:, 1:].reshape(used.size, n, PARAMETERS, n, PARAMETERS)
    return np.asarray(np.einsum("rkakb->rkab", blocks))
