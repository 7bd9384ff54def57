r"""From a sum of submodels to one fraction and back, with the derivatives that carry a covariance along.

A fraction with the distinct poles ``p_k``, l of its poles at the origin, and the residues ``r_k`` is

.. math:: G(s) = d + \sum_{j<l} c_j s^{j-l} + \sum_k \frac{g_k}{1 + T_k s}, \qquad T_k = -1/p_k, \quad g_k = -r_k/p_k.

A submodel collects some of these terms over their common denominator, whose constant term then is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel, Term, pole_text, same_pole
from ctid_cli.models.transfer_function import TransferFunction, sorted_roots

Number = TypeVar("Number", np.float64, np.complex128)


class FactoringError(DataError):
    """A transfer function that is no sum of submodels of the structure asked for, and why."""


def unfactored(model: AdditiveModel) -> TransferFunction:
    r"""The sum of all submodels over their common denominator."""
    numerator, denominator = _joined(model.submodels)
    return TransferFunction(numerator[::-1], denominator[::-1], model.delay)


def unfactored_jacobian(model: AdditiveModel) -> Array:
    r"""Derivatives of the coefficients of :func:`unfactored` with respect to the parameters of the sum.

    With ``Q_i`` and ``R_i`` the denominator and numerator of the sum of all other submodels, the fraction
    ``(B_i Q_i + p^l A_i R_i) / (p^l A_i Q_i)`` is linear in the coefficients of ``A_i`` and ``B_i``; making it monic
    adds the quotient rule.
    """
    numerator, denominator = _joined(model.submodels)
    n = model.order
    columns_b, columns_a = [], []
    for i, submodel in enumerate(model.submodels):
        R, Q = _joined(model.submodels[:i] + model.submodels[i + 1 :])
        term = submodel.term()
        for k in range(1, term.poles + 1):
            columns_b.append(_shifted(R, term.integrators + k, n + 1))
            columns_a.append(_shifted(Q, term.integrators + k, n + 1))
        for k in range(term.zeros + 1):
            columns_b.append(_shifted(Q, k, n + 1))
            columns_a.append(np.zeros(n + 1))
    leading = denominator[n]
    from_a, from_b = np.array(columns_a).T, np.array(columns_b).T
    jacobian_a = (from_a - np.outer(denominator, from_a[n]) / leading) / leading
    jacobian_b = (from_b - np.outer(numerator, from_a[n]) / leading) / leading
    length = n + 1 if any(submodel.relative_degree == 0 for submodel in model.submodels) else n
    return np.concatenate((jacobian_a[:n][::-1], jacobian_b[:length][::-1]))


def factored(model: TransferFunction, terms: Sequence[Term] | None = None) -> AdditiveModel:
    r"""Partial fractions of a transfer function, collected into submodels."""
    fractions = _partial_fractions(model)
    submodels = []
    for group in _groups(fractions, terms):
        a, b, _, _ = _collected(fractions, group)
        submodels.append(Submodel(b[::-1], a[::-1], group.integrators))
    return AdditiveModel(submodels, model.delay)


def factored_jacobian(model: TransferFunction, terms: Sequence[Term] | None = None) -> Array:
    r"""Derivatives of the parameters of :func:`factored` with respect to the coefficients of the transfer function.

    From ``A(p) = 0`` and ``r = B(p)/A'(p)``,

    .. math:: dp = -\frac{dA(p)}{A'(p)}, \qquad
              dr = \frac{dB(p) + B'(p)\,dp - r\,(dA'(p) + A''(p)\,dp)}{A'(p)},

    and ``A''(p_k)/A'(p_k)`` is twice the sum of ``1/(p_k - p_j)`` over the other poles.
    """
    fractions = _partial_fractions(model)
    rows = []
    for group in _groups(fractions, terms):
        _, _, from_a, from_b = _collected(fractions, group)
        rows += [from_a[1:], from_b]
    return np.concatenate(rows)


def pole_jacobian(denominator: ArrayLike, poles: ArrayLike) -> ComplexArray:
    """Derivatives of the poles with respect to the denominator coefficients: ``dp/da_i = -p^(n-i) / A'(p)``."""
    a = np.asarray(denominator, dtype=float)
    p = np.asarray(poles, dtype=complex)
    n = a.size - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian: ComplexArray = -(p[:, None] ** np.arange(n - 1, -1, -1)) / _slope_at_roots(p)[:, None]
    return jacobian


def _slope_at_roots(p: ComplexArray) -> ComplexArray:
    """``A'(p_k)`` of a monic polynomial: a product over the other roots is exact where the polynomial would cancel."""
    distances = p[:, None] - p[None, :]
    np.fill_diagonal(distances, 1.0)
    return np.asarray(np.prod(distances, axis=1))


def _shifted(polynomial: NDArray[Number], places: int, length: int) -> NDArray[Number]:
    """Coefficients in rising powers times ``p^places``, at a given length."""
    result = np.zeros(length, dtype=polynomial.dtype)
    result[places : places + polynomial.size] = polynomial
    return result


def _joined(submodels: Sequence[Submodel]) -> tuple[Array, Array]:
    """Numerator and denominator of a sum in rising powers, both of length order + 1 and not scaled."""
    numerator, denominator = np.zeros(1), np.ones(1)
    for submodel in submodels:
        a = _shifted(submodel.denominator[::-1], submodel.integrators, submodel.order + 1)
        b = _shifted(submodel.numerator[::-1], 0, submodel.order + 1)
        numerator = np.convolve(numerator, a) + np.convolve(denominator, b)
        denominator = np.convolve(denominator, a)
    return numerator, denominator


@dataclass(frozen=True)
class _PartialFractions:
    """The terms of the sum at the head of this file, each with its derivatives by ``a_1 … a_n, b_0 … b_m``.

    Complex pairs come first, at places k and ``pairs + k``, then real poles; both kinds from the slowest on.
    """

    pairs: int
    poles: ComplexArray
    gains: ComplexArray
    at_origin: Array
    direct: Array  # one value, or none if the model is strictly proper
    poles_slope: ComplexArray
    gains_slope: ComplexArray
    at_origin_slope: Array
    direct_slope: Array


@dataclass(frozen=True)
class _Group:
    """Terms that one submodel collects: places of its poles, integrators, and whether it takes the feedthrough."""

    places: tuple[int, ...]
    integrators: int = 0
    direct: bool = False


def _partial_fractions(model: TransferFunction) -> _PartialFractions:
    if model.relative_degree < 0:
        raise FactoringError("a model with more zeros than poles is no sum of submodels")
    n, m = model.order, model.numerator.size - 1
    a, b = model.denominator, model.numerator
    away = np.trim_zeros(a, "b")
    origin = a.size - away.size
    pairs, p = _poles(away)
    close = same_pole(p[:, None], p) & ~np.eye(p.size, dtype=bool)
    if close.any():
        place = pole_text(complex(p[np.argmax(close.any(axis=1))]))
        raise FactoringError(
            f"the pole {place} is repeated: partial fractions over distinct poles do not exist. A model with fewer "
            "poles may do."
        )
    slope = p**origin * _slope_at_roots(p)
    residues = np.polyval(b, p) / slope
    bending = 2 * (1.0 / (p[:, None] - p + np.eye(p.size)) - np.eye(p.size)).sum(axis=1) + 2 * origin / p
    # Derivatives: columns a_1 … a_n (those of the origin's zero coefficients stay zero), then b_0 … b_m.
    moved_p = np.zeros((p.size, n + m + 1), dtype=complex)
    moved_p[:, : p.size] = pole_jacobian(away, p)
    moved_r = (np.polyval(np.polyder(b), p) / slope - residues * bending)[:, None] * moved_p
    powers = np.arange(n - 1, origin - 1, -1)
    moved_r[:, : p.size] -= (residues / slope)[:, None] * powers * p[:, None] ** np.maximum(powers - 1, 0)
    moved_r[:, n:] += p[:, None] ** np.arange(m, -1, -1) / slope[:, None]

    at_origin, moved_origin = _powers_at_origin(b, away, origin)
    direct = b[:1] if model.relative_degree == 0 else b[:0]
    moved_direct = np.zeros((direct.size, n + m + 1))
    moved_direct[:, n] = 1.0
    return _PartialFractions(
        pairs,
        p,
        -residues / p,
        at_origin,
        direct,
        moved_p,
        -moved_r / p[:, None] + (residues / p**2)[:, None] * moved_p,
        moved_origin,
        moved_direct,
    )


def _poles(a: Array) -> tuple[int, ComplexArray]:
    """Number of complex pairs, and the roots as :class:`_PartialFractions` orders them."""
    roots = sorted_roots(a)[::-1]
    upper = roots[roots.imag > 0]
    return upper.size, np.concatenate((upper, upper.conj(), roots[roots.imag == 0]))


def _powers_at_origin(b: Array, away: Array, origin: int) -> tuple[Array, Array]:
    """``c_0 … c_(l-1)``, the power series of ``s^l G(s)`` at the origin, and their derivatives."""
    poles = away.size - 1
    moved = np.zeros((origin, poles + origin + b.size))
    if not origin:
        return np.zeros(0), moved
    inverse = np.zeros(origin)
    remainder = np.eye(1, origin)[0]
    for k in range(origin):
        inverse[k] = remainder[k] / away[-1]
        covered = away[::-1][: origin - k]
        remainder[k : k + covered.size] -= inverse[k] * covered
    series = np.convolve(inverse, b[::-1])[:origin]
    quotient = np.convolve(inverse, series)
    for i in range(poles):
        moved[:, i] = -_shifted(quotient, poles - 1 - i, poles + quotient.size)[:origin]
    for j in range(b.size):
        moved[:, poles + origin + j] = _shifted(inverse, b.size - 1 - j, b.size + origin)[:origin]
    return series, moved


def _groups(fractions: _PartialFractions, terms: Sequence[Term] | None) -> list[_Group]:
    """Which terms of the sum form a submodel, in order of rising natural frequency."""
    pairs, integrators = fractions.pairs, fractions.at_origin.size
    real = range(2 * pairs, fractions.poles.size)
    if terms is None:
        groups = [_Group((k, pairs + k)) for k in range(pairs)] + [_Group((k,)) for k in real]
        if integrators:
            groups.append(_Group((), integrators))
        if fractions.direct.size:
            groups.append(_Group((), 0, True))
    else:
        groups = _groups_of_terms(fractions, terms)

    def natural_frequency(group: _Group) -> float:
        return 0.0 if group.integrators else min((abs(fractions.poles[k]) for k in group.places), default=np.inf)

    return sorted(groups, key=natural_frequency)


def _groups_of_terms(fractions: _PartialFractions, terms: Sequence[Term]) -> list[_Group]:
    pairs, n, integrators = fractions.pairs, fractions.poles.size, fractions.at_origin.size
    asked = sum(term.poles for term in terms), sorted(term.integrators for term in terms if term.integrators)
    if asked != (n, [integrators] * (integrators > 0)):
        raise FactoringError(
            f"the terms have {asked[0]} poles and {sum(asked[1])} integrators, the latter in {len(asked[1])} of them; "
            f"the model has {n} poles and {integrators} at the origin, which one term must take together"
        )
    room = sum(term.poles // 2 for term in terms)
    if pairs > room:
        raise FactoringError(
            f"the model has {pairs} complex pairs of poles, and the terms have room for {room}; let more terms have "
            "two poles"
        )
    places: list[list[int]] = [[] for _ in terms]
    waiting = list(range(pairs))
    for taken, term in zip(places, terms, strict=True):
        while waiting and term.poles - len(taken) >= 2:
            k = waiting.pop(0)
            taken += [k, pairs + k]
    waiting = list(range(2 * pairs, n))
    for taken, term in zip(places, terms, strict=True):
        while len(taken) < term.poles:
            taken.append(waiting.pop(0))
    biproper = [term.zeros == term.order for term in terms]
    if fractions.direct.size and sum(biproper) != 1:
        raise FactoringError(
            "the model has as many zeros as poles: exactly one term must have as many zeros as poles, to take its "
            f"direct feedthrough; {sum(biproper)} of the terms have"
        )
    return [
        _Group(tuple(taken), term.integrators, bool(fractions.direct.size) and direct)
        for taken, term, direct in zip(places, terms, biproper, strict=True)
    ]


def _collected(fractions: _PartialFractions, group: _Group) -> tuple[Array, Array, Array, Array]:
    """Denominator and numerator of one submodel, constant term first, and their derivatives, one row each."""
    places, shift = list(group.places), group.integrators
    p, g = fractions.poles[places], fractions.gains[places]
    T = -1.0 / p
    moved_T = fractions.poles_slope[places] / p[:, None] ** 2
    moved_g = fractions.gains_slope[places]
    size = T.size + shift + 1

    def product(*left_out: int) -> ComplexArray:
        result = np.ones(1, dtype=complex)
        for k in range(T.size):
            if k not in left_out:
                result = np.convolve(result, [1.0, T[k]])
        return result

    a = product()
    b = np.zeros(size, dtype=complex)
    moved_a = np.zeros((size, moved_g.shape[1]), dtype=complex)
    moved_b = np.zeros_like(moved_a)
    for k in range(T.size):
        rest = product(k)
        b += g[k] * _shifted(rest, shift, size)
        moved_a += np.outer(_shifted(rest, 1, size), moved_T[k])
        moved_b += np.outer(_shifted(rest, shift, size), moved_g[k])
        for j in range(T.size):
            if j != k:
                moved_b += g[k] * np.outer(_shifted(product(k, j), shift + 1, size), moved_T[j])
    # What multiplies the whole denominator: the powers of 1/s and the direct feedthrough.
    whole = [(fractions.at_origin[j], fractions.at_origin_slope[j], j) for j in range(shift)]
    if group.direct:
        whole.append((fractions.direct[0], fractions.direct_slope[0], shift))
    for value, slope, places_up in whole:
        b += value * _shifted(a, places_up, size)
        moved_b += np.outer(_shifted(a, places_up, size), slope)
        moved_b[places_up:] += value * moved_a[: size - places_up]
    length = size if group.direct else size - 1
    return a.real, b.real[:length], moved_a.real[: T.size + 1], moved_b.real[:length]
