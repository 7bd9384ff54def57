"""Options of ``ctid fit`` and ``ctid order`` for the model, and the estimator that follows from them."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

from ctid_cli.cli._common import span
from ctid_cli.cli._options import flag
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import AskedHold, Hold, InitialState, InputBefore, LossKind, Offset, Weight

if TYPE_CHECKING:
    from ctid_cli.estimation.additive_problem import Instruments
    from ctid_cli.estimation.common import Bound, Fixed
    from ctid_cli.estimators.additive_output_error import AdditiveOutputError
    from ctid_cli.estimators.delay_profile import InputModel
    from ctid_cli.estimators.loop_output_error import LoopOutputError
    from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
    from ctid_cli.identification.choice import Given
    from ctid_cli.models.additive import Term
    from ctid_cli.signals.measurement import Measurement

#: What is known of a loop: nothing, its reference as an instrument, or reference and controller.
LoopUse = Literal["none", "reference", "controller"]
#: A loop with an unknown controller.
UNKNOWN = "unknown"
DIRECT = (
    "The model is fitted to the input as it was measured in the loop (direct method): that is right only if the noise "
    "model is (white noise of the output, or that of --noise), if there is a delay of a sample in the loop, and if the "
    "plant is stable."
)
#: One transfer function, or a sum of submodels.
ModelForm = Literal["fraction", "additive"]
FormOption = Annotated[ModelForm, flag("--model", "One transfer function, or a sum of submodels.")]
#: Numbers of second-order submodels among which a sum is chosen.
MODES = 1, 6
HoldOption = Annotated[AskedHold, flag("--hold", "Input between its samples; else chosen.")]


# --- options ---------------------------------------------------------------------------------------


def delay_range(text: str) -> tuple[float, float]:
    """Read a range of the delay; a single value is a known delay."""
    bounds = span(text, float)
    if bounds is not None and 0 <= bounds[0] <= bounds[1] < float("inf"):
        return bounds
    allowed = "LOW:HIGH, a range to search, or one known VALUE, in the record's unit of time and not negative"
    raise UsageError(f"--delay must be {allowed}, for example 0:2 or 0.3; got {text!r}")


def read_hold(text: str) -> AskedHold:
    """Read the hold of an input."""
    if text in get_args(AskedHold):
        return cast(AskedHold, text)
    allowed = f"{', '.join(get_args(AskedHold))}, or INPUT=HOLD for one of several inputs"
    raise UsageError(f"--hold must be one of {allowed}; got {text!r}")


def per_input(option: str, given: Sequence[str] | None) -> dict[str, Any]:
    """Read an option given for single inputs, INPUT=VALUE, or for all, as a value without a name."""
    found: dict[str, Any] = {}
    for text in given or ():
        name, _, value = (part.strip() for part in text.rpartition("="))
        if name in found:
            raise UsageError(f"{option} is given twice{f' for {name}' * bool(name)}; give it once")
        try:
            found[name] = OF_INPUTS[option](value)
        except ValueError:
            what = f"{option} must be a whole number, or INPUT=NUMBER for one of several inputs"
            raise UsageError(f"{what}; got {text!r}") from None
    return found


#: Options that can be given for single inputs, and how their values are read.
OF_INPUTS: dict[str, Callable[[str], Any]] = {
    "--poles": int,
    "--zeros": int,
    "--delay": delay_range,
    "--integrators": int,
    "--hold": read_hold,
}


@dataclass(frozen=True)
class StructureOptions:
    """Range of the delay, and poles at the origin."""

    delays: Annotated[
        list[str] | None,
        flag("--delay", "Range or value [time unit]; else chosen. INPUT=: of one input.", "[INPUT=]LOW:HIGH|VALUE"),
    ] = None
    each_integrators: Annotated[
        list[str] | None,
        flag("--integrators", "Additional poles at the origin (of a sum: in its first submodel).", "[INPUT=]N"),
    ] = None

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Range of the delay, a known one twice; None if it is not given for all inputs."""
        return per_input("--delay", self.delays).get("")

    @property
    def integrators(self) -> int | None:
        """Poles at the origin; None if they are not given for all inputs."""
        return per_input("--integrators", self.each_integrators).get("")


