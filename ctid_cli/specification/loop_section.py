"""The section for what closes a loop around the system."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

from pydantic import Field

from ctid_cli.models.controller import DiscreteController
from ctid_cli.signals.record import Enters
from ctid_cli.simulation.dataset import LoopOptions
from ctid_cli.specification.fields import Number, Swept
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.option_sections import ExcitationSection
from ctid_cli.specification.sections import Section, WithKey, section_for, variants


class PidSection(Section):
    """Gains of ``C(q) = kp + ki q/(q - 1) + kd (q - 1)/q``; the sampling interval is part of them."""

    kp: Annotated[float | list[float], Swept(Number)] = Field(
        default=0.0, description="Proportional gain [input unit/output unit]"
    )
    ki: Annotated[float | list[float], Swept(Number)] = Field(
        default=0.0, description="Gain of the running sum of the error [input unit/output unit]"
    )
    kd: Annotated[float | list[float], Swept(Number)] = Field(
        default=0.0, description="Gain of the difference between two samples of the error [input unit/output unit]"
    )


_TWICE = "gives the controller a second time, 'pid' has it already; keep one of the two forms"


class PidControllerSection(Section):
    """A discrete-time controller by its gains."""

    target: ClassVar[type | None] = DiscreteController
    elsewhere = {"numerator": _TWICE, "denominator": _TWICE}  # noqa: RUF012 - of the base class

    pid: PidSection = Field(description="Proportional, summing and differencing gains")

    def build(self) -> DiscreteController:
        """The controller."""
        return DiscreteController.from_pid(**self.pid.model_dump())


class LoopSection(Section):
    """What makes the input: a controller that is fed the output, and a reference."""

    target: ClassVar[type | None] = LoopOptions

    controller: Annotated[Section, WithKey("pid", PidControllerSection, section_for(DiscreteController))] = Field(
        description="Discrete-time controller, acting at every sample"
    )
    reference: ExcitationSection | None = Field(
        default=None, description="The reference; for a measured record it is a column, data.reference"
    )
    enters: Annotated[Enters | list[Enters], Swept(Enters)] = Field(
        default="controller", description="u = C(q) (reference - y), or u = reference - C(q) y"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that the controller does nothing."""
        if not all(variant.options.controller.numerator.any() for variant in variants(self)):
            yield ("controller",), "the controller is zero, so there is no loop; give it a gain, or give excitation"
