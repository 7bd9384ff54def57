"""The section for what closes a loop around the system."""

from collections.abc import Iterator
from typing import Annotated, ClassVar

from ctid_cli.models.controller import DiscreteController
from ctid_cli.signals.record import Enters
from ctid_cli.simulation.dataset import LoopOptions
from ctid_cli.specification.fields import Number, Swept
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.option_sections import ExcitationSection
from ctid_cli.specification.sections import Section, WithKey, section_for, variants

_Gain = Annotated[float | list[float], Swept(Number)]


class PidSection(Section):
    """Gains of ``C(q) = kp + ki q/(q - 1) + kd (q - 1)/q``; the sampling interval is part of them.

    Parameters
    ----------
    kp : float, default 0.0
        Proportional gain [input unit/output unit]
    ki : float, default 0.0
        Gain of the running sum of the error [input unit/output unit]
    kd : float, default 0.0
        Gain of the difference between two samples of the error [input unit/output unit]
    """

    kp: _Gain = 0.0
    ki: _Gain = 0.0
    kd: _Gain = 0.0


_TWICE = "gives the controller a second time, 'pid' has it already; keep one of the two forms"


class PidControllerSection(Section):
    """A discrete-time controller by its gains.

    Parameters
    ----------
    pid : mapping
        Proportional, summing and differencing gains
    """

    target: ClassVar[type | None] = DiscreteController
    elsewhere = {"numerator": _TWICE, "denominator": _TWICE}  # noqa: RUF012 - of the base class

    pid: PidSection

    def build(self) -> DiscreteController:
        """The controller."""
        return DiscreteController.from_pid(**self.pid.model_dump())


class LoopSection(Section):
    """What makes the input: a controller that is fed the output, and a reference.

    Parameters
    ----------
    controller : mapping
        Discrete-time controller, acting at every sample
    reference : mapping, optional
        The reference; for a measured record it is a column, data.reference
    enters : {"controller", "input"}, default "controller"
        u = C(q) (reference - y), or u = reference - C(q) y
    """

    target: ClassVar[type | None] = LoopOptions

    controller: Annotated[Section, WithKey("pid", PidControllerSection, section_for(DiscreteController))]
    reference: ExcitationSection | None = None
    enters: Annotated[Enters | list[Enters], Swept(Enters)] = "controller"

    def complaints(self) -> Iterator[Complaint]:
        """Say that the controller does nothing."""
        if not all(variant.options.controller.numerator.any() for variant in variants(self)):
            yield ("controller",), "the controller is zero, so there is no loop; give it a gain, or give excitation"