@dataclass(frozen=True)
class TreatmentOptions:
    """Treatment of the initial state and of offsets."""

    initial_state: Annotated[InitialState | None, flag("--initial-state", "State before the record; else chosen.")] = (
        None
    )
    input_before: Annotated[
        str | None, flag("--input-before", "Input before the first sample, at rest; else chosen.", "VALUE|first")
    ] = None
    offset: Annotated[Offset | None, flag("--offset", "Offset of the output, or its drift; else chosen.")] = None

    @property
    def level(self) -> InputBefore:
        """Input before the first sample; None if it is not given."""
        if self.input_before is None or self.input_before == "first":
            return "first" if self.input_before else None
        try:
            return float(self.input_before)
        except ValueError:
            raise UsageError(f"--input-before must be a number or first; got {self.input_before!r}") from None


@dataclass(frozen=True)
class ModelOptions(StructureOptions):
    """Model: one transfer function or a sum of submodels, its degrees, delay, and known parameters."""

    each_poles: Annotated[
        list[str] | None,
        flag(
            "--poles",
            "Poles, 1 to 12 (0 with --integrators); else chosen. INPUT=N: denominators of their own.",
            "[INPUT=]N",
        ),
    ] = None
    each_zeros: Annotated[list[str] | None, flag("--zeros", "Zeros, fewer than poles; else chosen.", "[INPUT=]N")] = (
        None
    )
    model: FormOption = "fraction"
    terms: Annotated[str | None, flag("--terms", "Poles/zeros of each submodel; else chosen.", "P/Z,P/Z,...")] = None
    fix: Annotated[list[str] | None, flag("--fix", "Hold a parameter; repeatable.", "NAME=VALUE")] = None
    bound: Annotated[
        list[str] | None,
        flag("--bound", "Bounds of a coefficient, delay, gain, time_constant or damping.", "NAME=LOW:HIGH"),
    ] = None

    @property
    def fixed(self) -> tuple[Fixed, ...] | None:
        """Known parameters."""
        from ctid_cli.estimation.common import Fixed

        found = []
        for text in self.fix or ():
            name, equals, value = (part.strip() for part in text.partition("="))
            if name == "delay":
                raise UsageError("--fix delay=VALUE is --delay VALUE; use that")
            try:
                found.append(Fixed(name, float(value if equals and name else "")))
            except ValueError:
                example = "for example a1=2"
                raise UsageError(f"--fix must be NAME=VALUE with a finite number, {example}; got {text!r}") from None
        return tuple(found) or None

    @property
    def parameter_bounds(self) -> tuple[Bound, ...] | None:
        """Bounds of parameters."""
        from ctid_cli.estimation.common import Bound

        found = []
        for text in self.bound or ():
            name, _, ends = (part.strip() for part in text.partition("="))
            both = span(ends, float) if ":" in ends else None
            if both is None or not name:
                example = "for example a1=0.5:2"
                raise UsageError(f"--bound must be NAME=LOW:HIGH with two numbers, {example}; got {text!r}")
            with as_usage_errors():
                found.append(Bound(name, *both))
        return tuple(found) or None

    @property
    def submodels(self) -> tuple[Term, ...]:
        """Terms of a sum, such as ``2/0,2/1``, or one transfer function; integrators belong to the first."""
        from ctid_cli.models.additive import Term

        parts = f"{self.poles}/{self.zeros or 0}" if self.terms is None else self.terms
        found: list[Term] = []
        for part in parts.split(","):
            degrees = re.fullmatch(r"\s*(\d{1,2})(?:/(\d{1,2}))?\s*", part)
            if degrees is None:
                allowed = "poles/zeros of each submodel with commas between them, for example 2/0,2/1"
                raise UsageError(f"--terms must be {allowed}; got {parts!r}")
            found.append(Term(int(degrees[1]), int(degrees[2] or 0), 0 if found else self.integrators or 0))
        return tuple(found)

    @property
    def poles(self) -> int | None:
        """Number of poles; None if it is not given for all inputs."""
        return per_input("--poles", self.each_poles).get("")

    @property
    def zeros(self) -> int | None:
        """Number of zeros; None if it is not given for all inputs."""
        return per_input("--zeros", self.each_zeros).get("")


