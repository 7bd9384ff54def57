"""Options of ``ctid fit`` and ``ctid order`` that say what the model is, and the estimator that they ask for."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, TypeVar

import typer

from ctid_cli.cli._common import span
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import AskedHold, InitialState, InputBefore, LossKind, Offset

if TYPE_CHECKING:
    from ctid_cli.estimation.additive_problem import Instruments
    from ctid_cli.estimation.common import Fixed
    from ctid_cli.estimators.delay_profile import InputModel
    from ctid_cli.estimators.loop_output_error import LoopOutputError
    from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
    from ctid_cli.identification.choice import Given
    from ctid_cli.models.additive import Term
    from ctid_cli.signals.measurement import Measurement

#: What of a loop an estimate is made with: nothing, its reference as an instrument, or reference and controller.
LoopUse = Literal["none", "reference", "controller"]
#: A loop whose controller is not known.
UNKNOWN = "unknown"
DIRECT = (
    "The model is fitted to the input as it was measured in the loop (direct method): that is right only if the noise "
    "model is (white noise of the output, or that of --noise) and if there is a delay of a sample in the loop."
)
#: One transfer function, or a sum of submodels.
ModelForm = Literal["fraction", "additive"]
T = TypeVar("T")
HoldOption = Annotated[AskedHold, typer.Option("--hold", help="Input between its samples; else chosen.")]


@dataclass(frozen=True)
class PerInput(Generic[T]):
    """What an option says of all inputs, and of single ones."""

    shared: T | None
    own: dict[str, T]


def per_input(option: str, given: Sequence[str] | None, read: Callable[[str], T]) -> PerInput[T]:
    """Read an option that is given for all inputs, or as INPUT=VALUE for single ones."""
    shared: T | None = None
    own: dict[str, T] = {}
    for text in given or ():
        name, equals, value = (part.strip() for part in text.rpartition("="))
        try:
            found = read(value)
        except ValueError:
            what = f"{option} must be a whole number, or INPUT=NUMBER for one of several inputs"
            raise UsageError(f"{what}; got {text!r}") from None
        if (equals and name in own) or (not equals and shared is not None):
            raise UsageError(f"{option} is given twice{f' for {name}' * bool(equals)}; give it once")
        if equals:
            own[name] = found
        else:
            shared = found
    return PerInput(shared, own)


@dataclass(frozen=True)
class StructureOptions:
    """Range of the delay, and poles at the origin."""

    delays: Annotated[
        list[str] | None,
        typer.Option(
            "--delay",
            metavar="[INPUT=]LOW:HIGH|VALUE",
            help="Range or value [time unit]; else chosen. Of one of several inputs: INPUT=...",
        ),
    ] = None
    each_integrators: Annotated[
        list[str] | None,
        typer.Option(
            "--integrators",
            metavar="[INPUT=]N",
            help="Additional poles at the origin (of a sum: in its first submodel); else chosen.",
        ),
    ] = None

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Range of the delay, a known one twice; None where it is not given for all inputs."""
        return per_input("--delay", self.delays, delay_bounds).shared

    @property
    def integrators(self) -> int | None:
        """Poles at the origin; None where they are not given for all inputs."""
        return per_input("--integrators", self.each_integrators, int).shared


@dataclass(frozen=True)
class TreatmentOptions:
    """Treatment of the initial state and of offsets."""

    initial_state: Annotated[
        InitialState | None, typer.Option("--initial-state", help="State before the record; else chosen.")
    ] = None
    input_before: Annotated[
        str | None,
        typer.Option(
            "--input-before", metavar="VALUE|first", help="Input before the first sample, at rest; else chosen."
        ),
    ] = None
    offset: Annotated[
        Offset | None, typer.Option("--offset", help="Offset of the output, or its drift; else chosen.")
    ] = None

    @property
    def level(self) -> InputBefore:
        """The input before the first sample; None where it is not given."""
        if self.input_before in (None, "first"):
            return "first" if self.input_before else None
        try:
            return float(self.input_before or "")
        except ValueError:
            raise UsageError(f"--input-before must be a number or first; got {self.input_before!r}") from None


