"""The model of a specification: one YAML file describes one experiment.

Its canonical form has every default filled in and no trace of how the file was written; hashes of parts of it are the
identity of data and estimators.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, PrivateAttr
from pydantic_core import ErrorDetails

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import Problem, UsageError
from ctid_cli.inference.monte_carlo import AT_LEAST, block_ends, requested
from ctid_cli.kinds import KINDS, resolve
from ctid_cli.signals.recorder import Recorder
from ctid_cli.simulation.dataset import MeasuredSource, located
from ctid_cli.specification.fields import LATER, MAX_WHOLE, NotNegative, Positive, Text, matching
from ctid_cli.specification.loop_section import LoopSection
from ctid_cli.specification.messages import Complaint, wrong
from ctid_cli.specification.option_sections import EstimatorSection, ExcitationSection, NoiseSection
from ctid_cli.specification.sections import Options, Section, variants
from ctid_cli.specification.signal_sections import AnySamplingSection, DisturbanceOrNone, SignalSection
from ctid_cli.specification.start_sections import StartsSection
from ctid_cli.specification.system_sections import AnySystemSection
from ctid_cli.specification.yaml_source import KeyPath, YamlSource, path_text
from ctid_cli.written_files import EXPERIMENT, why_unusable

_EXPERIMENT = matching(
    EXPERIMENT,
    "use letters, digits, '-', '_' and '.', with '/' between parts, no '..', 200 characters at most",
)
_NAME = matching("[A-Za-z0-9_-]{1,60}", "a name has letters, digits, '-' and '_', at most 60 of them")

_SIMULATED = ("system", "excitation", "sampling")
#: Sections that data are simulated from; their lists combine to data cells.
OF_DATA = ("system", "excitation", "loop", "sampling", "noise", "recorder", "signal", "disturbance")
#: Sections that belong to the identification of systems.
_OF_SYSTEMS = ("system", "excitation", "loop", "noise", "recorder", "data", "starts")


def _usable(name: str) -> str:
    """Refuse the name of an experiment under which its results could not be found again."""
    why = why_unusable(name)
    if why:
        raise wrong(f"{name!r} cannot be used here: {why}; choose another name")
    return name


#: A measured record in place of a simulated one.
MeasuredSection = Annotated[Any, Options(MeasuredSource, without="loop", sweeping=False)]
RecorderSection = Annotated[Section, Options(Recorder)]


class UntilSection(Section):
    """How precise the measures of every data cell must be, in place of a number of data sets.

    Parameters
    ----------
    percent_half_width : float, optional
        Largest half-width of the 95 % interval of every percentage [percentage points]
    rmse_relative : float, optional
        Largest half-width of the 95 % interval of every root mean square error, as a fraction of the error [-]
    """

    if_empty = "give percent_half_width, rmse_relative or both; for example {rmse_relative: 0.05}"

    percent_half_width: Annotated[Positive | None, Field(lt=50.0)] = None
    rmse_relative: Annotated[Positive | None, Field(lt=1.0)] = None


class MonteCarloSection(Section):
    """How many data sets, and which: a number of them, or until the measures are precise enough.

    Parameters
    ----------
    runs : int, optional
        Data sets of every data cell
    seed : int
        Seed of all random numbers; with the same seed the same data sets come out
    until : mapping, optional
        Precision that decides how many data sets each data cell gets, in place of runs
    at_most : int, optional
        With until, most data sets of a data cell; 200 is the fewest
    """

    runs: Annotated[int | None, Field(ge=1, le=1_000_000), LATER] = None
    seed: int = Field(ge=0, le=MAX_WHOLE)
    until: Annotated[UntilSection | None, LATER] = None
    at_most: Annotated[int | None, Field(ge=AT_LEAST, le=1_000_000), LATER] = None

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        """Say that there is no number of data sets, or more than one rule for it."""
        given = {name for name in ("runs", "until", "at_most") if raw.get(name) is not None}
        if {"runs", "until"} <= given:
            yield ("until",), "decides how many data sets there are; keep runs or until (with at_most)"
        elif "until" in given and "at_most" not in given:
            yield ("at_most",), "is missing; add the most data sets of a data cell, for example at_most: 5000"
        elif "at_most" in given and "until" not in given:
            yield ("at_most",), "goes with until; leave it out, or ask for a precision: until: {rmse_relative: 0.05}"
        elif not given:
            yield ("runs",), "is missing; add it: Data sets of every data cell, for example runs: 100"

    @property
    def most(self) -> int:
        """Most data sets that a data cell can get."""
        return self.runs or self.at_most or 1

    @property
    def first(self) -> int:
        """Data sets of every data cell, or of its first block."""
        return self.runs or next(block_ends(self.most))


class SuccessSection(Section):
    """When an estimate counts as converged; all that is given must hold.

    Parameters
    ----------
    delay_relative_error : float, optional
        Largest error of the delay, as a fraction of the true delay [-]
    fit_percent : float, optional
        Least fit of the simulated output [%]
    parameter_relative_error : float, optional
        Largest error of any parameter but the delay, as a fraction of the true value [-]
    band : float, optional
        Largest error of a settled frequency of a signal [rad/s]
    by : float, optional
        Frequencies must settle so soon after the start and after their last step [s]
    window : list of float, optional
        First and last instant of the window of rms and bias of a frequency [s], no condition itself; the last 10 s
    """

    if_empty = (
        "give delay_relative_error, fit_percent, parameter_relative_error, band, by or several of them, or leave the "
        "section out"
    )

    delay_relative_error: Positive | None = None
    fit_percent: Annotated[float, Field(le=100.0, allow_inf_nan=False)] | None = None
    parameter_relative_error: Annotated[Positive | None, LATER] = None
    band: Annotated[Positive | None, LATER] = None
    by: Annotated[Positive | None, LATER] = None
    window: Annotated[Annotated[list[NotNegative], Field(min_length=2, max_length=2)] | None, LATER] = None

    def complaints(self) -> Iterator[Complaint]:
        """Say that nothing is asked for, or by when but not what, or that the window is empty."""
        yield from super().complaints()
        if self.by is not None and self.band is None:
            yield ("by",), "is the time of settling into a band; add band [rad/s]"
        if self.window is not None and self.band is None:
            yield ("window",), "is no condition by itself; add band [rad/s]"
        if self.window is not None and not self.window[0] < self.window[1]:
            yield ("window",), f"must begin before it ends; it runs from {self.window[0]:g} to {self.window[1]:g} s"


class LimitsSection(Section):
    """What one estimate may take; what takes more is ended and counts as a failure of its estimator.

    Parameters
    ----------
    cpu_seconds : float, optional
        Most processor time of an estimate [s]; no limit by default
    wall_seconds : float, optional
        Most time of an estimate, asleep or at work [s]; no limit by default
    memory_mb : float, optional
        Most memory of an estimate beyond what its process held before [MB]; no limit by default
    """

    if_empty = "give cpu_seconds, wall_seconds, memory_mb or several of them; for example {wall_seconds: 600}"

    cpu_seconds: Positive | None = None
    wall_seconds: Positive | None = None
    memory_mb: Positive | None = None


class Spec(Section):
    """One experiment: simulated or measured data or a signal, estimators, starts, and what counts as success.

    Parameters
    ----------
    experiment : str
        Name of the experiment and of its results folder; '/' makes folders in folders
    system : mapping, optional
        The system to simulate
    excitation : mapping, optional
        The input of the system, in open loop
    loop : mapping, optional
        What makes the input from the output, in place of excitation
    signal : mapping, optional
        A sum of sinusoids whose frequencies are estimated, in place of a system
    disturbance : mapping or "none", optional
        What is added to the signal; none by default
    sampling : mapping, optional
        When the output is sampled
    noise : mapping, optional
        What is added to the output; none by default
    recorder : mapping, optional
        What becomes of the output when it is recorded: its resolution, and losses; nothing by default
    data : mapping, optional
        A measured record, in place of system, excitation, sampling and noise
    estimators : mapping of mappings
        estimators by the names that tables show, for example 'mine: {kind: td_srivc, …}'
    starts : mapping, optional
        Initial delays and parameters; by default every estimator chooses its own
    monte_carlo : mapping, optional
        Number of data sets and their seed; needed where anything is random
    success : mapping, optional
        When an estimate counts as converged
    measures : list of str, optional
        What tables show, such as [bias, rmse, coverage]; by default percentages, or bias and rmse without success
    limits : mapping, optional
        Time and memory that one estimate may take; no limits by default
    """

    experiment: Annotated[Text, _EXPERIMENT, AfterValidator(_usable)]
    system: AnySystemSection | None = None
    excitation: ExcitationSection | None = None
    loop: Annotated[LoopSection | None, LATER] = None
    signal: Annotated[SignalSection | None, LATER] = None
    disturbance: Annotated[DisturbanceOrNone | None, LATER] = None
    sampling: AnySamplingSection | None = None
    noise: NoiseSection | None = None
    recorder: Annotated[RecorderSection | None, LATER] = None
    data: MeasuredSection | None = None
    estimators: Annotated[dict[Annotated[str, _NAME], EstimatorSection], Field(min_length=1)]
    starts: StartsSection | None = None
    monte_carlo: MonteCarloSection | None = None
    success: SuccessSection | None = None
    measures: Annotated[list[Text] | None, LATER] = None
    limits: Annotated[LimitsSection | None, LATER] = None

    _warnings: tuple[str, ...] = PrivateAttr(default=())
    _text: str = PrivateAttr(default="")
    _folder: Path = PrivateAttr(default=Path())
    _source: YamlSource | None = PrivateAttr(default=None)

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        """Say which sections are missing or too many."""
        present = {name for name in cls.model_fields if raw.get(name) is not None}
        of_other, about = (_OF_SYSTEMS, "system") if "signal" in present else (("disturbance",), "signal")
        for name in of_other:
            if name in present:
                other = "; what is added to a signal is its disturbance" if name == "noise" else ""
                yield (name,), f"belongs to a {about}, and there is none here; leave it out{other}"
        if "signal" not in present:
            yield from _of_a_record(raw, present) if "data" in present else _of_a_simulation(raw, present)
        elif "sampling" not in present:
            yield ("sampling",), "is missing; for example {kind: regular, interval: 0.001, duration: 60}"
        random = _random_section(raw, present)
        if random and "monte_carlo" not in present:
            yield ("monte_carlo",), f"is missing, and the {random} is random; for example {{runs: 100, seed: 1}}"

    @classmethod
    def narrowed(cls, error: ErrorDetails, raw: Any) -> ErrorDetails:
        """Estimators of a system where there is one, and of a signal where there is one."""
        if error["type"] == "no_kind" and error["loc"][0] == "estimators" and {"signal", "system", "data"} & raw.keys():
            error["ctx"] = {"allowed": ", ".join(KINDS["frequency_estimator" if "signal" in raw else "estimator"])}
        return error

    def complaints(self) -> Iterator[Complaint]:
        """Say which measures there are not, which precision cannot be had, and which estimators are the same."""
        yield from self._precision_complaints()
        for k, name in enumerate(self.measures or ()):
            try:
                requested(name)
            except UsageError as error:
                yield ("measures", k), str(error)
        seen: dict[str, str] = {}
        for name, section in self.estimators.items():
            others = [seen.setdefault(canonical_json(variant.values), name) for variant in variants(section)]
            for other in [other for other in others if other != name][:1]:
                yield ("estimators", name), f"the same settings as {other!r}; its estimates would be the same too"

    def _precision_complaints(self) -> Iterator[Complaint]:
        until = None if self.monte_carlo is None else self.monte_carlo.until
        if until is None:
            return
        place = ("monte_carlo", "until")
        if self.data is not None:
            yield place, "a measured record is one data set; give runs: 1 in place of until and at_most"
            return
        if until.percent_half_width is not None and self.success is None:
            yield (*place, "percent_half_width"), "is of the estimates that meet the success rule; add success"
        if until.rmse_relative is None:
            return
        if self.system is None:
            yield (*place, "rmse_relative"), "needs the true values of a simulated system; use percent_half_width"
        elif self.system.own and not self.system.truth:
            yield (*place, "rmse_relative"), "needs true values: system.truth: {gain: 1.0}"

    @property
    def measured(self) -> MeasuredSource | None:
        """Reader of the measured record, its file as seen from the working directory; None for simulated data."""
        if self.data is None:
            return None
        loop = None if self.loop is None else variants(self.loop)[0].options
        source: MeasuredSource = replace(located(self.data.options(), self.folder), loop=loop)
        return source

    @property
    def generator(self) -> tuple[tuple[str, ...], Section] | None:
        """Key path and section of what drives the simulation: the excitation, or the reference of the loop."""
        if self.excitation is not None:
            return ("excitation",), self.excitation
        if self.loop is not None and self.loop.reference is not None:
            return ("loop", "reference"), self.loop.reference
        return None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is unwise but allowed, each with its place in the file."""
        return self._warnings

    def problem(self, path: KeyPath, message: str) -> Problem:
        """Something wrong at a key path, with its place in the file."""
        if self._source is None:
            return Problem("(stored specification)", 1, 1, path_text(path), message)
        return self._source.problem(path, message)

    @property
    def text(self) -> str:
        """The specification as the user wrote it; the canonical form where there is no file."""
        return self._text or canonical_json(self.canonical())

    @property
    def folder(self) -> Path:
        """Folder that the names of data files are relative to."""
        return self._folder

    def canonical(self) -> dict[str, Any]:
        """The specification with all defaults, as plain data."""
        return self.model_dump(mode="json")


