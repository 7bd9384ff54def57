"""Sections of the simulated system, of the loop, and of the starts of estimators."""

from collections.abc import Iterator, Mapping
from decimal import Decimal
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field

from ctid_cli.canonical import content_hash
from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import ContinuousController, ContinuousPid, DiscreteController, Relay
from ctid_cli.models.several_inputs import parameters_of
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Enters
from ctid_cli.simulation.components import is_custom
from ctid_cli.simulation.dataset import LoopOptions
from ctid_cli.simulation.start_points import StartPoint
from ctid_cli.specification.custom_sections import Kinds, custom_form
from ctid_cli.specification.messages import Violation
from ctid_cli.specification.sections import Options, Section, WithKey, section_for
from ctid_cli.specification.sweeps import Variant, variants
from ctid_cli.specification.values import ByShape, Coefficients, NotNegative, Number, OneOf, Swept, without_copies

#: Highest order for which the simulation has its stated accuracy.
MAX_ORDER = 12

ExcitationSection = Annotated[Section, Kinds("excitation", custom="excitation")]


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

    def violations(self) -> Iterator[Violation]:
        """Yield the reason why the system cannot be simulated."""
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

    def violations(self) -> Iterator[Violation]:
        """Yield the reason why the submodel is invalid."""
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
        """Return the sum."""
        try:
            return AdditiveModel(self.part("additive"), getattr(self, "delay", 0.0))
        except DataError as error:
            raise DataError(str(error), "additive") from None


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

    def violations(self) -> Iterator[Violation]:
        """Yield the reason why the system cannot be simulated."""
        for k, section in enumerate(self.additive):
            submodel = section.options()
            if submodel.order > MAX_ORDER:
                yield ("additive", k), f"{submodel.order} poles are too many; at most {MAX_ORDER} can be simulated"


_OF_SEVERAL = "is for a system with one input; of several inputs give each its numerator, denominator and delay"


class PartSection(SystemSection):
    """The transfer function from one of several inputs to the output, strictly proper and stable."""

    elsewhere = {"additive": _OF_SEVERAL, "kind": _OF_SEVERAL}  # noqa: RUF012 - of the base class


class InputSection(Section):
    """One of several inputs, and its transfer function.

    Parameters
    ----------
    system : mapping
        Transfer function from this input to the output; the output is the sum over all inputs
    excitation : mapping
        This input
    """

    system: PartSection
    excitation: ExcitationSection


_LinearSystem = Annotated[Any, WithKey("additive", AdditiveSystemSection, SystemSection)]
AnySystemSection = Annotated[Any, WithKey("kind", custom_form("system"), _LinearSystem)]


def truth_of(system: Variant) -> dict[str, float]:
    """Return the true values of a system variant; in custom ones, option names are replaced by their values."""
    if not is_custom(system.options):
        return parameters_of(system.options)
    truth = system.values["truth"].items()
    return {name: system.values[value] if isinstance(value, str) else value for name, value in truth}


# --------------------------------------------------------------------------------------------------------------------
# Loops


_Gain = Annotated[float | list[float], Swept(Number)]
_CONTROLLERS = ("pid", "continuous_pid", "continuous", "relay", "numerator", "denominator")


def _other_forms(form: str) -> dict[str, str]:
    """Return the messages for keys of the other forms of a controller."""
    twice = f"gives the controller a second time, '{form}' has it already; keep one of the forms"
    return {key: twice for key in _CONTROLLERS if key != form}


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
        """Return the controller."""
        return DiscreteController.from_pid(**self.model_dump())


class ControllerSection(Section):
    """A controller in one of several forms, selected by its key."""

    def build(self) -> Any:
        """Return the controller."""
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


class ContinuousControllerSection(ControllerSection):
    """A controller that acts in continuous time.

    Parameters
    ----------
    continuous : mapping
        Numerator and denominator in descending powers of s
    """

    target: ClassVar[type | None] = ContinuousController
    elsewhere = _other_forms("continuous")

    continuous: section_for(ContinuousController)  # type: ignore[valid-type]


class UnknownControllerSection(ControllerSection):
    """An unknown controller, written as ``loop: unknown``.

    Parameters
    ----------
    unknown : bool
        Always true
    """

    target: ClassVar[type | None] = None
    elsewhere = _other_forms("unknown")

    unknown: Literal[True]

    def build(self) -> None:
        """Return no controller."""


class RelayControllerSection(ControllerSection):
    """A relay, with which the loop oscillates.

    Parameters
    ----------
    relay : mapping
        Output values and hysteresis of the relay
    """

    target: ClassVar[type | None] = Relay
    elsewhere = _other_forms("relay")

    relay: Annotated[Section, Options(Relay)]


_OfCoefficients = section_for(DiscreteController)
_OfRelay = Annotated[Section, WithKey("relay", RelayControllerSection, _OfCoefficients)]
_OfContinuousPid = Annotated[Section, WithKey("continuous_pid", ContinuousPidControllerSection, _OfRelay)]
_OfContinuous = Annotated[Section, WithKey("continuous", ContinuousControllerSection, _OfContinuousPid)]
_OfKnown = Annotated[Section, WithKey("pid", PidControllerSection, _OfContinuous)]