@dataclass(frozen=True)
class ModelOptions(StructureOptions):
    """What the model is: one transfer function or a sum of submodels, its degrees, delay, and known parameters."""

    each_poles: Annotated[
        list[str] | None,
        typer.Option(
            "--poles",
            metavar="[INPUT=]N",
            help="Poles, 1 to 12 (0 with --integrators); else chosen. INPUT=N: denominators of their own.",
        ),
    ] = None
    each_zeros: Annotated[
        list[str] | None,
        typer.Option("--zeros", metavar="[INPUT=]N", help="Zeros, fewer than poles; else chosen."),
    ] = None
    model: Annotated[ModelForm, typer.Option("--model", help="One transfer function, or a sum of submodels.")] = (
        "fraction"
    )
    terms: Annotated[
        str | None, typer.Option("--terms", metavar="P/Z,P/Z,...", help="Poles/zeros of each submodel.")
    ] = None
    fix: Annotated[
        list[str] | None, typer.Option("--fix", metavar="NAME=VALUE", help="Hold a parameter; repeatable.")
    ] = None

    @property
    def poles(self) -> int | None:
        """Number of poles; None where it is not given for all inputs."""
        return per_input("--poles", self.each_poles, int).shared

    @property
    def zeros(self) -> int | None:
        """Number of zeros; None where it is not given for all inputs."""
        return per_input("--zeros", self.each_zeros, int).shared


@dataclass(frozen=True)
class LoopOptions:
    """The loop that a record was taken in."""

    loop: Annotated[
        str | None,
        typer.Option(
            "--loop", metavar="FILE|unknown", help="YAML with the section loop of the record, if it is known."
        ),
    ] = None
    reference: Annotated[
        str | None, typer.Option("--reference", metavar="NAME", help="Column of the loop's reference.")
    ] = None
    direct: Annotated[
        bool, typer.Option("--direct", help="Fit to the input as if there were no loop: noise through it biases.")
    ] = False

    @property
    def use(self) -> LoopUse:
        """What of the loop an estimate is made with."""
        if self.direct or (self.loop in (None, UNKNOWN) and self.reference is None):
            return "none"
        return "reference" if self.loop in (None, UNKNOWN) else "controller"

    def check(self) -> None:
        """Refuse half of what a loop needs."""
        if self.loop not in (None, UNKNOWN) and self.reference is None and not self.direct:
            raise UsageError(
                "--loop FILE needs the reference too; add --reference COLUMN, or --direct to fit without it"
            )
        if self.direct and self.loop is None:
            raise UsageError(
                "--direct says how a record in a loop is fitted; add --loop FILE or --loop unknown, or drop it"
            )

    def applied(self, measured: Measurement) -> Measurement:
        """Return a measurement in its loop, or with a note on what the direct method asks for."""
        if self.loop is None and self.reference is None:
            return measured
        from ctid_cli.simulation.record_loop import in_loop, in_unknown_loop
        from ctid_cli.specification.load import load_loop

        options = None if self.loop in (None, UNKNOWN) else load_loop(Path(self.loop or ""))
        if self.use == "controller" and options is not None:
            return in_loop(measured, options)
        if self.use == "reference":
            return in_unknown_loop(measured)
        return replace(measured, record=replace(measured.record, feedback=True), notes=(*measured.notes, DIRECT))


@dataclass(frozen=True)
class FitOptions(TreatmentOptions):
    """Treatment of the initial state and of offsets, of large errors, and of the input between its samples."""

    loss: Annotated[LossKind, typer.Option("--loss", help="Loss function of the output errors.")] = "squares"
    noise: Annotated[
        str, typer.Option("--noise", metavar="white|arma:P,Q|auto", help="Noise that is estimated with the model.")
    ] = "white"
    hold: HoldOption = "auto"


