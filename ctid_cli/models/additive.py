"""Sums of submodels with separate denominators: the modes of a structure, or a rigid body and its modes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.models.transfer_function import (
    ContinuousModel,
    TransferFunction,
    checked_delay,
    polynomials,
    sorted_roots,
)
from ctid_cli.signals.checks import freeze, require_integer

#: Poles nearer to each other than this fraction of their magnitude count as one: a double root of rounded coefficients
#: comes out as two that lie 1e-8 apart.
SAME_POLE = 1e-7


@dataclass(frozen=True)
class Term:
    r"""Structure of one submodel ``B_i(p) / (p^l A_i(p))``.

    Parameters
    ----------
    poles : int
        Degree of ``A_i`` [-]; 0 for pure integrators or a pure gain.
    zeros : int
        Degree of ``B_i`` [-], at most ``poles + integrators``.
    integrators : int, default 0
        Number l of poles fixed at the origin [-].

    Raises
    ------
    ValueError
        If a number is not an integer of at least 0, or there are more zeros than poles.

    Examples
    --------
    >>> Term(poles=2, zeros=0).size
    3
    """

    poles: int
    zeros: int
    integrators: int = 0

    def __post_init__(self) -> None:
        for name in ("poles", "zeros", "integrators"):
            require_integer(name, getattr(self, name), 0, label=f"the number of {name} of a submodel")
        if self.zeros > self.order:
            given = f"{self.zeros} zeros and {self.order} poles, integrators included"
            raise OptionError("zeros", f"a submodel must not have more zeros than poles; got {given}")

    @property
    def order(self) -> int:
        """Number of poles, integrators included."""
        return self.poles + self.integrators

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.poles + self.zeros + 1


@dataclass(frozen=True, eq=False)
class Submodel(ContinuousModel):
    r"""``G_i(p) = B_i(p) / (p^l A_i(p))``, scaled so that the constant term of ``A_i`` is 1.

    Parameters
    ----------
    numerator : array_like, shape (m + 1,)
        Coefficients of ``B_i`` in descending powers of p. Its length is the declared degree: leading zeros stay.
    denominator : array_like, shape (n + 1,)
        Coefficients of ``A_i`` in descending powers of p; numerator and denominator are divided by the last one.
    integrators : int, default 0
        Number l of poles at the origin.

    Raises
    ------
    DataError
        If a coefficient is not finite, the first or the last coefficient of the denominator is zero, or there are more
        zeros than poles.

    Notes
    -----
    With a constant term of 1, the *anti-monic* form, the constant of the numerator is the static gain, and the
    denominator of a mode far above all frequencies of interest tends to 1 instead of growing beyond bounds.

    Examples
    --------
    >>> mode = Submodel([12.0], [1.0, 1.0, 4.0])
    >>> mode.numerator, mode.denominator, round(mode.natural_frequency, 6), mode.dc_gain
    (array([3.]), array([0.25, 0.25, 1.  ]), 2.0, 3.0)
    """

    numerator: Array
    denominator: Array
    integrators: int = 0

    def __init__(self, numerator: ArrayLike, denominator: ArrayLike, integrators: int = 0) -> None:
        b, a = polynomials(numerator, denominator, "a submodel", "p")
        if a[-1] == 0:
            text = "the last denominator coefficient of a submodel is zero; give poles at the origin as integrators"
            raise DataError(text, "denominator")
        require_integer("integrators", integrators, 0, label="the number of integrators of a submodel")
        if b.size > a.size + integrators:
            counts = f"more zeros ({b.size - 1}) than poles ({a.size - 1 + integrators})"
            raise DataError(f"a submodel with {counts} has no response to a jump", "numerator")
        freeze(self, numerator=b / a[-1], denominator=a / a[-1], integrators=int(integrators))

    def term(self) -> Term:
        """Return the structure of the submodel.

        Returns
        -------
        Term
            Degrees of both polynomials and the number of integrators.
        """
        return Term(self.denominator.size - 1, self.numerator.size - 1, self.integrators)

    @property
    def order(self) -> int:
        """Number of poles, integrators included."""
        return int(self.denominator.size - 1 + self.integrators)

    @property
    def relative_degree(self) -> int:
        """Number of poles, integrators included, minus the declared number of zeros."""
        return int(self.order - (self.numerator.size - 1))

    @cached_property
    def poles(self) -> ComplexArray:
        """Roots of ``A_i`` and l times zero [rad/s], fastest first, shape (n + l,)."""
        poles = sorted_roots(np.concatenate((self.denominator, np.zeros(self.integrators))))
        poles.setflags(write=False)
        return poles

    @property
    def is_stable(self) -> bool:
        """Whether every root of ``A_i`` lies strictly in the left half-plane; integrators are ignored."""
        return bool((sorted_roots(self.denominator).real < 0).all())

    @property
    def natural_frequency(self) -> float:
        """Least magnitude of the poles [rad/s]: 0 with integrators, infinite for a pure gain."""
        return float(np.abs(self.poles).min(initial=np.inf))

    @property
    def dc_gain(self) -> float:
        """``G_i(0)``; infinite with integrators."""
        return float("inf") if self.integrators else float(self.numerator[-1])

    def transfer_function(self) -> TransferFunction:
        """Return the submodel as a monic transfer function.

        Returns
        -------
        TransferFunction
            Without delay.
        """
        return TransferFunction(self.numerator, np.concatenate((self.denominator, np.zeros(self.integrators))))

    def frequency_response(self, frequencies: ArrayLike) -> ComplexArray:
        """Return ``G_i(j w)``, integrators included."""
        s = 1j * np.asarray(frequencies, dtype=float)
        gain = np.polyval(self.numerator, s) / (s**self.integrators * np.polyval(self.denominator, s))
        return np.asarray(gain, dtype=complex)


@dataclass(frozen=True, eq=False)
class AdditiveModel(ContinuousModel):
    r"""``G(p) = (G_1(p) + … + G_K(p)) exp(-delay p)``.

    Parameters
    ----------
    submodels : iterable of Submodel
        The terms of the sum, at least one.
    delay : float, default 0.0
        Pure delay of the input [s], common to all.

    Raises
    ------
    DataError
        If there is no submodel, two have a pole in common, two are biproper (as many zeros as poles), or the delay is
        negative or not finite: such a sum does not determine its terms.

    Notes
    -----
    Parameters are counted submodel by submodel: ``a_1 … a_n``, then ``b_0 … b_m``, where the number is the power of p
    that the coefficient multiplies. ``a_0`` is 1.

    Examples
    --------
    >>> model = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
    >>> model.names
    ('g1_a1', 'g1_a2', 'g1_b0', 'g2_a1', 'g2_a2', 'g2_b0')
    >>> model.theta
    array([0.25 , 0.25 , 3.   , 0.01 , 0.025, 1.   ])
    """

    submodels: tuple[Submodel, ...]
    delay: float = 0.0

    def __init__(self, submodels: Iterable[Submodel], delay: float = 0.0) -> None:
        terms = tuple(submodels)
        if not terms:
            raise DataError("an additive model needs at least one submodel")
        _require_identifiable(terms)
        freeze(self, submodels=terms, delay=checked_delay(delay))

    @classmethod
    def from_theta(cls, theta: ArrayLike, terms: Sequence[Term], delay: float = 0.0) -> AdditiveModel:
        """Return the model of a given structure from its parameters.

        Parameters
        ----------
        theta : array_like, shape (p,)
            Parameters in the order of :attr:`names`.
        terms : sequence of Term
            Structure of each submodel.
        delay : float, default 0.0
            Pure delay [s].

        Returns
        -------
        AdditiveModel
            Numerators have their declared length even where a leading coefficient is zero.

        Raises
        ------
        ValueError
            If the number of parameters is not that of the structure.
        DataError
            If the coefficients form no valid model.
        """
        values = np.asarray(theta, dtype=float)
        size = sum(term.size for term in terms)
        if values.shape != (size,):
            raise ValueError(f"the terms have {size} parameters in all; got an array of shape {values.shape}")
        submodels = []
        for term in terms:
            rising, values = values[: term.size], values[term.size :]
            denominator = np.append(rising[: term.poles][::-1], 1.0)
            submodels.append(Submodel(rising[term.poles :][::-1], denominator, term.integrators))
        return cls(submodels, delay)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Structure of each submodel."""
        return tuple(submodel.term() for submodel in self.submodels)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the order of :attr:`theta`: ``g1_a1 … g1_b0 …, g2_a1 …``."""
        return names_of(self.terms)

    @property
    def theta(self) -> Array:
        """Parameters: for each submodel ``a_1 … a_n`` [s^k], then ``b_0 … b_m``, shape (p,)."""
        return np.concatenate([part for s in self.submodels for part in (s.denominator[-2::-1], s.numerator[::-1])])

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters by name."""
        return dict(zip(self.names, self.theta.tolist(), strict=True))

    @property
    def order_of_sorting(self) -> tuple[int, ...]:
        """Indices of the submodels by rising natural frequency; integrators come first, a pure gain last."""
        frequencies = [submodel.natural_frequency for submodel in self.submodels]
        return tuple(np.argsort(frequencies, kind="stable").tolist())

    def sorted(self) -> AdditiveModel:
        """Return the model with its submodels in order of rising natural frequency.

        Returns
        -------
        AdditiveModel
            Submodel k is submodel ``order_of_sorting[k]`` of this model.
        """
        return AdditiveModel([self.submodels[k] for k in self.order_of_sorting], self.delay)

    @property
    def order(self) -> int:
        """Number of poles, integrators included."""
        return sum(submodel.order for submodel in self.submodels)

    @property
    def poles(self) -> ComplexArray:
        """Poles of all submodels [rad/s], fastest first, shape (order,)."""
        poles = np.concatenate([submodel.poles for submodel in self.submodels])
        return np.asarray(poles[np.lexsort((poles.imag, -np.abs(poles)))])

    @property
    def is_stable(self) -> bool:
        """Whether every pole lies strictly in the left half-plane; a model with integrators is not stable."""
        return self.is_marginally_stable and not any(submodel.integrators for submodel in self.submodels)

    @property
    def is_marginally_stable(self) -> bool:
        """Whether every pole except the integrators lies strictly in the left half-plane."""
        return all(submodel.is_stable for submodel in self.submodels)

    @property
    def dc_gain(self) -> float:
        """``G(0)``; infinite with integrators."""
        return float(sum(submodel.dc_gain for submodel in self.submodels))

    def frequency_response(self, frequencies: ArrayLike) -> ComplexArray:
        """Return the frequency response of the sum, delay included."""
        w = np.asarray(frequencies, dtype=float)
        total = np.sum([submodel.frequency_response(w) for submodel in self.submodels], axis=0)
        return np.asarray(total * np.exp(-1j * w * self.delay), dtype=complex)