def _of_a_record(raw: Mapping[str, Any], present: set[str]) -> Iterator[Complaint]:
    for name in (*_SIMULATED, "noise", "recorder"):
        if name in present:
            yield (name,), "belongs to simulated data, and 'data' names a measured record; keep one of the two"
    if _reference(raw, "loop") is not None:
        yield ("loop", "reference"), "belongs to simulated data; that of a record is a column, data.reference"
    column = _reference(raw, "data") is not None
    if column and "loop" not in present:
        yield ("data", "reference"), "needs the controller too; add loop: {controller: {…}}"
    elif not column and "loop" in present and isinstance(raw["data"], Mapping):
        yield ("data", "reference"), "is missing; a loop has a reference: name its column"


def _of_a_simulation(raw: Mapping[str, Any], present: set[str]) -> Iterator[Complaint]:
    if {"loop", "excitation"} <= present:
        yield ("excitation",), "the loop makes the input; keep one of the two (a reference stands in loop.reference)"
    elif isinstance(raw.get("loop"), Mapping) and raw["loop"].get("reference") is None and not _has_relay(raw["loop"]):
        yield ("loop", "reference"), "is missing; for example {kind: gaussian, standard_deviation: 1.0}"
    missing = [name for name in _SIMULATED if name not in present | ({"excitation"} if "loop" in present else set())]
    if len(missing) == len(_SIMULATED):
        yield (), "there are no data: give system, excitation and sampling; or data; or signal and sampling"
        return
    for name in missing:
        yield (name,), "is missing; data are simulated with system, excitation (or loop) and sampling"


