"""Options of ``ctid fit`` and ``ctid order`` for the model, and the estimator that follows from them."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast, get_args

import typer

from ctid_cli.cli._common import span
from ctid_cli.cli._options import finite, flag, given_options, refuse_options
from ctid_cli.cli.loop_options import LoopOptions
from ctid_cli.errors import OptionError, UsageError
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

#: One transfer function, or a sum of submodels.
ModelForm = Literal["fraction", "additive"]
FormOption = Annotated[ModelForm, flag("--model", "One transfer function, or a sum of submodels.")]
#: Numbers of second-order submodels among which a sum is chosen.
MODES = 1, 6
HoldOption = Annotated[AskedHold, flag("--hold", "Input between its samples; else chosen.")]
#: Options that a model does not have, and what to do.
FRACTION = {"--terms": "add --model additive, or give --poles and --zeros"}
SUM = {"--poles": "give --terms", "--zeros": "give --terms", "--bound": "drop it"}
SEVERAL_INPUTS = dict.fromkeys(("--model", "--loop", "--reference"), "give one --input")
LOOP = {
    "--input-before": "use --initial-state estimate",
    "--loss": "drop it",
    "--noise": "drop it, or fit to the input with --direct",
    "--bound": "drop it, or fit to the input with --direct",
}
UNSTABLE = {
    "--model": "a sum of submodels is stable; drop it",
    "--fix": "drop it",
    "--reference": "drop it, or give the controller (--loop FILE)",
}
ONE_FRACTION_IN_LOOP = {"--fix": "add --model additive --terms POLES/ZEROS, for the names of submodels"}
#: Options by their names in estimators.
OPTIONS = {
    "delay_bounds": "--delay",
    "fixed": "--fix",
    "initial_state": "--initial-state",
    "input_before": "--input-before",
    "noise_model": "--noise",
    **{name: f"--{name}" for name in ("poles", "zeros", "integrators", "hold", "offset")},
}


# --- values ----------------------------------------------------------------------------------------


class NamedValue(NamedTuple):
    """Value of an option for an input or a parameter; without a name for all inputs."""

    name: str
    value: Any
    text: str

    def __str__(self) -> str:
        """Return the text on the command line."""
        return self.text


#: Values of an option that is given once for each name.
NamedValues = list[NamedValue] | None


def named(option: str, help: str, metavar: str, read: Callable[[str], Any]) -> Any:
    """Return the declaration of an option ``NAME=VALUE`` or, if the metavar has it in brackets, ``VALUE``."""

    def parse(text: str) -> NamedValue:
        name, _, value = (part.strip() for part in text.rpartition("="))
        if not name and metavar.startswith("NAME="):
            raise typer.BadParameter(f"must be {metavar}; got {text!r}")
        return NamedValue(name, read(value), text)

    return flag(option, help, metavar, parser=parse)


def whole_number(text: str) -> int:
    """Return a whole number."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"must be a whole number; got {text!r}") from None


def degree(text: str) -> int | tuple[int, int]:
    """Return a whole number, or a range to choose from."""
    found = span(text, int)
    if found is None or not 0 <= found[0] <= found[1]:
        raise typer.BadParameter(f"must be a whole number, or LOW:HIGH to choose from; got {text!r}")
    return found if ":" in text else found[0]


def delay_range(text: str) -> tuple[float, float]:
    """Return a range of the delay; a single value is a known delay."""
    bounds = span(text, float)
    if bounds is not None and 0 <= bounds[0] <= bounds[1] < float("inf"):
        return bounds
    allowed = "LOW:HIGH, a range to search, or one known VALUE, in the record's unit of time and not negative"
    raise typer.BadParameter(f"must be {allowed}, for example 0:2 or 0.3; got {text!r}")


def two_bounds(text: str) -> tuple[float, float]:
    """Return the bounds of a parameter."""
    bounds = span(text, float)
    if bounds is None or ":" not in text:
        raise typer.BadParameter(f"must be two numbers LOW:HIGH, for example 0.5:2; got {text!r}")
    return bounds


def hold_name(text: str) -> AskedHold:
    """Return the hold of an input."""
    if text not in get_args(AskedHold):
        raise typer.BadParameter(f"must be one of {', '.join(get_args(AskedHold))}; got {text!r}")
    return cast(AskedHold, text)