@dataclass(frozen=True)
class Asked:
    """What the command line says of the model."""

    model: ModelOptions
    treatment: FitOptions
    #: What of the loop that the record was taken in counts.
    loop: LoopUse = "none"
    #: Names of several inputs, else empty.
    inputs: tuple[str, ...] = ()

    @property
    def simulated(self) -> bool:
        """Whether the loop of one transfer function is simulated."""
        return self.loop == "controller" and self.model.model == "fraction"

    @property
    def iterated(self) -> bool:
        """Whether the estimator is that of submodels, which knows the delay."""
        return self.model.model == "additive" or self.loop == "reference"

    @property
    def single(self) -> bool:
        """Whether the estimator takes one record."""
        return self.iterated or self.simulated

    @property
    def delay(self) -> tuple[float, float]:
        """The range of the delay of submodels."""
        return self.model.bounds or (0.0, 0.0)

    @property
    def integrators(self) -> int:
        """Poles at the origin."""
        return self.model.integrators or 0


@contextlib.contextmanager
def as_usage_errors() -> Iterator[None]:
    """Turn what options of an estimator refuse into a message about the command line."""
    try:
        yield
    except ValueError as error:
        raise UsageError(re.sub(r"^fixed\b", "--fix", re.sub(r"^noise_model\b", "--noise", str(error)))) from None


def options_of(asked: Asked) -> MeasuredSubmodels | LoopOutputError | Given:
    """Return the estimator, or what of it is given; a UsageError says which options do not go together."""
    _refuse_other_form(asked)
    _refuse_inputs(asked)
    if asked.simulated:
        return _in_loop(asked)
    if not asked.iterated:
        return _given(asked)
    _refuse_unable(asked)
    with as_usage_errors():
        return _submodels(asked)


def given_of(structure: StructureOptions, treatment: TreatmentOptions, hold: AskedHold) -> Given:
    """Return what is given of the choice."""
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


def _given(asked: Asked) -> Given:
    model, treatment = asked.model, asked.treatment
    delays = [f"{name}_delay=" for name in asked.inputs]
    known = [text.replace("_delay=", "=", 1) for text in model.fix or () if text.startswith(tuple(delays))]
    model = replace(
        model,
        fix=[text for text in model.fix or () if not text.startswith(tuple(delays))] or None,
        delays=[*(model.delays or ()), *known] or None,
    )
    fixed, inputs = _fixed(model.fix), inputs_of(model, asked.inputs)
    own = [one.poles for one in inputs or () if one.poles is not None]
    if inputs and any(one.zeros is not None for one in inputs) and model.poles is None and not own:
        raise UsageError("--poles is missing: with the zeros of single inputs it must be given")
    poles = model.poles if model.poles is not None else max(own, default=None)
    if fixed and poles is None:
        raise UsageError("--poles is missing: with --fix it must be given")
    # The names of known parameters are those of a number of zeros.
    zeros = 0 if (fixed or own or (inputs and any(one.zeros is not None for one in inputs))) else None
    zeros = zeros if model.zeros is None else model.zeros
    given = given_of(model, treatment, treatment.hold)
    given = replace(given, poles=poles, zeros=zeros, loss=treatment.loss, fixed=fixed, noise_model=treatment.noise)
    return replace(given, inputs=inputs)


def inputs_of(model: ModelOptions, names: Sequence[str]) -> tuple[InputModel, ...] | None:
    """Return what is given of each of several inputs."""
    from ctid_cli.estimators.delay_profile import InputModel

    each: dict[str, PerInput[Any]] = {
        "poles": per_input("--poles", model.each_poles, int),
        "zeros": per_input("--zeros", model.each_zeros, int),
        "delay_bounds": per_input("--delay", model.delays, delay_bounds),
        "integrators": per_input("--integrators", model.each_integrators, int),
    }
    if not names:
        return None
    poles = each["poles"]
    missing = [name for name in names if name not in poles.own]
    if poles.own and poles.shared is None and missing:
        raise UsageError(f"--poles is given for {', '.join(poles.own)} and not for {', '.join(missing)}")
    return tuple(
        InputModel(name, **{field: one.own[name] for field, one in each.items() if name in one.own}) for name in names
    )


