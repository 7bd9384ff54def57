r"""Conversion of a sum of submodels to one fraction and back, with the Jacobians that transform a covariance.

A fraction with distinct poles ``p_k``, l further poles at the origin, and residues ``r_k`` is

.. math:: G(s) = d + \sum_{j<l} c_j s^{j-l} + \sum_k \frac{g_k}{1 + T_k s}, \qquad T_k = -1/p_k, \quad g_k = -r_k/p_k.

A submodel is a group of these terms over their common denominator, whose constant term then is 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.polynomial.polynomial import polyfromroots
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel, Term, pole_text, same_pole
from ctid_cli.models.transfer_function import TransferFunction, sorted_roots

#: Ratio of two real poles up to which they are in one section.
CLOSE = 2.0
Number = TypeVar("Number", np.float64, np.complex128)


def unfactored(model: AdditiveModel) -> TransferFunction:
    r"""Return the sum of all submodels over their common denominator."""
    numerator, denominator = _joined(model.submodels)
    return TransferFunction(numerator[::-1], denominator[::-1], model.delay)


def unfactored_jacobian(model: AdditiveModel, zeros: int | None = None) -> Array:
    r"""Return derivatives of the coefficients of :func:`unfactored` with respect to the parameters of the sum.

    With ``Q_i`` and ``R_i`` the denominator and numerator of the sum of all other submodels, the fraction
    ``(B_i Q_i + p^l A_i R_i) / (p^l A_i Q_i)`` is linear in the coefficients of ``A_i`` and ``B_i``; making it monic
    adds the quotient rule. The numerator is that of :func:`unfactored`, or has the given number of zeros.
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
    if zeros is None:
        zeros = n if any(submodel.relative_degree == 0 for submodel in model.submodels) else n - 1
    return np.concatenate((jacobian_a[:n][::-1], jacobian_b[: zeros + 1][::-1]))


def factored(model: TransferFunction, terms: Sequence[Term] | None = None) -> AdditiveModel:
    r"""Return the partial fractions of a transfer function, grouped into submodels by rising natural frequency."""
    fractions = _partial_fractions(model)
    submodels = [_collected(fractions, group) for group in _groups(fractions, terms)]
    return AdditiveModel(submodels, model.delay).sorted()


def factored_jacobian(model: TransferFunction, parts: AdditiveModel, coefficients: int | None = None) -> Array:
    r"""Return derivatives of the parameters of ``factored(model)`` by the coefficients ``a_1 … a_n, b_m … b_0``.

    Factoring is the inverse of the sum of submodels with numerators of full length, so its Jacobian is the inverse of
    that of the sum. Shorter numerators take the last columns of a full one: ``coefficients`` of them, by default the
    number in the model. Poles at the origin stay there: the derivatives by their coefficients are zero.
    """
    n = model.order
    away = int(np.flatnonzero(model.denominator)[-1])
    there = np.delete(unfactored_jacobian(parts), np.s_[away:n], axis=0)
    # Units of the coefficients may differ by hundreds of decades.
    rows = np.abs(there).max(axis=1, keepdims=True)
    columns = np.abs(there / rows).max(axis=0)
    back = np.linalg.inv(there / rows / columns) / columns[:, None] / rows[:, 0]
    last = model.numerator.size if coefficients is None else coefficients
    return np.hstack((back[:, :away], np.zeros((back.shape[0], n - away)), back[:, back.shape[1] - last :]))


def pole_jacobian(denominator: ArrayLike, poles: ArrayLike) -> ComplexArray:
    """Return derivatives of the poles by the denominator coefficients: ``dp/da_i = -p^(n-i) / A'(p)``."""
    a = np.asarray(denominator, dtype=float)
    p = np.asarray(poles, dtype=complex)
    n = a.size - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian: ComplexArray = -(p[:, None] ** np.arange(n - 1, -1, -1)) / _slope_at_roots(p)[:, None]
    return jacobian