def input_level(text: str) -> InputBefore:
    """Return the input before a record."""
    with contextlib.suppress(typer.BadParameter):
        return "first" if text == "first" else finite(text)
    raise typer.BadParameter(f"must be a finite number, or first; got {text!r}")


# --- options ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StructureOptions:
    """Delay and poles at the origin, and treatment of the initial state and of offsets."""

    delay_bounds: Annotated[
        NamedValues, named("--delay", "Range or value; else chosen.", "[INPUT=]LOW:HIGH|VALUE", delay_range)
    ] = None
    integrators: Annotated[
        NamedValues, named("--integrators", "Additional poles at the origin.", "[INPUT=]N", whole_number)
    ] = None
    initial_state: Annotated[InitialState | None, flag("--initial-state", "State before the record; else chosen.")] = (
        None
    )
    input_before: Annotated[
        Any, flag("--input-before", "Input before the record, at rest; else chosen.", "VALUE|first", parser=input_level)
    ] = None
    offset: Annotated[Offset | None, flag("--offset", "Offset of the output, or its drift; else chosen.")] = None

    def each(self, option: str) -> dict[str, Any]:
        """Return the values of an option by input; the name of that for all inputs is empty."""
        found: dict[str, Any] = {}
        for name, value, _ in getattr(self, option) or ():
            if name in found:
                raise UsageError(f"{OPTIONS[option]} is given twice{f' for {name}' * bool(name)}; give it once")
            found[name] = value
        return found

    def common(self, option: str) -> Any:
        """Return the value of an option for all inputs; None if there is none."""
        return self.each(option).get("")

    def given(self, **others: Any) -> Given:
        """Return the given options of the choice."""
        from ctid_cli.identification.choice import Given

        return Given(
            integrators=self.common("integrators"),
            delay_bounds=self.common("delay_bounds"),
            initial_state=self.initial_state,
            offset=self.offset,
            input_before=self.input_before,
            **others,
        )


@dataclass(frozen=True)
class FitOptions(StructureOptions):
    """Structure of the model, its known parameters and bounds, noise, and hold of the input."""

    poles: Annotated[
        NamedValues,
        named("--poles", "INPUT=N: separate denominators.", "[INPUT=]N|LOW:HIGH", degree),
    ] = None
    zeros: Annotated[
        NamedValues, named("--zeros", "Zeros, fewer than poles, or their range.", "[INPUT=]N|LOW:HIGH", degree)
    ] = None
    model: FormOption = "fraction"
    terms: Annotated[str | None, flag("--terms", "Poles/zeros of each submodel; else chosen.", "P/Z,P/Z,...")] = None
    fix: Annotated[NamedValues, named("--fix", "Hold a parameter; repeatable.", "NAME=VALUE", finite)] = None
    bound: Annotated[
        NamedValues,
        named("--bound", "Of a coefficient, delay, gain, time_constant or damping.", "NAME=LOW:HIGH", two_bounds),
    ] = None
    loss: Annotated[LossKind | None, flag("--loss", "Loss function of the output errors.")] = None
    noise: Annotated[str, flag("--noise", "Noise that is estimated with the model.", "white|arma:P,Q|auto")] = "white"
    hold: Annotated[
        NamedValues, named("--hold", "Input between its samples.", "[INPUT=]auto|zoh|foh|band-limited", hold_name)
    ] = None
    weight: Annotated[Weight | None, flag("--weight", "Weights of a response without standard errors.")] = None

    @property
    def fixed(self) -> tuple[Fixed, ...] | None:
        """Known parameters."""
        from ctid_cli.estimation.common import Fixed

        return tuple(Fixed(each.name, each.value) for each in self.fix or ()) or None

    @property
    def bounds(self) -> tuple[Bound, ...] | None:
        """Bounds of parameters."""
        from ctid_cli.estimation.common import Bound

        return tuple(Bound(each.name, *each.value) for each in self.bound or ()) or None

    @property
    def submodels(self) -> tuple[Term, ...]:
        """Terms of a sum, such as ``2/0,2/1``, or one transfer function; integrators belong to the first."""
        from ctid_cli.models.additive import Term

        text = f"{self.common('poles')}/{self.common('zeros') or 0}" if self.terms is None else self.terms
        found: list[Term] = []
        for part in text.split(","):
            degrees = re.fullmatch(r"\s*(\d{1,2})(?:/(\d{1,2}))?\s*", part)
            if degrees is None:
                allowed = "poles/zeros of each submodel with commas between them, for example 2/0,2/1"
                raise UsageError(f"--terms must be {allowed}; got {text!r}")
            integrators = 0 if found else self.common("integrators") or 0
            found.append(Term(int(degrees[1]), int(degrees[2] or 0), integrators))
        return tuple(found)

    def with_delays(self, inputs: tuple[str, ...] = ()) -> FitOptions:
        """Return the options with the delays of ``--fix`` and ``--bound`` among those of ``--delay``."""
        delays = {"delay": "", **{f"{name}_delay": name for name in inputs}}
        known = [each._replace(value=(each.value, each.value)) for each in self.fix or ()]
        given = [each for each in (*known, *(self.bound or ())) if each.name in delays]
        return replace(
            self,
            fix=[each for each in self.fix or () if each.name not in delays],
            bound=[each for each in self.bound or () if each.name not in delays],
            delay_bounds=[*(self.delay_bounds or ()), *(each._replace(name=delays[each.name]) for each in given)],
        )


