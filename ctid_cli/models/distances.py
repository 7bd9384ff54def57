"""How far an estimated model is from the system, relative to the system itself [-]; infinite for an unstable model."""

import math

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.models.transfer_function import TransferFunction

#: Frequencies at which the largest error is looked for, and how far they go beyond the slowest and the fastest pole.
POINTS, BEYOND = 400, 100.0


def h2_distance(system: TransferFunction, model: TransferFunction) -> float:
    r"""The error in the H2 norm, which is that of the impulse response too, delays included.

    .. math:: \|G - \hat G\|^2 = \|G\|^2 + \|\hat G\|^2 - 2 \int_0^\infty g(t) \hat g(t) \, dt
    """
    if not model.is_stable or model.relative_degree < 1:
        return math.inf
    own = _product(system, system)
    # To the eighth digit: the squares of smaller errors are lost in the rounding of the sum.
    return math.sqrt(max(own + _product(model, model) - 2 * _product(system, model), 0.0) / own)


def _product(one: TransferFunction, other: TransferFunction) -> float:
    r"""Integral of the product of two impulse responses.

    It begins with the later one: ``c1 exp(A1 d) X c2'`` with ``A1 X + X A2' = -b1 b2'`` and the difference d of the
    delays.
    """
    from scipy.linalg import expm, solve_sylvester

    if one.delay > other.delay:
        one, other = other, one
    (A1, b1, c1), (A2, b2, c2) = _realised(one), _realised(other)
    X = solve_sylvester(A1, A2.T, -np.outer(b1, b2))
    return float(c1 @ expm(A1 * (other.delay - one.delay)) @ X @ c2)


def _realised(model: TransferFunction) -> tuple[Array, Array, Array]:
    """Controllable canonical form."""
    n = model.order
    A = np.eye(n, k=-1)
    A[0] = -model.denominator[1:]
    c = np.concatenate([np.zeros(n - model.numerator.size), model.numerator])
    return A, np.eye(n)[0], c


def hinf_distance(system: TransferFunction, model: TransferFunction) -> float:
    """The largest error of the frequency response over the largest gain, on a dense grid of frequencies."""
    if not model.is_stable:
        return math.inf
    poles = np.concatenate([system.poles, model.poles])
    sizes = np.abs(poles)
    grid = np.geomspace(sizes.min() / BEYOND, sizes.max() * BEYOND, POINTS)
    # Resonances are narrower than the grid.
    frequencies = np.concatenate([[0.0], grid, np.abs(poles.imag)])
    gain = system.frequency_response(frequencies)
    return float(np.abs(model.frequency_response(frequencies) - gain).max() / np.abs(gain).max())


def response_distance(system: TransferFunction, model: TransferFunction, frequency: ArrayLike) -> float:
    """The error of the frequency response at one frequency [rad/s] over the gain there."""
    gain = system.frequency_response(frequency)
    return float(np.abs(model.frequency_response(frequency) - gain) / np.abs(gain))
