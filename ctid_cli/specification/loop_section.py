"""The section for what closes a loop around the system."""

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar

from ctid_cli.models.controller import ContinuousPid, DiscreteController, Relay
from ctid_cli.signals.record import Enters
from ctid_cli.simulation.dataset import LoopOptions
from ctid_cli.specification.fields import Number, Swept
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.option_sections import ExcitationSection
from ctid_cli.specification.sections import Options, Section, WithKey, section_for, variants

_Gain = Annotated[float | list[float], Swept(Number)]
_FORMS = ("pid", "continuous_pid", "relay", "numerator", "denominator")


def _other_forms(form: str) -> dict[str, str]:
    """Sentences for the keys of the other forms of a controller."""
    twice = f"gives the controller a second time, '{form}' has it already; keep one of the forms"
    return {key: twice for key in _FORMS if key != form}


class PidSection(Section):
    """Gains per sample, ``C(q) = kp + ki q/(q - 1) + kd (q - 1)/q``; for gains in seconds use continuous_pid.

    Parameters
    ----------
    kp : float, default 0.0
        Proportional gain [input unit/output unit]
    ki : float, default 0.0
        Gain of the running sum of the error, per sample [input unit/output unit]
    kd : float, default 0.0
        Gain of the difference between two samples of the error, per sample [input unit/output unit]
    """

    kp: _Gain = 0.0
    ki: _Gain = 0.0
    kd: _Gain = 0.0

    def build(self) -> DiscreteController:
        """The controller."""
        return DiscreteController.from_pid(**self.model_dump())


class ControllerSection(Section):
    """A controller in the form of its one key."""

    def build(self) -> Any:
        """The controller."""
        return self.part(*type(self).model_fields)


class PidControllerSection(ControllerSection):
    """A discrete-time controller by its gains per sample.

    Parameters
    ----------
    pid : mapping
        Gains per sample: proportional, summing and differencing
    """

    target: ClassVar[type | None] = DiscreteController
    elsewhere = _other_forms("pid")

    pid: PidSection


class ContinuousPidControllerSection(ControllerSection):
    """A controller by its gains in continuous time, which do not depend on the sampling interval.

    Parameters
    ----------
    continuous_pid : mapping
        Gains in continuous time, and how the controller is made discrete
    """

    target: ClassVar[type | None] = ContinuousPid
    elsewhere = _other_forms("continuous_pid")

    continuous_pid: Annotated[Section, Options(ContinuousPid)]


class RelayControllerSection(ControllerSection):
    """A relay, which makes the loop oscillate by itself.

    Parameters
    ----------
    relay : mapping
        Its two values, and its hysteresis
    """

    target: ClassVar[type | None] = Relay
    elsewhere = _other_forms("relay")

    relay: Annotated[Section, Options(Relay)]


_OfCoefficients = section_for(DiscreteController)
_OfRelay = Annotated[Section, WithKey("relay", RelayControllerSection, _OfCoefficients)]
_OfContinuousPid = Annotated[Section, WithKey("continuous_pid", ContinuousPidControllerSection, _OfRelay)]


class LoopSection(Section):
    """What makes the input: a controller that is fed the output, and a reference.

    Parameters
    ----------
    controller : mapping
        Controller that acts at every sample: pid, continuous_pid, relay, or numerator and denominator
    reference : mapping, optional
        The reference, none for a relay; for a measured record it is a column, data.reference
    enters : {"controller", "input"}, default "controller"
        u = C(q) (reference - y), or u = reference - C(q) y
    """

    target: ClassVar[type | None] = LoopOptions

    controller: Annotated[Section, WithKey("pid", PidControllerSection, _OfContinuousPid)]
    reference: ExcitationSection | None = None
    enters: Annotated[Enters | list[Enters], Swept(Enters)] = "controller"

    def complaints(self) -> Iterator[Complaint]:
        """Say that the controller does nothing."""
        if any(_does_nothing(variant.options.controller) for variant in variants(self)):
            yield ("controller",), "the controller is zero, so there is no loop; give it a gain, or give excitation"


def _does_nothing(controller: DiscreteController | ContinuousPid | Relay) -> bool:
    if isinstance(controller, ContinuousPid):
        return controller.does_nothing
    return isinstance(controller, DiscreteController) and not controller.numerator.any()