def loop_as_mapping(given: Any) -> Any:
    """Return the section of a loop; for the word unknown, that of an unknown controller."""
    return {"controller": {"unknown": True}} if given == "unknown" else given


class LoopSection(Section):
    """A feedback loop: a controller with the output as feedback, and a reference.

    Parameters
    ----------
    controller : mapping
        Controller that acts at every sample: pid, continuous_pid, relay, or numerator and denominator; or continuous
    reference : mapping, optional
        The reference, none for a relay; for a measured record it is a column, data.reference
    enters : {"controller", "input"}, default "controller"
        u = C(q) (reference - y), or u = reference - C(q) y
    """

    target: ClassVar[type | None] = LoopOptions

    controller: Annotated[Section, WithKey("unknown", UnknownControllerSection, _OfKnown)]
    reference: ExcitationSection | None = None
    enters: Annotated[Enters | list[Enters], Swept(Enters)] = "controller"

    def violations(self) -> Iterator[Violation]:
        """Yield a controller without any effect."""
        if any(_does_nothing(variant.options.controller) for variant in variants(self)):
            yield ("controller",), "the controller is zero, so there is no loop; give it a gain, or give excitation"


def _does_nothing(controller: DiscreteController | ContinuousController | ContinuousPid | Relay) -> bool:
    if isinstance(controller, ContinuousPid):
        return controller.does_nothing
    return isinstance(controller, DiscreteController | ContinuousController) and not controller.numerator.any()


# --------------------------------------------------------------------------------------------------------------------
# Starts


class UniformStart(Section):
    """A random initial delay for every data set.

    Parameters
    ----------
    uniform : list of float
        least and greatest value [s]
    """

    uniform: Annotated[list[NotNegative], Field(min_length=2, max_length=2)]

    def violations(self) -> Iterator[Violation]:
        """Yield the reason why the range is invalid."""
        low, high = self.uniform
        if not low < high:
            yield ("uniform",), f"the first value, {low:g} s, must be below the second, {high:g} s"


class RelativeStart(Section):
    """Random initial parameters for every data set, around those of the simulated system.

    Parameters
    ----------
    relative_uniform : float
        Half-width r of the random factor of every parameter, uniform from 1 - r to 1 + r [-]
    """

    # Below 1, parameters keep their signs.
    relative_uniform: float = Field(gt=0.0, lt=1.0, allow_inf_nan=False)


class GivenStart(AdditiveSection):
    """Initial parameters as a sum of submodels."""


def _form(value: Any) -> str | None:
    given = value if isinstance(value, Mapping) else ()
    found = [name for name, form in _FORMS.items() if isinstance(value, form) or name in given]
    return found[0] if len(found) == 1 else None


def _several(one: OneOf) -> ByShape:
    """Return the annotation of a start or a list of different ones."""
    item = Annotated[Any, one]
    return ByShape(item, list=Annotated[list[item], Field(min_length=1), AfterValidator(without_copies)])


_DELAYS = _several(ByShape(NotNegative, "{uniform: [low, high]} is allowed too", mapping=UniformStart))
_FORMS = {"relative_uniform": RelativeStart, "additive": GivenStart}
_PARAMETERS = _several(OneOf(_form, _FORMS, "no_form", "{relative_uniform: fraction} or {additive: [submodels]}"))
_LISTED = AfterValidator(lambda value: value if isinstance(value, list) else [value])


class StartsSection(Section):
    """Starts of the estimators that need, or accept, an initial delay or initial parameters.

    Parameters
    ----------
    initial_delay : float, mapping or list of these, optional
        Initial delays [s]; {uniform: [low, high]} draws one for every data set
    parameters : mapping or list of mappings, optional
        Initial parameters, drawn around those of the simulated system or given; by default every estimator makes its
        own
    """

    if_empty = "give initial_delay, parameters or both, or leave the section out"

    initial_delay: Annotated[list[float | UniformStart], _DELAYS, _LISTED] | None = None
    parameters: Annotated[list[RelativeStart | GivenStart], _PARAMETERS, _LISTED] | None = None


def start_points(section: StartsSection | None) -> tuple[StartPoint, ...]:
    """Return the starts in a specification."""
    if section is None:
        return ()
    points: list[StartPoint] = []
    for delay in section.initial_delay or []:
        if isinstance(delay, UniformStart):
            low, high = delay.uniform
            points.append(StartPoint(f"uniform({_short(low)}, {_short(high)})", "delay", "random", (low, high)))
        else:
            points.append(StartPoint(_short(delay), "delay", delay))
    for parameters in section.parameters or []:
        values = parameters.model_dump(mode="json")
        if isinstance(parameters, RelativeStart):
            spread = parameters.relative_uniform
            points.append(StartPoint(f"parameters({_percent(spread)}%)", "parameters", spread=spread))
        else:
            points.append(StartPoint(f"given {content_hash(values)[:8]}", "parameters", model=parameters.options()))
    return tuple(points)


def _short(value: float) -> str:
    """Return the shortest text that represents the number exactly, without a trailing ``.0``."""
    return repr(value).removesuffix(".0")


def _percent(value: float) -> str:
    """Return a fraction in percent with the precision in which it was written."""
    return f"{(100 * Decimal(repr(value))).normalize():f}"
