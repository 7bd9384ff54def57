"""Distances of an estimated model from the system, relative to the system [-]; infinite for an unstable model."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.models.transfer_function import TransferFunction, sorted_roots

#: Number of grid frequencies for the largest error, and factor of the grid beyond the slowest and the fastest pole.
POINTS, BEYOND = 400, 100.0


def h2_distance(system: TransferFunction, model: TransferFunction) -> float:
    r"""Return the error in the H2 norm (the L2 norm of the impulse response error), delays included.

    .. math:: \|G - \hat G\|^2 = \|G\|^2 + \|\hat G\|^2 - 2 \int_0^\infty g(t) \hat g(t) \, dt
    """
    if not model.is_stable or model.relative_degree < 1:
        return math.inf
    energy = _square(system)
    # Accurate to 1e-8: the squares of smaller errors are lost in the rounding of the sum.
    return math.sqrt(max(energy + _product(model, model) - 2 * _product(system, model), 0.0) / energy)


@lru_cache(maxsize=16)
def _square(system: TransferFunction) -> float:
    """Return the squared norm of the system, cached because all estimates of a system need it."""
    return _product(system, system)


def _product(one: TransferFunction, other: TransferFunction) -> float:
    r"""Return the integral of the product of two impulse responses.

    It starts at the larger delay: ``c1 exp(A1 d) X c2'`` with ``A1 X + X A2' = -b1 b2'`` and the difference d of the
    delays.
    """
    from scipy.linalg import companion, expm  # slow to import

    if one.delay > other.delay:
        one, other = other, one
    n, m = one.order, other.order
    A1, A2 = companion(one.denominator), companion(other.denominator)
    c1, c2 = (np.pad(model.numerator, (model.relative_degree - 1, 0)) for model in (one, other))
    # Both inputs enter the first state. Orders are small: solving one linear system takes less time than the
    # decompositions of a Lyapunov solver.
    X = np.linalg.solve(np.kron(A1, np.eye(m)) + np.kron(np.eye(n), A2), -np.eye(n * m, 1)).reshape(n, m)
    return float(c1 @ expm(A1 * (other.delay - one.delay)) @ X @ c2)


def hinf_distance(system: TransferFunction, model: TransferFunction) -> float:
    """Return the largest error of the frequency response over the largest gain, on a dense grid of frequencies."""
    poles = model.poles
    if not (poles.real < 0).all():
        return math.inf
    # The grid is too coarse for resonances: add their frequencies.
    frequencies = np.concatenate([_grid(system), np.abs(poles.imag), np.abs(poles)])
    gain = system.frequency_response(frequencies)
    return float(np.abs(model.frequency_response(frequencies) - gain).max() / np.abs(gain).max())


@lru_cache(maxsize=16)
def _grid(system: TransferFunction) -> Array:
    """Return frequencies from far below the slowest pole to far above the fastest, including the resonances."""
    poles, sizes = system.poles, np.abs(system.poles)
    grid = np.geomspace(sizes.min() / BEYOND, sizes.max() * BEYOND, POINTS)
    return np.concatenate([[0.0], grid, np.abs(poles.imag)])


def response_distance(system: TransferFunction, model: TransferFunction, frequency: ArrayLike) -> float:
    """Return the error of the frequency response at one frequency [rad/s] over the gain there."""
    gain = system.frequency_response(frequency)
    return float(np.abs(model.frequency_response(frequency) - gain) / np.abs(gain))


def matched_poles(true: ComplexArray, denominator: Sequence[float] | None) -> ComplexArray:
    """Return the poles of a model matched to the true ones with the least sum of distances.

    All are NaN without a model or with a different number of poles.
    """
    from scipy.optimize import linear_sum_assignment

    if denominator is None or len(denominator) != true.size + 1:
        return np.full(true.size, complex(np.nan, np.nan))
    found = sorted_roots(np.array(denominator))
    order = linear_sum_assignment(np.abs(true[:, None] - found))[1]
    return np.asarray(found[order])