def _in_loop(asked: Asked) -> LoopOutputError:
    from ctid_cli.estimators.loop_output_error import LoopOutputError

    _refuse_of_loop(asked)
    if asked.model.poles is None:
        raise UsageError("--poles is missing: with --loop it must be given")
    if asked.model.fix:
        raise UsageError("--fix in a loop goes by the names of submodels; add --model additive --terms POLES/ZEROS")
    state, offset = asked.treatment.initial_state or "rest", asked.treatment.offset or "none"
    if state == "periodic":
        raise UsageError("--initial-state periodic is not available for a record in a loop; use rest or estimate")
    if offset == "drift":
        raise UsageError("--offset drift is not available for a record in a loop; use estimate, remove or none")
    with as_usage_errors():
        degrees = asked.model.poles, asked.model.zeros or 0
        return LoopOutputError(*degrees, asked.delay, state, offset, asked.integrators)


def _submodels(asked: Asked) -> MeasuredSubmodels:
    from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
    from ctid_cli.models.additive import Term

    if asked.model.terms is None:
        if asked.model.poles is None:
            raise UsageError("--poles is missing: with --reference it must be given")
        terms: tuple[Term, ...] = (Term(asked.model.poles, asked.model.zeros or 0, asked.integrators),)
    else:
        first, *others = _terms(asked.model.terms, asked.integrators)
        terms = (first, *others)
    instruments: Instruments = "closed_loop" if asked.loop == "controller" else "open_loop"
    instruments = "reference" if asked.loop == "reference" else instruments
    return MeasuredSubmodels(
        terms,
        asked.delay[0],
        instruments,
        asked.treatment.initial_state or "rest",
        asked.treatment.offset or "none",
        factored=asked.model.model == "additive" or asked.integrators > 0,
        fixed=_fixed(asked.model.fix),
    )


def _refuse_inputs(asked: Asked) -> None:
    """Options of single inputs that the record does not have, and what is not available for several."""
    model = asked.model
    for option, texts in (
        ("--poles", model.each_poles),
        ("--zeros", model.each_zeros),
        ("--delay", model.delays),
        ("--integrators", model.each_integrators),
    ):
        for text in texts or ():
            name, equals, _ = text.rpartition("=")
            if equals and name not in asked.inputs:
                named = f"the inputs are {', '.join(asked.inputs)}" if asked.inputs else "name several with --input"
                raise UsageError(f"{option} {text} is for an input {name!r}; {named}")
    if len(asked.inputs) > 1 and asked.model.model == "additive":
        raise UsageError("--model additive has one input; give one --input, or drop --model")
    if len(asked.inputs) > 1 and asked.loop != "none":
        raise UsageError(
            "a record in a loop is fitted with one input; give one --input, or drop --loop and --reference"
        )


def _refuse_other_form(asked: Asked) -> None:
    """Options of one form of the model beside those of the other."""
    if asked.model.model == "additive":
        if asked.model.terms is None:
            raise UsageError(
                "--model additive needs --terms, poles/zeros of each submodel, for example --terms 2/0,2/1"
            )
        for name, value in (("--poles", asked.model.poles), ("--zeros", asked.model.zeros)):
            if value is not None:
                raise UsageError(f"{name} is for one transfer function; --terms has the degrees of a sum, drop {name}")
    elif asked.model.terms is not None:
        raise UsageError("--terms is for a sum of submodels; add --model additive, or give --poles and --zeros")
    instead = "--initial-state" if asked.single else "--offset"
    check_integrators(asked.integrators, asked.treatment.offset or "none", instead)