@dataclass(frozen=True)
class LoopOptions:
    """Loop in which a record was taken."""

    loop: Annotated[
        str | None, flag("--loop", "YAML with the section loop of the record, if it is known.", "FILE|unknown")
    ] = None
    reference: Annotated[str | None, flag("--reference", "Column of the loop's reference.", "NAME")] = None
    direct: Annotated[bool, flag("--direct", "Fit to the input as if there were no loop: noise through it biases.")] = (
        False
    )

    @property
    def use(self) -> LoopUse:
        """What is known of the loop."""
        if self.direct or (self.loop in (None, UNKNOWN) and self.reference is None):
            return "none"
        return "reference" if self.loop in (None, UNKNOWN) else "controller"

    @cached_property
    def known(self) -> Any:
        """Loop of the file; None if there is none."""
        from ctid_cli.specification.load import load_loop

        return None if self.loop in (None, UNKNOWN) else load_loop(Path(self.loop or ""))

    def check(self) -> None:
        """Refuse incomplete loop options, and a file that contains no loop."""
        if self.direct and self.loop is None:
            raise UsageError(
                "--direct says how a record in a loop is fitted; add --loop FILE or --loop unknown, or drop it"
            )
        if self.known is not None and self.reference is None and not self.direct:
            raise UsageError(
                "--loop FILE needs the reference too; add --reference COLUMN, or --direct to fit without it"
            )

    def applied(self, measured: Measurement) -> Measurement:
        """Return a measurement in its loop, or with a note on the needs of the direct method."""
        if self.loop is None and self.reference is None:
            return measured
        from ctid_cli.simulation.record_loop import in_loop, in_unknown_loop

        if self.use == "controller":
            return in_loop(measured, self.known)
        if self.use == "reference":
            return in_unknown_loop(measured)
        return replace(measured, record=replace(measured.record, feedback=True), notes=(*measured.notes, DIRECT))


@dataclass(frozen=True)
class FitOptions(TreatmentOptions):
    """Treatment of the initial state, of offsets, of large errors, and hold of the input."""

    loss: Annotated[LossKind | None, flag("--loss", "Loss function of the output errors.")] = None
    noise: Annotated[str, flag("--noise", "Noise that is estimated with the model.", "white|arma:P,Q|auto")] = "white"
    each_hold: Annotated[
        list[str] | None,
        flag("--hold", "Input between its samples; else chosen.", "[INPUT=]auto|zoh|foh|band-limited"),
    ] = None
    weight: Annotated[Weight | None, flag("--weight", "Weights of a frequency response without standard errors.")] = (
        None
    )


# --- the estimator ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Asked:
    """Options of the model on the command line."""

    model: ModelOptions
    treatment: FitOptions
    #: What is known of the loop in which the record was taken.
    loop: LoopUse = "none"
    #: Names of several inputs, else empty.
    inputs: tuple[str, ...] = ()

    @property
    def each(self) -> dict[str, dict[str, Any]]:
        """Values given for single inputs, and for all, by option."""
        model = self.model
        texts = model.each_poles, model.each_zeros, model.delays, model.each_integrators, self.treatment.each_hold
        return {option: per_input(option, given) for option, given in zip(OF_INPUTS, texts, strict=True)}

    @property
    def hold(self) -> AskedHold | tuple[Hold, ...]:
        """Hold of the inputs; if it is given for single ones, that of each."""
        given = self.each["--hold"]
        if not {*given} - {""}:
            return cast(AskedHold, given.get("", "auto"))
        holds = tuple(given.get(name, given.get("", "zoh")) for name in self.inputs)
        if "auto" in holds:
            raise UsageError("--hold auto chooses one for all inputs; give INPUT=zoh, foh or band-limited")
        return holds

    @property
    def simulated(self) -> bool:
        """Whether the loop of one transfer function is simulated."""
        return self.loop == "controller" and self.model.model == "fraction"

    @property
    def iterated(self) -> bool:
        """Whether the estimator uses instruments from the loop, and needs a known delay."""
        return self.loop == "reference" or (self.model.model == "additive" and self.loop == "controller")

    @property
    def single(self) -> bool:
        """Whether the estimator takes one record."""
        return self.iterated or self.simulated


@contextlib.contextmanager
def as_usage_errors() -> Iterator[None]:
    """Turn errors about options of an estimator into a message about the command line."""
    try:
        yield
    except ValueError as error:
        raise UsageError(re.sub(r"^fixed\b", "--fix", re.sub(r"^noise_model\b", "--noise", str(error)))) from None


