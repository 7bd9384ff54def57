"""Model of a specification: one YAML file describes one experiment.

The canonical form contains every default and is independent of how the file was written; hashes of its parts identify
data and estimators.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, ValidationError
from pydantic_core import ErrorDetails

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import OptionError
from ctid_cli.inference.monte_carlo import AT_LEAST, block_ends
from ctid_cli.kinds import KINDS
from ctid_cli.signals.sampling import InputRecord, InstantsFile, ListedInstants, RegularSampling
from ctid_cli.signals.sinusoids import SumOfSinusoids
from ctid_cli.simulation.dataset import MeasuredSource, located
from ctid_cli.specification.custom_sections import CustomMeasureSection, Kinds
from ctid_cli.specification.messages import Violation, wrong
from ctid_cli.specification.sections import Options, Section, WithKey, section_for
from ctid_cli.specification.sweeps import variants
from ctid_cli.specification.system_sections import (
    AnySystemSection,
    ExcitationSection,
    InputSection,
    LoopSection,
    StartsSection,
    loop_as_mapping,
)
from ctid_cli.specification.values import MAX_WHOLE, ByShape, Name, NotNegative, Number, Positive, Swept, Text, matching
from ctid_cli.specification.yaml_source import KeyPath, YamlSource
from ctid_cli.written_files import EXPERIMENT, why_unusable

_EXPERIMENT = matching(
    EXPERIMENT,
    "use letters, digits, '-', '_' and '.', with '/' between parts, no '..', 200 characters at most",
)
#: Sections of simulated data, except those of several inputs; their lists combine to data cells.
OF_DATA = ("system", "excitation", "loop", "sampling", "noise", "signal", "disturbance")


def _usable(name: str) -> str:
    """Refuse an experiment name under which its results could not be found again."""
    why = why_unusable(name)
    if why:
        raise wrong(f"{name!r} cannot be used here: {why}; choose another name")
    return name


def _several_inputs(inputs: dict[str, InputSection]) -> dict[str, InputSection]:
    """Refuse a single input in the section of several inputs."""
    if len(inputs) < 2:
        raise wrong("inputs are two or more; of one input give system and excitation themselves")
    return inputs


# --------------------------------------------------------------------------------------------------------------------
# Data


class RegularDurationSection(Section):
    """Samples at equal intervals, from 0 s, over a given duration.

    Parameters
    ----------
    kind : {"regular"}
        Kind of sampling
    interval : float
        Sampling interval [s]
    duration : float
        Length of the record, in place of the number of samples [s]
    """

    target: ClassVar[type | None] = RegularSampling
    elsewhere = {"samples": "gives the length a second time, 'duration' has it already; keep one of the two"}  # noqa: RUF012

    kind: Literal["regular"]
    interval: Annotated[float | list[float], Swept(Positive)]
    duration: Annotated[float | list[float], Swept(Positive)]

    def build(self) -> RegularSampling:
        """Return the sampling scheme."""
        interval, duration = self.part("interval"), self.part("duration")
        if not duration >= 2.0 * interval:
            message = f"duration must be at least two sampling intervals of {interval:g} s, not {duration:g} s."
            raise OptionError("duration", message)
        # A number of samples beyond the largest integer is refused later as too many.
        return RegularSampling(interval, int(min(round(duration / interval), 2**62)))


class ListedTimesSection(Section):
    """Samples at listed instants.

    Parameters
    ----------
    kind : {"irregular"}
        Kind of sampling
    times : list of float
        The instants, strictly increasing [s]; the record begins at the first of them
    input_record : {"sampled", "exact"}, default "exact"
        Input given to the estimator: its samples at the output's instants, or its true edges
    """

    target: ClassVar[type | None] = ListedInstants
    elsewhere = dict.fromkeys(
        ("interval", "samples", "spread", "file", "time"), "gives the instants a second time, 'times' lists them"
    )

    kind: Literal["irregular"]
    times: Annotated[list[Number], Field(min_length=2)]
    input_record: Annotated[InputRecord | list[InputRecord], Swept(InputRecord)] = "exact"

    def violations(self) -> Iterator[Violation]:
        """Yield the first instant that is not later than the one before it."""
        for k, (before, now) in enumerate(itertools.pairwise(self.times), start=1):
            if now <= before:
                yield ("times", k), f"{now:.12g} s comes after {before:.12g} s; times must increase strictly"
                return

    def build(self) -> ListedInstants:
        """Return the sampling scheme."""
        return ListedInstants(tuple(self.times), self.part("input_record"))


_DrawnSection = Annotated[Section, Kinds("sampling", custom="sampling")]
_OfFile = section_for(InstantsFile, "irregular")
_FileOrDrawn = Annotated[Section, WithKey("file", _OfFile, _DrawnSection, kind="irregular")]
_IrregularSection = Annotated[Section, WithKey("times", ListedTimesSection, _FileOrDrawn, kind="irregular")]
AnySamplingSection = Annotated[Section, WithKey("duration", RegularDurationSection, _IrregularSection, kind="regular")]
NoiseSection = Annotated[Section, Kinds("noise", custom="noise")]
#: A measured record in place of a simulated one.
MeasuredSection = Annotated[Any, Options(MeasuredSource, without="loop", sweeping=False)]
SignalSection = Annotated[Section, Options(SumOfSinusoids)]
DisturbanceOrNone = Annotated[
    Annotated[Section, Kinds("disturbance")] | None,
    BeforeValidator(lambda value: None if value == "none" else value),
]
_CustomMeasure = Annotated[CustomMeasureSection, Kinds(custom="measure")]
#: The name of a measure, or a custom one.
MeasureName = Annotated[Any, ByShape(Text, "a mapping with a kind is allowed too", mapping=_CustomMeasure)]
EstimatorSection = Annotated[Any, Kinds("estimator", "frequency_estimator", custom="estimator")]


# --------------------------------------------------------------------------------------------------------------------
# Number of data sets, and success


class UntilSection(Section):
    """Required precision of the measures of every data cell, in place of a number of data sets.

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
    """Number of data sets and their seed: a fixed number, or until the measures are precise enough.

    Parameters
    ----------
    runs : int, optional
        Data sets of every data cell
    seed : int
        Seed of all random numbers; with the same seed the same data sets come out
    until : mapping, optional
        Precision that decides how many data sets each data cell gets, in place of runs
    at_most : int, optional
        With until, maximum number of data sets of a data cell, at least 200
    """

    runs: Annotated[int | None, Field(ge=1, le=1_000_000)] = None
    seed: int = Field(ge=0, le=MAX_WHOLE)
    until: UntilSection | None = None
    at_most: Annotated[int | None, Field(ge=AT_LEAST, le=1_000_000)] = None

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Violation]:
        """Yield the absence of a number of data sets, or conflicting rules for it."""
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
        """Maximum number of data sets of a data cell."""
        return self.runs or self.at_most or 1

    @property
    def first(self) -> int:
        """Number of data sets of every data cell, or of its first block."""
        return self.runs or next(block_ends(self.most))