def section_slopes(denominator: ArrayLike) -> Array:
    """Return derivatives of ``a_1 ... a_n`` by the logarithms of the coefficients of sections, shape (n, n).

    A section is that of a complex pair, of two close real poles, so that these may meet, or of one real pole.
    """
    roots = sorted_roots(np.asarray(denominator, dtype=float))
    sections = [np.array([1.0, -2.0 * pole.real, abs(pole) ** 2]) for pole in roots[roots.imag > 0]]
    real = np.sort(-roots[roots.imag == 0].real).tolist()
    while real:
        slow = real.pop(0)
        if real and 0.0 < real[0] < CLOSE * slow:
            fast = real.pop(0)
            sections.append(np.array([1.0, slow + fast, slow * fast]))
        else:
            sections.append(np.array([1.0, slow]))
    columns, n = list[Array](), roots.size
    for i, section in enumerate(sections):
        others = np.ones(1)
        for other in sections[:i] + sections[i + 1 :]:
            others = np.convolve(others, other)
        for k in range(1, section.size):
            column = section[k] * others
            columns.append(np.pad(column, (n - (section.size - 1 - k) - column.size, section.size - 1 - k)))
    return np.column_stack(columns) if columns else np.zeros((0, 0))


def section_basis(denominator: ArrayLike, size: int) -> Array:
    """Return polynomials of degrees 0 to ``size - 1`` as columns of descending coefficients, shape (size, size).

    They are the products of ever more sections of a denominator, the slowest first, and s times each product of a pair:
    over this denominator their responses to an input differ, unlike those of powers of s.
    """
    product, found = np.ones(1), list[Array]()
    roots = sorted_roots(np.asarray(denominator, dtype=float))
    for pole in sorted(roots[roots.imag >= 0].tolist(), key=abs):
        found.append(product)
        if pole.imag:
            found.append(np.append(product, 0.0))
        section = [1.0, -2.0 * pole.real, abs(pole) ** 2] if pole.imag else [1.0, -pole.real]
        product = np.convolve(product, section)
    while len(found) < size:
        found.append(product)
        product = np.append(product, 0.0)
    return np.column_stack([np.pad(each, (size - each.size, 0)) for each in found[:size]])


def _slope_at_roots(p: ComplexArray) -> ComplexArray:
    """Return ``A'(p_k)`` of a monic polynomial as a product over the other roots, which avoids cancellation."""
    distances = p[:, None] - p[None, :]
    np.fill_diagonal(distances, 1.0)
    return np.asarray(np.prod(distances, axis=1))


def _shifted(polynomial: NDArray[Number], places: int, length: int) -> NDArray[Number]:
    """Return coefficients in rising powers times ``p^places``, padded to a given length."""
    return np.pad(polynomial, (places, length - places - polynomial.size))


def _joined(submodels: Sequence[Submodel]) -> tuple[Array, Array]:
    """Return numerator and denominator of a sum in rising powers, both of length order + 1 and not scaled."""
    numerator, denominator = np.zeros(1), np.ones(1)
    for submodel in submodels:
        a = _shifted(submodel.denominator[::-1], submodel.integrators, submodel.order + 1)
        b = _shifted(submodel.numerator[::-1], 0, submodel.order + 1)
        numerator = np.convolve(numerator, a) + np.convolve(denominator, b)
        denominator = np.convolve(denominator, a)
    return numerator, denominator


@dataclass(frozen=True)
class _PartialFractions:
    """Terms of the sum in the module docstring.

    Complex pairs come first, at indices k and ``pairs + k``, then real poles; both from the slowest to the fastest.
    """

    pairs: int
    poles: ComplexArray
    gains: ComplexArray
    at_origin: Array
    direct: Array  # one value, or none if the model is strictly proper


@dataclass(frozen=True)
class _Group:
    """Terms of one submodel: indices of its poles, integrators, and whether it has the feedthrough."""

    places: tuple[int, ...]
    integrators: int = 0
    direct: bool = False