def options_of(asked: Asked) -> AdditiveOutputError | MeasuredSubmodels | LoopOutputError | Given:
    """Return the estimator, or the given options of a choice; a UsageError names contradicting options."""
    from ctid_cli.estimators.additive_output_error import AdditiveOutputError
    from ctid_cli.estimators.loop_output_error import LoopOutputError
    from ctid_cli.estimators.measured_submodels import MeasuredSubmodels

    model, treatment = asked.model, asked.treatment
    if treatment.weight is not None:
        raise UsageError("--weight is for a frequency response; the samples of a record weigh the same, drop --weight")
    _refuse_other_form(asked)
    _refuse_inputs(asked)
    for wrong, option, remedy in _unavailable(asked) if asked.single else ():
        if wrong:
            raise UsageError(f"{option} is not available for {_what(asked)}; {remedy}")
    needing = [("--loop", asked.simulated), ("--reference", asked.iterated)]
    for option in [name for name, given in needing if given][:1] if model.terms is None and model.poles is None else ():
        raise UsageError(f"{_degrees(model)} is missing: with {option} it must be given")
    state: Any = treatment.initial_state or "rest"
    offset: Any = treatment.offset or "none"
    bounds = model.bounds or (0.0, 0.0)
    with as_usage_errors():
        if asked.simulated:
            degrees = model.poles or 0, model.zeros or 0
            return LoopOutputError(*degrees, bounds, state, offset, model.integrators or 0)
        if asked.iterated:
            instruments: Instruments = "reference" if asked.loop == "reference" else "closed_loop"
            return MeasuredSubmodels(
                model.submodels,
                bounds[0],
                instruments,
                state,
                offset,
                factored=model.model == "additive" or bool(model.integrators),
                fixed=model.fixed,
            )
        if model.terms is not None:
            known: Any = {"fixed": model.fixed, "input_before": treatment.level, "noise_model": treatment.noise}
            return AdditiveOutputError(model.submodels, bounds, state, offset, treatment.loss or "squares", **known)
    return _given(asked)


def _degrees(model: ModelOptions) -> str:
    """Return the option that gives the degrees of a model."""
    return "--poles" if model.model == "fraction" else "--terms"


def with_delays(model: ModelOptions, inputs: Sequence[str]) -> ModelOptions:
    """Return the options with the delays of ``--fix`` and ``--bound`` among those of ``--delay``."""
    delays = tuple(f"{name}_delay=" for name in inputs)
    known = [text for text in model.fix or () if delays and text.startswith(delays)]
    ranges = [text for text in model.bound or () if text.startswith(("delay=", *delays))]
    if model.delays and any(text.startswith("delay=") for text in ranges):
        raise UsageError("--bound delay=LOW:HIGH is --delay LOW:HIGH; give one of them")
    known_delays = [text.removeprefix("delay=").replace("_delay=", "=", 1) for text in (*known, *ranges)]
    return replace(
        model,
        fix=[text for text in model.fix or () if text not in known] or None,
        bound=[text for text in model.bound or () if text not in ranges] or None,
        delays=[*(model.delays or ()), *known_delays] or None,
    )


def _given(asked: Asked) -> Given:
    """Return the given options of the choice, and of each of several inputs; ``--fix`` may give a delay too."""
    treatment = asked.treatment
    model = with_delays(asked.model, asked.inputs)
    bounds = model.parameter_bounds
    inputs = inputs_of(replace(asked, model=model))
    own_poles = [one.poles for one in inputs or () if one.poles is not None]
    own_zeros = any(one.zeros is not None for one in inputs or ())
    poles = model.poles if model.poles is not None else max(own_poles, default=None)
    needing = {"--fix": bool(model.fix), "--bound": bool(bounds), "the zeros of single inputs": own_zeros}
    for option, needed in needing.items():
        if needed and poles is None:
            raise UsageError(f"{_degrees(model)} is missing: with {option} it must be given")
    # The names of known parameters depend on the number of zeros.
    zeros = 0 if model.zeros is None and (model.fix or bounds or own_poles or own_zeros) else model.zeros
    given = replace(given_of(model, treatment, asked.hold), poles=poles, zeros=zeros, fixed=model.fixed, bounds=bounds)
    if model.model == "additive":
        given = replace(given, modes=MODES)
    return replace(given, loss=treatment.loss, noise_model=treatment.noise, inputs=inputs)


def given_of(structure: StructureOptions, treatment: TreatmentOptions, hold: AskedHold | tuple[Hold, ...]) -> Given:
    """Return the given options of the choice."""
    from ctid_cli.identification.choice import Given

    if structure.integrators is not None:
        check_integrators(structure.integrators, treatment.offset or "none")
    return Given(
        integrators=structure.integrators,
        delay_bounds=structure.bounds,
        initial_state=treatment.initial_state,
        offset=treatment.offset,
        input_before=treatment.level,
        hold=hold,
    )