def check_integrators(integrators: int, offset: Offset, instead: str = "--offset") -> None:
    """Refuse numbers of integrators, and what they make of a mean; a constant is estimated by another option."""
    from ctid_cli.estimation.common import MOST_INTEGRATORS

    if not 0 <= integrators <= MOST_INTEGRATORS:
        raise UsageError(f"--integrators must be 0 to {MOST_INTEGRATORS}; got {integrators}")
    if integrators and offset == "remove":
        raise UsageError(
            "--offset remove subtracts the mean of the output, which is no offset of a system that integrates; use "
            f"{instead} estimate"
        )
    if integrators and offset == "drift":
        raise UsageError(
            "--offset drift is a slope of the output, which a system that integrates has by itself; use "
            f"{instead} estimate"
        )


def _refuse_unable(asked: Asked) -> None:
    """What refined instrumental variables at a known delay cannot do."""
    in_loop = asked.loop != "none"
    what = "a record in a loop" if in_loop else "a sum of submodels"
    what = "the reference as an instrument" if asked.loop == "reference" else what
    low, high = asked.delay
    if low < high:
        instead = "; with the controller (--loop FILE) it can be searched" * (asked.loop == "reference")
        raise UsageError(
            f"--delay {low:g}:{high:g} cannot be searched for {what}: a known delay is needed; give one value, "
            f"--delay VALUE{instead}"
        )
    _refuse_of_loop(asked, what)
    if asked.treatment.offset in ("estimate", "drift"):
        raise UsageError(f"--offset {asked.treatment.offset} is not available for {what}; use --offset remove")
    if in_loop and asked.treatment.hold not in ("auto", "zoh"):
        raise UsageError(
            f"--hold {asked.treatment.hold} does not go with --reference: a discrete controller holds its input (zoh)"
        )
    if in_loop and asked.model.fix and asked.model.model == "fraction" and not asked.integrators:
        raise UsageError("--fix in a loop goes by the names of submodels; add --model additive --terms POLES/ZEROS")


def _refuse_of_loop(asked: Asked, what: str = "a record in a loop") -> None:
    """What neither submodels nor simulated loops can do."""
    if asked.treatment.input_before is not None:
        raise UsageError(f"--input-before is not available for {what}; use --initial-state estimate")
    if asked.treatment.loss != "squares":
        why = "it is fitted by squares"
        raise UsageError(f"--loss {asked.treatment.loss} is not available for {what}: {why}; drop --loss")
    if asked.treatment.noise != "white":
        direct = ", or fit to the input with --direct" * (asked.loop != "none")
        raise UsageError(f"--noise {asked.treatment.noise} is not available for {what}; drop --noise{direct}")


def _terms(text: str, integrators: int) -> list[Term]:
    """Terms such as ``2/0,2/1``; integrators belong to the first."""
    from ctid_cli.models.additive import Term

    found = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,2})(?:/(\d{1,2}))?\s*", part)
        if match is None:
            allowed = "poles/zeros of each submodel with commas between them, for example 2/0,2/1"
            raise UsageError(f"--terms must be {allowed}; got {text!r}")
        found.append((int(match[1]), int(match[2] or 0)))
    return [Term(*degrees, integrators * (k == 0)) for k, degrees in enumerate(found)]


def _fixed(given: Sequence[str] | None) -> tuple[Fixed, ...] | None:
    from ctid_cli.estimation.common import Fixed

    found = []
    for text in given or ():
        name, equals, value = (part.strip() for part in text.partition("="))
        if name == "delay":
            raise UsageError("--fix delay=VALUE is --delay VALUE; use that")
        try:
            found.append(Fixed(name, float(value if equals and name else "")))
        except ValueError:
            raise UsageError(f"--fix must be NAME=VALUE with a finite number, for example a1=2; got {text!r}") from None
    return tuple(found) or None


def delay_bounds(text: str) -> tuple[float, float]:
    """The range of the delay, or a known one twice."""
    bounds = span(text, float)
    if bounds is not None and 0 <= bounds[0] <= bounds[1] < float("inf"):
        return bounds
    allowed = "LOW:HIGH, a range to search, or one known VALUE, in the record's unit of time and not negative"
    raise UsageError(f"--delay must be {allowed}, for example 0:2 or 0.3; got {text!r}")