def names_of(terms: Iterable[Term]) -> tuple[str, ...]:
    """Return the names of the parameters of a sum of terms."""
    names: list[str] = []
    for number, term in enumerate(terms, 1):
        names += [f"g{number}_a{k}" for k in range(1, term.poles + 1)]
        names += [f"g{number}_b{k}" for k in range(term.zeros + 1)]
    return tuple(names)


def terms_text(terms: Iterable[Term]) -> str:
    """Return poles and zeros of terms, without integrators, in command-line form: ``2/0,2/1``."""
    return ",".join(f"{term.poles}/{term.zeros}" for term in terms)


def degrees_of(terms: Iterable[Term]) -> tuple[int, int]:
    """Return the degrees of denominator (integrators included) and numerator of a sum as one transfer function."""
    terms = tuple(terms)
    order = sum(term.order for term in terms)
    return order, max(order - term.order + term.zeros for term in terms)


def same_pole(one: ArrayLike, other: ArrayLike) -> BoolArray:
    """Return whether two poles are too close to be distinguished in double precision."""
    p, q = np.asarray(one, dtype=complex), np.asarray(other, dtype=complex)
    return np.asarray(np.abs(p - q) <= SAME_POLE * np.maximum(np.abs(p), np.abs(q)))


def pole_text(pole: complex) -> str:
    """Return the location of a pole, for a message."""
    if pole == 0:
        return "at the origin"
    return f"at {pole.real:g}{f'{pole.imag:+g}j' if pole.imag else ''} rad/s"


def _require_identifiable(submodels: tuple[Submodel, ...]) -> None:
    """Raise an error if different terms would give the same sum."""
    biproper = [f"g{i}" for i, submodel in enumerate(submodels, 1) if submodel.relative_degree == 0]
    if len(biproper) > 1:
        raise DataError(
            f"{' and '.join(biproper)} are biproper (as many zeros as poles); at most one submodel may be, because "
            "the division of the direct feedthrough between them is not unique"
        )
    poles = [submodel.poles for submodel in submodels]
    for j, second in enumerate(poles):
        for i, first in enumerate(poles[:j]):
            shared = same_pole(first[:, None], second).any(axis=1)
            if shared.any():
                place = pole_text(complex(first[np.argmax(shared)]))
                raise DataError(f"g{i + 1} and g{j + 1} have the pole {place} in common; put it in one of them")