class SuccessSection(Section):
    """Conditions for an estimate to count as converged; all given ones must hold.

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
        Maximum settling time of frequencies after the start and after their last step [s]
    window : list of float, optional
        First and last instant of the window of rms and bias of a frequency [s], not a condition; default last 10 s
    """

    if_empty = (
        "give delay_relative_error, fit_percent, parameter_relative_error, band, by or several of them, or leave the "
        "section out"
    )

    delay_relative_error: Positive | None = None
    fit_percent: Annotated[float, Field(le=100.0, allow_inf_nan=False)] | None = None
    parameter_relative_error: Positive | None = None
    band: Positive | None = None
    by: Positive | None = None
    window: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] | None = None

    def violations(self) -> Iterator[Violation]:
        """Yield an empty rule, ``by`` or ``window`` without ``band``, and an empty window."""
        yield from super().violations()
        if self.by is not None and self.band is None:
            yield ("by",), "is the time of settling into a band; add band [rad/s]"
        if self.window is not None and self.band is None:
            yield ("window",), "is no condition by itself; add band [rad/s]"
        if self.window is not None and not self.window[0] < self.window[1]:
            yield ("window",), f"must begin before it ends; it runs from {self.window[0]:g} to {self.window[1]:g} s"


class LimitsSection(Section):
    """Limits of one estimate; an estimate that exceeds one is ended and counts as a failure of its estimator.

    Parameters
    ----------
    cpu_seconds : float, optional
        Maximum processor time of an estimate [s]; no limit by default
    wall_seconds : float, optional
        Maximum wall time of an estimate [s]; no limit by default
    memory_mb : float, optional
        Maximum memory of an estimate beyond that of its process before [MB]; no limit by default
    """

    if_empty = "give cpu_seconds, wall_seconds, memory_mb or several of them; for example {wall_seconds: 600}"

    cpu_seconds: Positive | None = None
    wall_seconds: Positive | None = None
    memory_mb: Positive | None = None


