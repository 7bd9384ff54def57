"""The section for where estimators start: at an initial delay, or at initial parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field

from ctid_cli.specification.sections import (
    Check,
    Complaint,
    Section,
    checked,
    list_of,
    number,
    optional,
    several_wrong,
    shown,
    wrong,
)
from ctid_cli.specification.system_sections import AdditiveSection


class UniformStart(Section):
    """An initial delay drawn anew for every data set."""

    uniform: Annotated[
        list[float], checked(list_of(number("s", at_least=0.0), "a list of two delays [s]", length=2))
    ] = Field(description="Least and greatest value [s]")

    def complaints(self) -> Iterator[Complaint]:
        """Say why the range is none."""
        if not self.uniform[0] < self.uniform[1]:
            low, high = self.uniform
            yield ("uniform",), f"the first value, {low:g} s, must be below the second, {high:g} s"


class RelativeStart(Section):
    """Initial parameters drawn anew for every data set, around those of the simulated system."""

    relative_uniform: Annotated[float, checked(number(above=0.0))] = Field(
        description="Every parameter is multiplied by a random number from 1 - this to 1 + this [-]"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that parameters could change their sign."""
        if not self.relative_uniform < 1.0:
            yield ("relative_uniform",), f"must be below 1, not {self.relative_uniform:g}: parameters keep their sign"


class GivenStart(AdditiveSection):
    """Initial parameters as a sum of submodels."""


def _delay_start(value: Any) -> float | UniformStart:
    if isinstance(value, (Mapping, UniformStart)):
        return UniformStart.model_validate(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise wrong(f"must be a delay [s] or {{uniform: [low, high]}}, not {shown(value)}")
    return float(number("s", at_least=0.0)(value))


def _parameter_start(value: Any) -> RelativeStart | GivenStart:
    if isinstance(value, (RelativeStart, GivenStart)):
        return value
    if not isinstance(value, Mapping) or len({"relative_uniform", "additive"} & value.keys()) != 1:
        raise wrong(f"must be {{relative_uniform: fraction}} or {{additive: [submodels]}}, not {shown(value)}")
    return (RelativeStart if "relative_uniform" in value else GivenStart).model_validate(value)


def _one_or_several(check: Callable[[Any], Any], what: str) -> Check:
    def checked(value: Any) -> list[Any]:
        if not isinstance(value, (list, tuple)):
            return [check(value)]
        items: list[Any] = list_of(check, what)(value)
        for k, item in enumerate(items):
            if item in items[:k]:
                raise several_wrong("starts", [((k,), "this start is in the list twice; keep one of them", False)])
        return items

    return checked


class StartsSection(Section):
    """Where estimators start that need, or take, an initial delay or initial parameters."""

    added_later: ClassVar[frozenset[str]] = frozenset({"parameters"})

    initial_delay: Annotated[
        list[float | UniformStart] | float | UniformStart | None,
        checked(optional(_one_or_several(_delay_start, "a list of delays [s]"))),
    ] = Field(default=None, description="Initial delays [s]; {uniform: [low, high]} draws one for every data set")
    parameters: Annotated[
        list[RelativeStart | GivenStart] | RelativeStart | GivenStart | None,
        checked(optional(_one_or_several(_parameter_start, "a list of initial parameters"))),
    ] = Field(
        default=None,
        description="Initial parameters, drawn around those of the simulated system or given; by default every "
        "estimator makes its own",
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that there is no start."""
        if self.initial_delay is None and self.parameters is None:
            yield (), "give initial_delay, parameters or both, or leave the section out"

    @property
    def delays(self) -> list[float | UniformStart]:
        """Initial delays, in the order of the specification."""
        assert self.initial_delay is None or isinstance(self.initial_delay, list)
        return self.initial_delay or []

    @property
    def parameter_sets(self) -> list[RelativeStart | GivenStart]:
        """Initial parameters, in the order of the specification."""
        assert self.parameters is None or isinstance(self.parameters, list)
        return self.parameters or []