def inputs_of(asked: Asked) -> tuple[InputModel, ...] | None:
    """Return the given options of each of several inputs."""
    from ctid_cli.estimators.delay_profile import InputModel

    if not asked.inputs:
        return None
    own = asked.each
    poles = [name for name in own["--poles"] if name]
    missing = [name for name in asked.inputs if name not in poles]
    if poles and asked.model.poles is None and missing:
        raise UsageError(f"--poles is given for {', '.join(poles)} and not for {', '.join(missing)}")
    options = {"poles": "--poles", "zeros": "--zeros", "delay_bounds": "--delay", "integrators": "--integrators"}
    return tuple(
        InputModel(name, **{field: own[option][name] for field, option in options.items() if name in own[option]})
        for name in asked.inputs
    )


def _refuse_inputs(asked: Asked) -> None:
    """Refuse options of inputs that the record does not have, and those not available for several."""
    for option, values in asked.each.items():
        for name in {*values} - {"", *asked.inputs}:
            named = f"the inputs are {', '.join(asked.inputs)}" if asked.inputs else "name several with --input"
            raise UsageError(f"{option} is given for {name!r}, which is no input; {named}")
    if not asked.inputs:
        return
    if asked.model.model == "additive":
        raise UsageError("--model additive has one input; give one --input, or drop --model")
    if asked.loop != "none":
        raise UsageError(
            "a record in a loop is fitted with one input; give one --input, or drop --loop and --reference"
        )


def check_integrators(integrators: int, offset: Offset, instead: str = "--offset") -> None:
    """Refuse invalid numbers of integrators, and a mean with integrators; another option estimates a constant."""
    from ctid_cli.estimation.common import MOST_INTEGRATORS

    if not 0 <= integrators <= MOST_INTEGRATORS:
        raise UsageError(f"--integrators must be 0 to {MOST_INTEGRATORS}; got {integrators}")
    why = {
        "remove": "subtracts the mean of the output, which is no offset of a system that integrates",
        "drift": "is a slope of the output, which a system that integrates has by itself",
    }
    if integrators and offset in why:
        raise UsageError(f"--offset {offset} {why[offset]}; use {instead} estimate")


def _refuse_other_form(asked: Asked) -> None:
    """Refuse options of one form of the model with those of the other."""
    model = asked.model
    if model.model == "additive":
        for name, value in (("--poles", model.poles), ("--zeros", model.zeros)):
            if value is not None:
                raise UsageError(f"{name} is for one transfer function; --terms has the degrees of a sum, drop {name}")
        if model.bound:
            raise UsageError("--bound is for one transfer function, not for a sum of submodels; drop --bound")
    elif model.terms is not None:
        raise UsageError("--terms is for a sum of submodels; add --model additive, or give --poles and --zeros")
    instead = "--initial-state" if asked.single else "--offset"
    check_integrators(model.integrators or 0, asked.treatment.offset or "none", instead)


def _what(asked: Asked) -> str:
    """Return the purpose of an estimator of one record."""
    if asked.loop == "reference":
        return "the reference as an instrument"
    return "a record in a loop" if asked.simulated else "a sum of submodels in a loop"


def _unavailable(asked: Asked) -> Iterator[tuple[bool, str, str]]:
    """Yield what submodels and simulated loops do not support: whether it is requested, the option, and a remedy."""
    model, treatment = asked.model, asked.treatment
    state, offset, hold = treatment.initial_state, treatment.offset, asked.hold
    low, high = model.bounds or (0.0, 0.0)
    yield treatment.input_before is not None, "--input-before", "use --initial-state estimate"
    yield treatment.loss not in (None, "squares"), f"--loss {treatment.loss}", "drop --loss"
    direct = "drop --noise, or fit to the input with --direct"
    yield treatment.noise != "white", f"--noise {treatment.noise}", direct
    one_fraction = model.model == "fraction" and not (asked.iterated and model.integrators)
    names = "its names are those of submodels: add --model additive --terms POLES/ZEROS"
    yield bool(model.fix) and one_fraction, "--fix", names
    yield bool(model.bound), "--bound", "drop --bound, or fit to the input with --direct"
    if asked.simulated:
        yield state == "periodic", "--initial-state periodic", "use rest or estimate"
        yield offset == "drift", "--offset drift", "use estimate, remove or none"
        return
    controller = "; with the controller (--loop FILE) it can be searched" * (asked.loop == "reference")
    one_value = f"the delay must be known: give one value, --delay VALUE{controller}"
    yield low < high, f"a search of the delay (--delay {low:g}:{high:g})", one_value
    yield offset in ("estimate", "drift"), f"--offset {offset}", "use --offset remove"
    yield hold not in ("auto", "zoh"), f"--hold {hold}", "a discrete controller holds its input: use zoh"