class Spec(Section):
    """One experiment: simulated or measured data or a signal, estimators, starts, and success rule.

    Parameters
    ----------
    experiment : str
        Name of the experiment and of its results folder, for example 'experiment: my-study'; '/' makes folders
    system : mapping, optional
        The system to simulate
    excitation : mapping, optional
        The input of the system, in open loop
    inputs : mapping of mappings, optional
        Several inputs by their names, in place of system and excitation, for example 'u1: {system: …, excitation: …}'
    loop : mapping, optional
        Controller that computes the input from the output, in place of excitation
    signal : mapping, optional
        A sum of sinusoids whose frequencies are estimated, in place of a system
    disturbance : mapping or "none", optional
        What is added to the signal; none by default
    sampling : mapping, optional
        Sampling instants of the output
    noise : mapping, optional
        What is added to the output; none by default
    data : mapping, optional
        A measured record, in place of system, excitation, sampling and noise
    estimators : mapping of mappings
        estimators by the names that tables show, for example 'mine: {kind: td_srivc, …}'
    starts : mapping, optional
        Initial delays and parameters; by default each estimator chooses its own
    monte_carlo : mapping, optional
        Number of data sets and their seed; needed if anything is random
    success : mapping, optional
        Conditions for an estimate to count as converged
    measures : list of str or mapping, optional
        What tables show, such as [bias, rmse, coverage]; by default percentages, or bias and rmse without success; a
        mapping with a kind is a custom measure
    limits : mapping, optional
        Time and memory that one estimate may take; no limits by default
    """

    experiment: Annotated[Text, _EXPERIMENT, AfterValidator(_usable)]
    system: AnySystemSection | None = None
    excitation: ExcitationSection | None = None
    inputs: Annotated[dict[Name, InputSection], AfterValidator(_several_inputs)] | None = None
    loop: Annotated[LoopSection | None, BeforeValidator(loop_as_mapping)] = None
    signal: SignalSection | None = None
    disturbance: DisturbanceOrNone | None = None
    sampling: AnySamplingSection | None = None
    noise: NoiseSection | None = None
    data: MeasuredSection | None = None
    estimators: Annotated[dict[Name, EstimatorSection], Field(min_length=1)]
    starts: StartsSection | None = None
    monte_carlo: MonteCarloSection | None = None
    success: SuccessSection | None = None
    measures: list[MeasureName] | None = None
    limits: LimitsSection | None = None

    _warnings: tuple[str, ...] = PrivateAttr(default=())
    _folder: Path = PrivateAttr(default=Path())
    _source: YamlSource = PrivateAttr(default_factory=lambda: YamlSource("(stored specification)"))

    @classmethod
    def details(cls, error: ValidationError, raw: Any) -> list[ErrorDetails]:
        """Return the pydantic errors of the values, naming only the estimators for this kind of experiment."""
        found = super().details(error, raw)
        given = {name for name in ("signal", "system", "data") if raw.get(name) is not None}
        kinds = KINDS["frequency_estimator" if "signal" in given else "estimator"]
        for detail in found if given else ():
            if detail["type"] == "no_kind" and detail["loc"][0] == "estimators":
                detail["ctx"] = {"allowed": ", ".join(kinds)}
        return found

    @property
    def measured(self) -> MeasuredSource | None:
        """Reader of the measured record, with its file relative to the working directory; None for simulated data."""
        if self.data is None:
            return None
        loop = None if self.loop is None else variants(self.loop)[0].options
        source: MeasuredSource = replace(located(self.data.options(), self.folder), loop=loop)
        return source

    @property
    def of_data(self) -> dict[KeyPath, Section]:
        """Sections of simulated data, by their key paths."""
        inputs: dict[KeyPath, Any] = {}
        for name, one in (self.inputs or {}).items():
            inputs |= {("inputs", name, "system"): one.system, ("inputs", name, "excitation"): one.excitation}
        sections = {(name,): getattr(self, name) for name in OF_DATA} | inputs
        return {path: section for path, section in sections.items() if section is not None}

    @property
    def generators(self) -> dict[KeyPath, Section]:
        """Sections of the inputs or of the loop's reference, by their key paths."""
        found = {path: section for path, section in self.of_data.items() if path[-1] == "excitation"}
        if self.loop is not None and self.loop.reference is not None:
            found[("loop", "reference")] = self.loop.reference
        return found

    @property
    def custom_measures(self) -> dict[str, CustomMeasureSection]:
        """Sections of the custom measures, by their names."""
        return {section.name: section for section in self.measures or () if isinstance(section, CustomMeasureSection)}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about questionable settings, each with its place in the file."""
        return self._warnings

    @property
    def text(self) -> str:
        """The specification as the user wrote it; the canonical form if there is no file."""
        return self._source.text or canonical_json(self.canonical())

    @property
    def folder(self) -> Path:
        """Folder that the names of data files are relative to."""
        return self._folder

    def canonical(self) -> dict[str, Any]:
        """Return the specification with all defaults, as plain data."""
        return self.model_dump(mode="json")


class SpecPart(Spec):
    """The valid part of a specification with errors; nothing is required.

    Parameters
    ----------
    experiment : str
        Name of the experiment; empty if it is invalid
    estimators : mapping of mappings
        Valid estimators, by their names
    """

    experiment: str = ""
    estimators: dict[str, EstimatorSection] = {}  # noqa: RUF012