# --- the estimator ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class ModelRequest:
    """Options of the model, the names of several inputs, and what is known of the loop."""

    options: FitOptions
    loop: LoopOptions
    inputs: tuple[str, ...] = ()

    @property
    def hold(self) -> AskedHold | tuple[Hold, ...]:
        """Hold of the inputs; if it is given for single ones, that of each."""
        given = self.options.each("hold")
        if not {*given} - {""}:
            return cast(AskedHold, given.get("", "auto"))
        holds = tuple(given.get(name, given.get("", "zoh")) for name in self.inputs)
        if "auto" in holds:
            raise UsageError("--hold auto chooses one for all inputs; give INPUT=zoh, foh or band-limited")
        return holds

    @property
    def is_sum(self) -> bool:
        """Whether the model is a sum of submodels."""
        return self.options.model == "additive"

    @property
    def single(self) -> bool:
        """Whether the estimator is one of records in a loop."""
        return self.loop.use != "none" or self.loop.unstable

    @property
    def simulated(self) -> bool:
        """Whether the loop of one transfer function is simulated."""
        return (self.loop.use == "controller" or self.loop.unstable) and not self.is_sum

    def check(self) -> None:
        """Refuse options that the model does not have, unknown inputs, and missing degrees."""
        options, given = self.options, given_options(self.options, self.loop)
        if self.inputs:
            refuse_options(given, SEVERAL_INPUTS, "several inputs")
        refuse_options(
            given, SUM if self.is_sum else FRACTION, "a sum of submodels" if self.is_sum else "one transfer function"
        )
        refuse_options(given, {"--weight": "samples have equal weights; drop it"}, "a record in time")
        for option in ("poles", "zeros", "delay_bounds", "integrators", "hold"):
            for name in {*options.each(option)} - {"", *self.inputs}:
                known = f"the inputs are {', '.join(self.inputs)}" if self.inputs else "name several with --input"
                raise UsageError(f"{OPTIONS[option]} is given for {name!r}, which is no input; {known}")
        self._check_ranges()
        if options.common("integrators") and options.offset in ("remove", "drift"):
            raise UsageError(
                f"--offset {options.offset} does not go with --integrators, since the output of an integrating system "
                f"has no mean or slope of its own; use --offset {'none' if self.single else 'estimate'}"
            )
        if self.single:
            self._check_loop(given)

    def _check_ranges(self) -> None:
        """Refuse ranges of degrees where nothing is chosen, or one number is needed."""
        options = self.options
        for option in ("poles", "zeros"):
            ranges = [name for name, value in options.each(option).items() if isinstance(value, tuple)]
            needed = "single inputs" if any(ranges) else "--fix" if options.fix else "--bound" if options.bound else ""
            needed = needed or ("a record in a loop" if self.single else "")
            if ranges and needed:
                raise UsageError(f"--{option} must be one number with {needed}, not a range")

    def _check_loop(self, given: Sequence[str]) -> None:
        """Refuse options that the estimators of a record in a loop do not have."""
        options, by_reference, unstable = self.options, self.loop.use == "reference", self.loop.unstable
        model = "a sum of submodels in a loop" if self.is_sum else "a record in a loop"
        purpose = "the reference as an instrument" if by_reference else model
        purpose = "a plant that may be unstable" if unstable else purpose
        has_submodels = self.is_sum or (by_reference and not unstable and options.common("integrators"))
        refused = LOOP | ({} if has_submodels else ONE_FRACTION_IN_LOOP) | (UNSTABLE if unstable else {})
        if unstable:
            refused = {option: cure for option, cure in refused.items() if option != "--noise"}
        refuse_options(given, refused, purpose)
        if options.terms is None and options.common("poles") is None:
            option = "--reference" if by_reference or self.is_sum else "--loop"
            raise UsageError(f"{'--terms' if self.is_sum else '--poles'} is missing: with {option} it must be given")
        if self.loop.use == "controller" and self.simulated:
            return
        low, high = options.common("delay_bounds") or (0.0, 0.0)
        if low < high:
            more = "; with the controller (--loop FILE) it can be searched" * by_reference
            raise UsageError(f"--delay must be one known VALUE for {purpose}, not a range{more}")
        if self.hold not in ("auto", "zoh"):
            raise UsageError(f"--hold must be zoh for {purpose}: a discrete controller holds its input")

    def estimator(self) -> AdditiveOutputError | MeasuredSubmodels | LoopOutputError | Given:
        """Return the estimator, or the given options of a choice; a UsageError names contradicting options."""
        from ctid_cli.estimators.additive_output_error import AdditiveOutputError
        from ctid_cli.estimators.loop_output_error import LoopOutputError
        from ctid_cli.estimators.measured_submodels import MeasuredSubmodels

        self.check()
        options = self.options
        delays = options.common("delay_bounds") or (0.0, 0.0)
        state: Any = options.initial_state or "rest"
        offset: Any = options.offset or "none"
        with as_usage_errors():
            if self.simulated:
                degrees = options.common("poles"), options.common("zeros") or 0
                integrators = options.common("integrators") or 0
                return LoopOutputError(*degrees, delays, state, offset, integrators, noise_model=options.noise)
            if self.single:
                instruments: Instruments = "reference" if self.loop.use == "reference" else "closed_loop"
                factored = self.is_sum or bool(options.common("integrators"))
                return MeasuredSubmodels(
                    options.submodels, delays[0], instruments, state, offset, factored=factored, fixed=options.fixed
                )
            if options.terms is not None:
                known: Any = {"input_before": options.input_before, "noise_model": options.noise}
                loss = options.loss or "squares"
                return AdditiveOutputError(options.submodels, delays, state, offset, loss, fixed=options.fixed, **known)
            return self._given()

    def _given(self) -> Given:
        """Return the given options of the choice, and of each of several inputs."""
        options = self.options.with_delays(self.inputs)
        own_poles, own_zeros = ({**options.each(name)} for name in ("poles", "zeros"))
        poles, zeros = own_poles.pop("", None), own_zeros.pop("", None)
        if own_poles and poles is None:
            if missing := [name for name in self.inputs if name not in own_poles]:
                raise UsageError(f"--poles is given for {', '.join(own_poles)} and not for {', '.join(missing)}")
            poles = max(own_poles.values())
        needing = {"--fix": options.fix, "--bound": options.bound, "--zeros of single inputs": own_zeros}
        for option in [name for name, given in needing.items() if given and poles is None]:
            raise UsageError(f"{'--terms' if self.is_sum else '--poles'} is missing: with {option} it must be given")
        if zeros is None and (own_poles or any(needing.values())):
            # The names of known parameters depend on the number of zeros.
            zeros = 0
        return options.given(
            poles=poles,
            zeros=zeros,
            hold=self.hold,
            fixed=options.fixed,
            bounds=options.bounds,
            loss=options.loss,
            noise_model=options.noise,
            modes=MODES if self.is_sum else None,
            inputs=tuple(self._inputs(options)) or None,
        )

    def _inputs(self, options: FitOptions) -> Iterator[InputModel]:
        """Yield the given options of each of several inputs."""
        from ctid_cli.estimators.delay_profile import InputModel

        given = {name: options.each(name) for name in ("poles", "zeros", "delay_bounds", "integrators")}
        for name in self.inputs:
            yield InputModel(name, **{option: values[name] for option, values in given.items() if name in values})


@contextlib.contextmanager
def as_usage_errors() -> Iterator[None]:
    """Turn errors about options of an estimator into a message about the command line."""
    try:
        yield
    except OptionError as error:
        option = OPTIONS.get(error.field, error.field)
        raise UsageError(re.sub(rf"^{error.field}\b", option, str(error))) from None
    except ValueError as error:
        raise UsageError(str(error)) from None