def _has_relay(loop: Mapping[str, Any]) -> bool:
    controller = loop.get("controller")
    return isinstance(controller, Mapping) and "relay" in controller


def _reference(raw: Mapping[str, Any], section: str) -> Any:
    """The reference in a section, whatever the section is."""
    content = raw.get(section)
    return content.get("reference") if isinstance(content, Mapping) else None


def _draws_nothing(chosen: Any, options: Mapping[str, Any]) -> bool:
    """Whether a class draws no random number with the options that are given."""
    without = getattr(chosen, "deterministic_with", {})
    return getattr(chosen, "deterministic", False) or any(options.get(name) in without[name] for name in without)


def _random_section(raw: Mapping[str, Any], present: set[str]) -> str:
    """A section of simulated data that draws random numbers; empty if none does."""
    if "data" in present:
        return ""
    parts = {name: raw.get(name) for name in ("excitation", "sampling", "noise", "disturbance")}
    for name, part in {**parts, "excitation of the loop": _reference(raw, "loop")}.items():
        if part is None or part == "none":
            continue
        kinds = KINDS[name.split()[0]]
        kind = part.get("kind") if isinstance(part, Mapping) else None
        found = resolve(name.split()[0], kind) if isinstance(kind, str) and kind in kinds else kind
        if not _draws_nothing(found, part):
            return name
    recorder = raw.get("recorder")
    return "recorder" if isinstance(recorder, Mapping) and recorder.get("missing") else ""