def _partial_fractions(model: TransferFunction) -> _PartialFractions:
    if model.relative_degree < 0:
        raise DataError("a model with more zeros than poles cannot be written as a sum of submodels")
    a, b = model.denominator, model.numerator
    away = np.trim_zeros(a, "b")
    origin = a.size - away.size
    roots = sorted_roots(away)[::-1]
    upper = roots[roots.imag > 0]
    p = np.concatenate((upper, upper.conj(), roots[roots.imag == 0]))
    close = same_pole(p[:, None], p) & ~np.eye(p.size, dtype=bool)
    if close.any():
        place = pole_text(complex(p[np.argmax(close.any(axis=1))]))
        raise DataError(f"the pole {place} is repeated: there are no partial fractions; use a model with fewer poles")
    residues = np.polyval(b, p) / (p**origin * _slope_at_roots(p))
    at_origin: Array = np.zeros(0)
    if origin:
        # The power series of s^l G(s), by long division in rising powers.
        rising = np.concatenate((b[::-1], np.zeros(model.order)))[: model.order]
        at_origin = np.asarray(np.polydiv(rising, away[::-1])[0][:origin])
    direct = b[:1] if model.relative_degree == 0 else b[:0]
    return _PartialFractions(upper.size, p, -residues / p, at_origin, direct)


def _groups(fractions: _PartialFractions, terms: Sequence[Term] | None) -> list[_Group]:
    """Return the groups of terms that form the submodels."""
    pairs, n, integrators = fractions.pairs, fractions.poles.size, fractions.at_origin.size
    couples, lone = [(k, pairs + k) for k in range(pairs)], range(2 * pairs, n)
    if terms is None:
        groups = [_Group(couple) for couple in couples] + [_Group((k,)) for k in lone]
        groups += [_Group((), integrators)] * (integrators > 0)
        return groups + [_Group((), 0, True)] * fractions.direct.size
    direct = [fractions.direct.size > 0 and term.zeros == term.order for term in terms]
    _check_terms(fractions, terms, sum(direct))
    left, alone = iter(couples), iter(lone)
    taken = [[k for couple in islice(left, term.poles // 2) for k in couple] for term in terms]
    return [
        _Group((*places, *islice(alone, term.poles - len(places))), term.integrators, takes)
        for places, term, takes in zip(taken, terms, direct, strict=True)
    ]


def _check_terms(fractions: _PartialFractions, terms: Sequence[Term], direct: int) -> None:
    """Raise an error if the terms do not match the partial fractions; ``direct`` is the number of biproper terms."""
    pairs, n, integrators = fractions.pairs, fractions.poles.size, fractions.at_origin.size
    given = sum(term.poles for term in terms), sorted(term.integrators for term in terms if term.integrators)
    if given != (n, [integrators] * (integrators > 0)):
        raise DataError(
            f"the terms have {given[0]} poles and {sum(given[1])} integrators, the latter in {len(given[1])} of them; "
            f"the model has {n} poles and {integrators} at the origin, which must be in one term"
        )
    possible = sum(term.poles // 2 for term in terms)
    if pairs > possible:
        raise DataError(
            f"the model has {pairs} complex pairs of poles, but the terms allow {possible}; give more terms two poles"
        )
    if fractions.direct.size != direct:
        raise DataError(
            "the model is biproper (as many zeros as poles), so exactly one term must be biproper; "
            f"{direct} of the terms are"
        )


def _collected(fractions: _PartialFractions, group: _Group) -> Submodel:
    """Return the submodel of a group of terms over their common denominator."""
    places, shift = list(group.places), group.integrators
    T, g = -1.0 / fractions.poles[places], fractions.gains[places]
    size = T.size + shift + 1
    # Constant terms first: the product of 1 + T_k s is that of s + T_k with its coefficients reversed. The powers of
    # 1/s and the direct feedthrough multiply the whole denominator.
    a, b = np.asarray(polyfromroots(-T)[::-1], dtype=complex), np.zeros(size, dtype=complex)
    for k in range(T.size):
        others = np.asarray(polyfromroots(-np.delete(T, k))[::-1], dtype=complex)
        b += g[k] * _shifted(others, shift, size)
    for k, value in enumerate((*fractions.at_origin[:shift], *fractions.direct[: int(group.direct)])):
        b += value * _shifted(a, k, size)
    length = size if group.direct else size - 1
    return Submodel(b.real[:length][::-1], a.real[::-1], shift)
