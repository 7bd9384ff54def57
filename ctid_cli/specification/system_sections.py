"""Sections for the system to simulate: one fraction, or a sum of submodels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.specification.sections import (
    Complaint,
    RefusedOptionsError,
    Section,
    checked,
    list_of,
    number,
    several_wrong,
    swept,
    variants,
    whole,
)

#: Highest order that the simulation handles to its stated accuracy.
MAX_ORDER = 12

_COEFFICIENTS = list_of(number(), "a list of coefficients in descending powers of s")
_DELAY = swept(number("s", at_least=0.0))


class SystemSection(Section):
    """The system to simulate: ``G(s) = B(s)/A(s) exp(-delay s)``, strictly proper and stable."""

    target: ClassVar[type | None] = TransferFunction
    sweepable: ClassVar[frozenset[str]] = frozenset({"delay"})

    numerator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients of B in descending powers of s"
    )
    denominator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients of A in descending powers of s"
    )
    delay: Annotated[float | list[float], checked(_DELAY)] = Field(default=0.0, description="Pure delay [s]")

    def complaints(self) -> Iterator[Complaint]:
        """Say why the system cannot be simulated."""
        problems = list(super().complaints())
        yield from problems
        if problems:
            return
        with np.errstate(all="ignore"):
            model = TransferFunction(self.numerator, self.denominator)
        if not (np.isfinite(model.numerator).all() and np.isfinite(model.denominator).all()):
            yield ("denominator",), "its first coefficient is too small for the others; scale the coefficients"
            return
        zeros = model.order - model.relative_degree
        if not model.numerator.any():
            yield ("numerator",), "all coefficients are zero, so the output would be too"
        if model.relative_degree < 1:
            yield (
                (),
                f"there are {zeros} zeros and {model.order} poles; the system must be strictly proper, "
                "with fewer zeros than poles",
            )
        elif model.order > MAX_ORDER:
            yield ("denominator",), f"{model.order} poles are too many; at most {MAX_ORDER} can be simulated exactly"
        elif not model.is_stable:
            yield (), f"the system is unstable and cannot be simulated: {_unstable(model.poles)}"


class SubmodelSection(Section):
    """One term of a sum: ``G_i(s) = B_i(s) / (s^l A_i(s))``."""

    target: ClassVar[type | None] = Submodel

    numerator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients of B_i in descending powers of s"
    )
    denominator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients of A_i in descending powers of s, without the integrators"
    )
    integrators: Annotated[int, checked(whole(at_least=0))] = Field(
        default=0, description="Number l of further poles at the origin"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say why this is no submodel."""
        problems = list(super().complaints())
        yield from problems
        if problems:
            return
        submodel = variants(self)[0].options
        if not (np.isfinite(submodel.numerator).all() and np.isfinite(submodel.denominator).all()):
            yield ("denominator",), "its last coefficient is too small for the others; scale the coefficients"
        elif not submodel.numerator.any():
            yield ("numerator",), "all coefficients are zero: a submodel that does nothing; leave it out"


class AdditiveSection(Section):
    """A sum of submodels that have no pole in common: ``G(s) = G_1(s) + … + G_K(s)``."""

    target: ClassVar[type | None] = AdditiveModel

    additive: Annotated[
        list[SubmodelSection],
        checked(list_of(SubmodelSection.model_validate, "a list of submodels {numerator: […], denominator: […]}")),
    ] = Field(description="The submodels")

    def build(self, values: Mapping[str, Any]) -> AdditiveModel:
        """The sum."""
        submodels = [part.build(item) for part, item in zip(self.additive, values["additive"], strict=True)]
        try:
            return AdditiveModel(submodels, values.get("delay", 0.0))
        except DataError as error:
            raise RefusedOptionsError(("additive",), str(error)) from None


class AdditiveSystemSection(AdditiveSection):
    """The system to simulate as a sum of stable submodels, which may have integrators."""

    sweepable: ClassVar[frozenset[str]] = frozenset({"delay"})

    delay: Annotated[float | list[float], checked(_DELAY)] = Field(
        default=0.0, description="Pure delay [s], common to all submodels"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say why the system cannot be simulated."""
        problems = list(super().complaints())
        yield from problems
        if problems:
            return
        for k, submodel in enumerate(variants(self)[0].options.submodels):
            if submodel.order > MAX_ORDER:
                yield ("additive", k), f"{submodel.order} poles are too many; at most {MAX_ORDER} can be simulated"
            elif not submodel.is_stable:
                # Poles at the origin are declared as integrators, which may be simulated.
                poles = submodel.poles[submodel.poles != 0]
                yield ("additive", k), f"the submodel is unstable and cannot be simulated: {_unstable(poles)}"


def system_section(value: Any) -> Section:
    """Check of the system, in whichever of its two forms it is given."""
    if isinstance(value, AdditiveSystemSection):
        return value
    if not isinstance(value, Mapping) or "additive" not in value:
        return SystemSection.model_validate(value)
    twice = [name for name in ("numerator", "denominator") if name in value]
    if twice:
        message = "gives the system a second time, 'additive' has it already; keep one of the two forms"
        raise several_wrong("system", [((name,), message, True) for name in twice])
    return AdditiveSystemSection.model_validate(value)


def _unstable(poles: np.ndarray[Any, np.dtype[np.complex128]]) -> str:
    offending = [_complex_text(pole) for pole in poles if not pole.real < 0]
    noun = "pole" if len(offending) == 1 else "poles"
    return f"{noun} at {', '.join(offending)} rad/s; every pole needs a negative real part"


def _complex_text(value: complex) -> str:
    if value.imag == 0:
        return f"{value.real:.4g}"
    return f"{value.real:.4g}{value.imag:+.4g}j"
