"""Sections for the system to simulate: one fraction, or a sum of submodels."""

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from ctid_cli.arrays import ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.specification.fields import Coefficients, NotNegative, OneOf, Swept
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.own_sections import OWN_FORM
from ctid_cli.specification.sections import RefusedOptionsError, Section, WithKey, is_own

#: Highest order that the simulation handles to its stated accuracy.
MAX_ORDER = 12


class SystemSection(Section):
    """The system to simulate: ``G(s) = B(s)/A(s) exp(-delay s)``, strictly proper and stable.

    Parameters
    ----------
    numerator : list of float
        coefficients of B in descending powers of s
    denominator : list of float
        coefficients of A in descending powers of s
    delay : float, default 0.0
        Pure delay [s]
    """

    target: ClassVar[type | None] = TransferFunction

    numerator: Coefficients
    denominator: Coefficients
    delay: Annotated[float | list[float], Swept(NotNegative)] = 0.0

    def complaints(self) -> Iterator[Complaint]:
        """Say why the system cannot be simulated."""
        with np.errstate(all="ignore"):
            model = TransferFunction(self.numerator, self.denominator)
        if not (np.isfinite(model.numerator).all() and np.isfinite(model.denominator).all()):
            yield ("denominator",), "its first coefficient is too small for the others; scale the coefficients"
            return
        zeros = model.order - model.relative_degree
        if not model.numerator.any():
            yield ("numerator",), "all coefficients are zero, so the output would be too"
        if model.relative_degree < 1:
            yield (), f"there are {zeros} zeros and {model.order} poles; the system needs fewer zeros than poles"
        elif model.order > MAX_ORDER:
            yield ("denominator",), f"{model.order} poles are too many; at most {MAX_ORDER} can be simulated exactly"
        elif not model.is_stable:
            yield (), f"the system is unstable and cannot be simulated: {_unstable(model.poles)}"


class SubmodelSection(Section):
    """One term of a sum: ``G_i(s) = B_i(s) / (s^l A_i(s))``.

    Parameters
    ----------
    numerator : list of float
        coefficients of B_i in descending powers of s
    denominator : list of float
        coefficients of A_i in descending powers of s, without the integrators
    integrators : int, default 0
        Number l of further poles at the origin
    """

    target: ClassVar[type | None] = Submodel

    numerator: Coefficients
    denominator: Coefficients
    integrators: int = Field(default=0, ge=0)

    def complaints(self) -> Iterator[Complaint]:
        """Say why this is no submodel."""
        submodel = self.options()
        if not (np.isfinite(submodel.numerator).all() and np.isfinite(submodel.denominator).all()):
            yield ("denominator",), "its last coefficient is too small for the others; scale the coefficients"
        elif not submodel.numerator.any():
            yield ("numerator",), "all coefficients are zero: a submodel that does nothing; leave it out"


class AdditiveSection(Section):
    """A sum of submodels that have no pole in common: ``G(s) = G_1(s) + … + G_K(s)``.

    Parameters
    ----------
    additive : list of mappings
        submodels {numerator: […], denominator: […]}
    """

    target: ClassVar[type | None] = AdditiveModel

    additive: Annotated[list[SubmodelSection], Field(min_length=1)]

    def build(self) -> AdditiveModel:
        """The sum."""
        try:
            return AdditiveModel(self.part("additive"), getattr(self, "delay", 0.0))
        except DataError as error:
            raise RefusedOptionsError(("additive",), str(error)) from None


_TWICE = "gives the system a second time, 'additive' has it already; keep one of the two forms"


class AdditiveSystemSection(AdditiveSection):
    """The system to simulate as a sum of stable submodels, which may have integrators.

    Parameters
    ----------
    delay : float, default 0.0
        Pure delay [s], common to all submodels
    """

    elsewhere = {"numerator": _TWICE, "denominator": _TWICE}  # noqa: RUF012 - of the base class

    delay: Annotated[float | list[float], Swept(NotNegative)] = 0.0

    def complaints(self) -> Iterator[Complaint]:
        """Say why the system cannot be simulated."""
        for k, section in enumerate(self.additive):
            submodel = section.options()
            if submodel.order > MAX_ORDER:
                yield ("additive", k), f"{submodel.order} poles are too many; at most {MAX_ORDER} can be simulated"
            elif not submodel.is_stable:
                # Poles at the origin are declared as integrators, which may be simulated.
                poles = submodel.poles[submodel.poles != 0]
                yield ("additive", k), f"the submodel is unstable and cannot be simulated: {_unstable(poles)}"


_LinearSystem = Annotated[Any, WithKey("additive", AdditiveSystemSection, SystemSection)]
AnySystemSection = Annotated[
    Any, OneOf(lambda value: "own" if is_own(value) else "linear", {"own": OWN_FORM, "linear": _LinearSystem})
]


def _unstable(poles: ComplexArray) -> str:
    offending = [
        f"{pole.real:.4g}{pole.imag:+.4g}j" if pole.imag else f"{pole.real:.4g}" for pole in poles if not pole.real < 0
    ]
    noun = "pole" if len(offending) == 1 else "poles"
    return f"{noun} at {', '.join(offending)} rad/s; every pole needs a negative real part"
