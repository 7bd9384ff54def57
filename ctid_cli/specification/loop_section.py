"""The section for what closes a loop around the system."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from ctid_cli.models.controller import DiscreteController
from ctid_cli.simulation.dataset import LoopOptions
from ctid_cli.specification.option_sections import ExcitationSection, check_of
from ctid_cli.specification.sections import (
    Complaint,
    Section,
    checked,
    choice,
    list_of,
    number,
    optional,
    several_wrong,
    swept,
    variants,
)

_COEFFICIENTS = list_of(number(), "a list of coefficients in descending powers of q")
_GAIN = swept(number("input unit/output unit"))


class ControllerSection(Section):
    """A discrete-time controller ``C(q) = numerator / denominator``."""

    target: ClassVar[type | None] = DiscreteController

    numerator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients in descending powers of the shift operator q"
    )
    denominator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients in descending powers of the shift operator q"
    )


class PidSection(Section):
    """Gains of ``C(q) = kp + ki q/(q - 1) + kd (q - 1)/q``; the sampling interval is part of them."""

    sweepable: ClassVar[frozenset[str]] = frozenset({"kp", "ki", "kd"})

    kp: Annotated[float | list[float], checked(_GAIN)] = Field(
        default=0.0, description="Proportional gain [input unit/output unit]"
    )
    ki: Annotated[float | list[float], checked(_GAIN)] = Field(
        default=0.0, description="Gain of the running sum of the error [input unit/output unit]"
    )
    kd: Annotated[float | list[float], checked(_GAIN)] = Field(
        default=0.0, description="Gain of the difference between two samples of the error [input unit/output unit]"
    )


class PidControllerSection(Section):
    """A discrete-time controller by its gains."""

    target: ClassVar[type | None] = DiscreteController

    pid: Annotated[PidSection, checked(PidSection.model_validate)] = Field(
        description="Proportional, summing and differencing gains"
    )

    def build(self, values: Mapping[str, Any]) -> DiscreteController:
        """The controller."""
        return DiscreteController.from_pid(**values["pid"])


def _controller_section(value: Any) -> Section:
    if isinstance(value, PidControllerSection):
        return value
    if not isinstance(value, Mapping) or "pid" not in value:
        return ControllerSection.model_validate(value)
    twice = [name for name in ("numerator", "denominator") if name in value]
    if twice:
        message = "gives the controller a second time, 'pid' has it already; keep one of the two forms"
        raise several_wrong("controller", [((name,), message, True) for name in twice])
    return PidControllerSection.model_validate(value)


class LoopSection(Section):
    """What makes the input: a controller that is fed the output, and a reference."""

    target: ClassVar[type | None] = LoopOptions
    sweepable: ClassVar[frozenset[str]] = frozenset({"enters"})

    controller: Annotated[ControllerSection | PidControllerSection, checked(_controller_section)] = Field(
        description="Discrete-time controller, acting at every sample"
    )
    reference: Annotated[ExcitationSection | None, checked(optional(check_of(ExcitationSection)))] = Field(
        default=None, description="The reference; for a measured record it is a column, data.reference"
    )
    enters: Annotated[
        Literal["controller", "input"] | list[Literal["controller", "input"]],
        checked(swept(choice("controller", "input"))),
    ] = Field(default="controller", description="u = C(q) (reference - y), or u = reference - C(q) y")

    def complaints(self) -> Iterator[Complaint]:
        """Say that the controller does nothing."""
        problems = list(super().complaints())
        yield from problems
        if problems:
            return
        if not all(variant.options.controller.numerator.any() for variant in variants(self)):
            yield ("controller",), "the controller is zero, so there is no loop; give it a gain, or give excitation"
