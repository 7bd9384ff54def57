"""Specifications: one YAML file describes one experiment.

`load_spec` reads a file, reports everything that is wrong with it at once, each problem with its line, column and key,
and returns a validated `Spec`. Its canonical form has every default filled in and no trace of how the file was
written; hashes of parts of it are the identity of data and estimators.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr, ValidationError, create_model

from ctid_cli.errors import DataError, Problem, SpecError
from ctid_cli.estimators import ESTIMATORS
from ctid_cli.experiment.dataset import MeasuredSource, check_input_file, file_sha256
from ctid_cli.experiment.sections import (
    Complaint,
    Section,
    Variant,
    by_kind,
    checked,
    choice,
    grouped,
    list_of,
    number,
    optional,
    plain_text,
    section_for,
    several_wrong,
    shown,
    swept,
    variants,
    whole,
    wrong,
)
from ctid_cli.experiment.yaml_source import (
    OVERRIDE_FILE,
    KeyPath,
    apply_overrides,
    path_text,
    read_yaml,
)
from ctid_cli.models import TransferFunction
from ctid_cli.signals import EXCITATIONS, NOISES, SAMPLINGS, InputFile, stream

#: Highest order that the simulation handles to its stated accuracy.
MAX_ORDER = 12

#: Samples, or clock periods of the input, of the longest record; ten times this would not fit in memory.
MAX_SAMPLES = 10_000_000
#: Pairs of excitation and sampling that are tried out when a specification is checked.
MAX_TRIALS = 64

_EXPERIMENT_PATTERN = r"(?!.*\.\.)(?=.{1,200}\Z)[A-Za-z0-9][A-Za-z0-9._-]*(?:/[A-Za-z0-9][A-Za-z0-9._-]*)*"
_EXPERIMENT_RULE = "use letters, digits, '-', '_' and '.', with '/' between parts, no '..', 200 characters at most"
_SIMULATED = ("system", "excitation", "sampling")


_COEFFICIENTS = list_of(number(), "a list of coefficients in descending powers of s")
_SHA256 = optional(plain_text("[0-9a-f]{64}", "a SHA-256 is 64 hexadecimal digits in lower case"))
_SHA256_DOC = "SHA-256 of the file, to make sure of its content; filled in from the file if it is missing"


def _kinds(options: Mapping[str, type]) -> dict[str, type[Section]]:
    pin = {"sha256": (Annotated[str | None, checked(_SHA256)], Field(default=None, description=_SHA256_DOC))}
    return {
        kind: section_for(target, kind=kind, extra=pin if target is InputFile else None)
        for kind, target in options.items()
    }


if TYPE_CHECKING:
    ExcitationSection = Section
    SamplingSection = Section
    NoiseSection = Section
    EstimatorSection = Section
else:
    ExcitationSection = by_kind(_kinds(EXCITATIONS))
    SamplingSection = by_kind(_kinds(SAMPLINGS))
    NoiseSection = by_kind(_kinds(NOISES))
    EstimatorSection = by_kind(_kinds(ESTIMATORS))


def _check_of(annotation: Any) -> Any:
    """The check inside an annotation of `by_kind`."""
    from pydantic import TypeAdapter

    return TypeAdapter(annotation).validate_python


class SystemSection(Section):
    """The system to simulate: ``G(s) = B(s)/A(s) exp(-delay s)``, strictly proper and stable."""

    target: ClassVar[type | None] = TransferFunction
    sweepable: ClassVar[frozenset[str]] = frozenset({"delay"})

    numerator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients of B in descending powers of s"
    )
    denominator: Annotated[list[float], checked(_COEFFICIENTS)] = Field(
        description="Coefficients of A in descending powers of s"
    )
    delay: Annotated[float | list[float], checked(swept(number("s", at_least=0.0)))] = Field(
        default=0.0, description="Pure delay [s]"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say why the system cannot be simulated.

        Yields
        ------
        tuple
            Key path inside the section, and message.
        """
        problems = list(super().complaints())
        yield from problems
        if problems:
            return
        with np.errstate(all="ignore"):
            model = TransferFunction(self.numerator, self.denominator)
        if not (np.isfinite(model.numerator).all() and np.isfinite(model.denominator).all()):
            yield ("denominator",), "its first coefficient is too small for the others; scale the coefficients"
            return
        zeros = model.order - model.relative_degree
        if not model.numerator.any():
            yield ("numerator",), "all coefficients are zero, so the output would be too"
        if model.relative_degree < 1:
            yield (
                (),
                f"there are {zeros} zeros and {model.order} poles; the system must be strictly proper, "
                "with fewer zeros than poles",
            )
        elif model.order > MAX_ORDER:
            yield ("denominator",), f"{model.order} poles are too many; at most {MAX_ORDER} can be simulated exactly"
        elif not model.is_stable:
            offending = [_complex_text(pole) for pole in model.poles if not pole.real < 0]
            yield (
                (),
                f"the system is unstable and cannot be simulated: {'pole' if len(offending) == 1 else 'poles'} at "
                f"{', '.join(offending)} rad/s; every pole needs a negative real part",
            )


class MeasuredSection(Section):
    """A measured record in place of a simulated one."""

    file: Annotated[str, checked(plain_text())] = Field(
        description="Comma-separated file, relative to the folder of the specification"
    )
    sha256: Annotated[str | None, checked(_SHA256)] = Field(default=None, description=_SHA256_DOC)
    time: Annotated[str, checked(plain_text())] = Field(default="t", description="Column of the instants [s]")
    input: Annotated[str, checked(plain_text())] = Field(default="u", description="Column of the input [input unit]")
    output: Annotated[str, checked(plain_text())] = Field(
        default="y", description="Column of the output [output unit]; empty or NaN is a missing sample"
    )
    hold: Annotated[Literal["zoh", "foh"], checked(choice("zoh", "foh"))] = Field(
        default="zoh", description="How the input behaves between its samples"
    )
    offset: Annotated[Literal["remove", "none"], checked(choice("remove", "none"))] = Field(
        default="none", description="What is done to the means of input and output over the samples for estimation"
    )
    estimation_samples: Annotated[int | None, checked(optional(whole(at_least=2)))] = Field(
        default=None, description="Identify on the first so many samples and judge on the rest; null identifies on all"
    )

    def source(self, folder: Path) -> MeasuredSource:
        """Reader of the record.

        Parameters
        ----------
        folder : Path
            Folder that the name of the file is relative to.

        Returns
        -------
        MeasuredSource
            With the content hash of the section, or of the file as it is now.
        """
        file = _joined(folder, self.file)
        return MeasuredSource(**(self.model_dump() | {"file": file, "sha256": self.sha256 or file_sha256(file)}))


class UniformStart(Section):
    """An initial delay drawn anew for every data set."""

    uniform: Annotated[
        list[float], checked(list_of(number("s", at_least=0.0), "a list of two delays [s]", length=2))
    ] = Field(description="Least and greatest value [s]")

    def complaints(self) -> Iterator[Complaint]:
        """Say why the range is none.

        Yields
        ------
        tuple
            Key path inside the section, and message.
        """
        if not self.uniform[0] < self.uniform[1]:
            low, high = self.uniform
            yield ("uniform",), f"the first value, {low:g} s, must be below the second, {high:g} s"


def _start_check(value: Any) -> float | UniformStart:
    if isinstance(value, (Mapping, UniformStart)):
        return UniformStart.model_validate(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise wrong(f"must be a delay [s] or {{uniform: [low, high]}}, not {shown(value)}")
    return float(number("s", at_least=0.0)(value))


def _starts_check(value: Any) -> list[float | UniformStart]:
    if not isinstance(value, (list, tuple)):
        return [_start_check(value)]
    items: list[float | UniformStart] = list_of(_start_check, "a list of delays [s]")(value)
    for k, item in enumerate(items):
        if item in items[:k]:
            raise several_wrong("starts", [((k,), "this start is in the list twice; keep one of them", False)])
    return items


class StartsSection(Section):
    """Where estimators that need an initial delay start."""

    initial_delay: Annotated[list[float | UniformStart] | float | UniformStart, checked(_starts_check)] = Field(
        description="Initial delays [s]; {uniform: [low, high]} draws one for every data set"
    )

    @property
    def points(self) -> list[float | UniformStart]:
        """The starts, in the order of the specification."""
        assert isinstance(self.initial_delay, list)
        return self.initial_delay


class MonteCarloSection(Section):
    """How many data sets, and which."""

    runs: Annotated[int, checked(whole(at_least=1, at_most=1_000_000))] = Field(
        description="Data sets of every data cell"
    )
    seed: Annotated[int, checked(whole(at_least=0))] = Field(
        description="Seed of all random numbers; with the same seed the same data sets come out"
    )


class SuccessSection(Section):
    """When an estimate counts as converged; all that is given must hold."""

    delay_relative_error: Annotated[float | None, checked(optional(number(above=0.0)))] = Field(
        default=None, description="Largest error of the delay, as a fraction of the true delay [-]"
    )
    fit_percent: Annotated[float | None, checked(optional(number("%", at_most=100.0)))] = Field(
        default=None, description="Least fit of the simulated output [%]"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that nothing is asked for.

        Yields
        ------
        tuple
            Key path inside the section, and message.
        """
        if self.delay_relative_error is None and self.fit_percent is None:
            yield (), "give delay_relative_error, fit_percent or both, or leave the section out"


def _estimators_check(value: Any) -> dict[str, Section]:
    if not isinstance(value, Mapping):
        raise wrong(f"must be a mapping from names to estimators, not {shown(value)}")
    if not value:
        raise wrong("there is no estimator; add one, for example 'mine: {kind: td_srivc, …}'")
    name_check = plain_text("[A-Za-z0-9_-]{1,60}", "a name has letters, digits, '-' and '_', at most 60 of them")
    sections: dict[str, Section] = {}
    complaints: list[tuple[KeyPath, str, bool]] = []
    for name, settings in value.items():
        for check, item, at_key in ((name_check, name, True), (_estimator_check, settings, False)):
            try:
                result = check(item)
            except ValidationError as error:
                complaints += [
                    ((name, *e["loc"]), e["msg"], bool(e.get("ctx", {}).get("at_key")))
                    for e in error.errors(include_url=False)
                ]
            except ValueError as error:  # PydanticCustomError
                complaints.append(((name,), str(error), at_key))
            else:
                if check is _estimator_check:
                    sections[name] = result
    if complaints:
        raise several_wrong("estimators", complaints)
    return sections


_estimator_check = _check_of(EstimatorSection)


class Spec(Section):
    """One experiment: simulated or measured data, estimators, starts, and what counts as success."""

    experiment: Annotated[str, checked(plain_text(_EXPERIMENT_PATTERN, _EXPERIMENT_RULE))] = Field(
        description="Name of the experiment and of its results folder; '/' makes folders in folders"
    )
    system: Annotated[SystemSection | None, checked(optional(SystemSection.model_validate))] = Field(
        default=None, description="The system to simulate"
    )
    excitation: Annotated[ExcitationSection | None, checked(optional(_check_of(ExcitationSection)))] = Field(
        default=None, description="The input of the system"
    )
    sampling: Annotated[SamplingSection | None, checked(optional(_check_of(SamplingSection)))] = Field(
        default=None, description="When the output is sampled"
    )
    noise: Annotated[NoiseSection | None, checked(optional(_check_of(NoiseSection)))] = Field(
        default=None, description="What is added to the output; none by default"
    )
    data: Annotated[MeasuredSection | None, checked(optional(MeasuredSection.model_validate))] = Field(
        default=None, description="A measured record, in place of system, excitation, sampling and noise"
    )
    estimators: Annotated[dict[str, EstimatorSection], checked(_estimators_check)] = Field(
        description="Estimators by the names that tables show"
    )
    starts: Annotated[StartsSection | None, checked(optional(StartsSection.model_validate))] = Field(
        default=None, description="Initial delays; by default every estimator chooses its own"
    )
    monte_carlo: Annotated[MonteCarloSection | None, checked(optional(MonteCarloSection.model_validate))] = Field(
        default=None, description="Number of data sets and their seed; needed for simulated data"
    )
    success: Annotated[SuccessSection | None, checked(optional(SuccessSection.model_validate))] = Field(
        default=None, description="When an estimate counts as converged"
    )

    _warnings: tuple[str, ...] = PrivateAttr(default=())
    _text: str = PrivateAttr(default="")
    _folder: Path = PrivateAttr(default=Path())

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        """Say which sections are missing or too many.

        Parameters
        ----------
        raw : mapping
            The specification as it was read.

        Yields
        ------
        tuple
            Key path, and message.
        """
        present = {name for name in (*_SIMULATED, "noise", "data", "monte_carlo") if raw.get(name) is not None}
        if "data" in present:
            for name in (*_SIMULATED, "noise"):
                if name in present:
                    yield (name,), "belongs to simulated data, and 'data' names a measured record; keep one of the two"
            return
        missing = [name for name in _SIMULATED if name not in present]
        if len(missing) == len(_SIMULATED):
            yield (), "there are no data: give system, excitation and sampling to simulate them, or data for a record"
            return
        for name in missing:
            yield (name,), "is missing; data are simulated with system, excitation and sampling"
        if "monte_carlo" not in present:
            yield ("monte_carlo",), "is missing; add it, for example {runs: 100, seed: 1}"

    def complaints(self) -> Iterator[Complaint]:
        """Say which estimators are the same.

        Yields
        ------
        tuple
            Key path, and message.
        """
        seen: dict[str, str] = {}
        for name, section in self.estimators.items():
            for variant in variants(section):
                other = seen.setdefault(canonical_json(variant.values), name)
                if other != name:
                    yield ("estimators", name), f"the same settings as {other!r}; its estimates would be the same too"
                    break

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is unwise but allowed, each with its place in the file."""
        return self._warnings

    @property
    def text(self) -> str:
        """The specification as the user wrote it; the canonical form where there is no file."""
        return self._text or canonical_json(self.canonical())

    @property
    def folder(self) -> Path:
        """Folder that the names of data files are relative to."""
        return self._folder

    def canonical(self) -> dict[str, Any]:
        """The specification with all defaults, as plain data.

        Returns
        -------
        dict
            JSON-able. File names are as the user wrote them, and content hashes stand beside them.
        """
        return self.model_dump(mode="json")

    def with_runs(self, runs: int) -> Spec:
        """The same experiment with another number of data sets.

        Parameters
        ----------
        runs : int
            Data sets of every data cell.

        Returns
        -------
        Spec
            A copy; its identity is the same.
        """
        if self.monte_carlo is None:
            return self
        return self.model_copy(update={"monte_carlo": self.monte_carlo.model_copy(update={"runs": runs})})


class _PartialSpec(Spec):
    """What is left of a specification when the broken sections are taken out."""

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        yield from ()


# Same fields, none of them required.
_Remainder = create_model(
    "_Remainder",
    __base__=_PartialSpec,
    experiment=(str | None, None),
    estimators=(Spec.model_fields["estimators"].rebuild_annotation(), {}),
)


def load_spec(path: Path, overrides: Sequence[str] = ()) -> Spec:
    """Read and check a specification.

    Parameters
    ----------
    path : Path
        YAML file.
    overrides : sequence of str, optional
        ``key.path=value`` each, applied before the check; they become part of the experiment's identity.

    Returns
    -------
    Spec
        Content hashes of data files are filled in.

    Raises
    ------
    UsageError
        If the file cannot be read.
    SpecError
        With everything that is wrong in it.

    Notes
    -----
    Sampling is called slow, which is a warning and no error, if its (mean) interval exceeds pi / max |p| over the
    poles p [rad/s] of the system: its rate is then below twice the frequency of the fastest pole.
    """
    source = read_yaml(Path(path))
    apply_overrides(source, overrides)
    tree = source.tree
    if not isinstance(tree, dict):
        message = f"the file must hold a mapping that begins with 'experiment: name', not {shown(tree)}"
        raise SpecError([Problem(source.file, 1, 1, "", "the file is empty" if tree is None else message)])
    spec, complaints = _validated(tree)
    spec._folder = Path(path).parent
    spec, about_files = _with_files(spec)
    joint = _joint_complaints(spec, files_are_good=not about_files)
    complaints += [(where, message, False) for where, message in (*about_files, *joint)]
    if complaints:
        problems = {source.problem(where, message, key=at_key) for where, message, at_key in complaints}
        in_order = sorted(problems, key=lambda p: (p.file == OVERRIDE_FILE, p.line, p.column, p.key, p.message))
        raise SpecError(in_order)
    spec._warnings = tuple(str(source.problem(where, message)) for where, message in _joint_warnings(spec))
    spec._text = Path(path).read_text(encoding="utf-8-sig")
    return spec


def spec_from_canonical(canonical: Mapping[str, Any], folder: Path | None = None) -> Spec:
    """A specification from its canonical form.

    Parameters
    ----------
    canonical : mapping
        What `Spec.canonical` gave.
    folder : Path, optional
        Folder that file names in it are relative to; the working directory by default.

    Returns
    -------
    Spec
        Its data files are not read; their content is compared with the stored hash when a data set is made.

    Raises
    ------
    SpecError
        If the form is not valid for this version of the program.
    """
    spec, complaints = _validated(dict(canonical))
    if complaints:
        name = "(canonical specification)"
        raise SpecError([Problem(name, 1, 1, path_text(path), message) for path, message, _ in complaints])
    spec._folder = folder or Path()
    return spec


def located(options: Any, folder: Path) -> Any:
    """An excitation with the name of its file, if it reads one, as seen from the working directory.

    Parameters
    ----------
    options : Any
        Option dataclass of an excitation.
    folder : Path
        Folder that the name of the file is relative to.

    Returns
    -------
    Any
        The same, or a copy.
    """
    if not isinstance(options, InputFile):
        return options
    return dataclasses.replace(options, file=_joined(folder, options.file))


def _joined(folder: Path, file: str) -> str:
    return Path(os.path.normpath(folder / file)).as_posix()


def json_schema() -> dict[str, Any]:
    """JSON Schema of specifications, for editors.

    Returns
    -------
    dict
        Fields with descriptions and units; a field that can be swept is a value or a list.
    """
    schema = Spec.model_json_schema()
    schema["anyOf"] = [{"required": ["data"]}, {"required": [*_SIMULATED, "monte_carlo"]}]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ctid experiment"}


def canonical_json(content: Any) -> str:
    """The one JSON text of some content.

    Parameters
    ----------
    content : Any
        Dictionaries, lists and scalars, all finite.

    Returns
    -------
    str
        Keys sorted, no spaces.
    """
    return json.dumps(content, sort_keys=True, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def content_hash(content: Any) -> str:
    """Identity of some content.

    Parameters
    ----------
    content : Any
        Dictionaries, lists and scalars, all finite.

    Returns
    -------
    str
        First 16 hexadecimal digits of the SHA-256 of its canonical JSON.
    """
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:16]


def _validated(tree: dict[str, Any]) -> tuple[Spec, list[tuple[KeyPath, str, bool]]]:
    """A specification and what is wrong with it; if anything is, the specification is what remains without it."""
    try:
        return Spec.model_validate(tree), []
    except ValidationError as error:
        complaints = [
            (tuple(e["loc"]), e["msg"], bool(e.get("ctx", {}).get("at_key"))) for e in error.errors(include_url=False)
        ]
    good = {key: value for key, value in tree.items() if key in Spec.model_fields}
    for path, _, _ in complaints:
        if path[:1] == ("estimators",) and len(path) > 1 and isinstance(good.get("estimators"), dict):
            good["estimators"] = {name: item for name, item in good["estimators"].items() if name != path[1]}
        elif path:
            good.pop(str(path[0]), None)
    if not good.get("estimators"):
        good.pop("estimators", None)
    return _Remainder.model_validate(good), complaints


def _with_files(spec: Spec) -> tuple[Spec, list[Complaint]]:
    """The specification with content hashes filled in, and what is wrong with the files."""
    update: dict[str, Any] = {}
    problems: list[Complaint] = []
    for name in ("data", "excitation"):
        section = getattr(spec, name)
        if not hasattr(section, "sha256"):
            continue
        file = _joined(spec.folder, section.file)
        try:
            content = file_sha256(file)
            if section.sha256 not in (None, content):
                problems.append(((name, "sha256"), f"the SHA-256 of {file} is {content}; is it another file?"))
                continue
            update[name] = section.model_copy(update={"sha256": content})
            if name == "excitation":
                check_input_file(located(variants(section)[0].options, spec.folder))
            else:
                section.source(spec.folder).dataset(0)
        except DataError as error:
            problems.append(((name, "file"), str(error)))
    return spec.model_copy(update=update), problems


class _Extent:
    """How long a record is, and how many of its samples are left after a delay."""

    def __init__(self, combination: Mapping[KeyPath, Any], interval: float, samples: int, times: Any = None) -> None:
        self.combination = combination
        self.duration = interval * (samples - 1)
        self._interval = interval
        self._samples = samples
        self._times = times

    def samples_after(self, delay: float) -> int:
        if self._times is not None:
            return int(np.count_nonzero(self._times >= delay))
        return max(self._samples - math.ceil(delay / self._interval), 0)


def _extents(spec: Spec) -> list[_Extent]:
    if spec.data is not None:
        record = spec.data.source(spec.folder).dataset(0).record
        interval = record.duration / max(record.n_samples - 1, 1)
        return [_Extent({}, interval, record.n_samples, (record.t - record.t[0])[record.valid])]
    return [
        # Random intervals stand for themselves at their mean.
        _Extent(_prefixed("sampling", variant.swept), _mean_interval(variant.options), variant.options.samples)
        for variant in (variants(spec.sampling) if spec.sampling is not None else [])
    ]


def _prefixed(section: str, combination: Mapping[KeyPath, Any]) -> dict[KeyPath, Any]:
    return {(section, *path): value for path, value in combination.items()}


def _mean_interval(sampling: Any) -> float:
    return float(sampling.interval) if hasattr(sampling, "interval") else 0.5 * float(sampling.low + sampling.high)


def _joint_complaints(spec: Spec, *, files_are_good: bool) -> Iterator[Complaint]:
    """What is wrong although every section is right by itself."""
    extents = _extents(spec) if files_are_good else []
    for name, section in spec.estimators.items():
        cases = variants(section)
        failures = [
            (("estimators", name, *path), message, {**variant.swept, **extent.combination})
            for variant in cases
            for extent in extents
            for path, message in _record_complaints(variant.options, extent)
        ]
        yield from grouped(failures, len(cases) * len(extents))
        if spec.starts is not None:
            yield from grouped(_start_failures(spec.starts, name, cases), len(cases))
    random = [k for k, point in enumerate(spec.starts.points) if isinstance(point, UniformStart)] if spec.starts else []
    if spec.data is not None and random and spec.monte_carlo is None:
        yield ("starts", "initial_delay", random[0]), "a random start needs a seed; add monte_carlo: {runs: 1, seed: 1}"
    if spec.success is not None and spec.success.delay_relative_error is not None:
        path = ("success", "delay_relative_error")
        if spec.data is not None:
            yield path, "the true delay of a measured record is not known; use fit_percent, or leave it out"
        elif spec.system is not None and 0.0 in np.atleast_1d(spec.system.delay):
            yield path, "a relative error needs a true delay above zero; use fit_percent, or leave it out"
    if files_are_good:
        yield from _simulation_complaints(spec, extents)


def _simulation_complaints(spec: Spec, extents: Sequence[_Extent]) -> Iterator[Complaint]:
    """What the sections that data are simulated from have against each other."""
    samplings = variants(spec.sampling) if spec.sampling is not None else []
    too_long: list[tuple[KeyPath, str, Mapping[KeyPath, Any]]] = [
        (("sampling", "samples"), f"more than {MAX_SAMPLES} samples in a record are not supported", {})
        for variant in samplings
        if variant.options.samples > MAX_SAMPLES
    ]
    if too_long:
        yield from grouped(too_long, 1)
        return
    if spec.system is not None:
        delays = variants(spec.system)
        late = [
            (
                ("system", "delay"),
                f"a delay of {variant.options.delay:g} s is not shorter than the record ({extent.duration:g} s); "
                "the output would be noise alone",
                {**_prefixed("system", variant.swept), **extent.combination},
            )
            for variant in delays
            for extent in extents
            if variant.options.delay >= extent.duration
        ]
        yield from grouped(late, len(delays) * len(extents))
    if spec.excitation is None:
        return
    excitations = variants(spec.excitation)
    # Some faults show only where an excitation meets a sampling scheme: a step after the end, a tone that the clock
    # cannot carry. One data set of each pair tells; pairs beyond the first ones repeat what these say.
    failures: list[tuple[KeyPath, str, Mapping[KeyPath, Any]]] = []
    pairs = list(itertools.product(excitations, zip(samplings, extents, strict=False)))[:MAX_TRIALS]
    seed = spec.monte_carlo.seed if spec.monte_carlo is not None else 0
    for excitation, (sampling, extent) in pairs:
        combination = {**_prefixed("excitation", excitation.swept), **extent.combination}
        clock = getattr(excitation.options, "clock_period", None)
        if clock is not None and extent.duration / clock > MAX_SAMPLES:
            message = f"a record of {extent.duration:g} s has more than {MAX_SAMPLES} clock periods of {clock:g} s"
            failures.append((("excitation", "clock_period"), message, combination))
            continue
        try:
            times = sampling.options.times(stream(seed, "sampling", 0))
            located(excitation.options, spec.folder).generate(times, stream(seed, "input", 0))
        except DataError as error:
            failures.append((("excitation",), str(error), combination))
    yield from grouped(failures, len(pairs))


def _record_complaints(options: Any, extent: _Extent) -> Iterator[Complaint]:
    bounds = getattr(options, "delay_bounds", None)
    key = "delay" if bounds is None else "delay_bounds"
    latest = float(getattr(options, "delay", 0.0) if bounds is None else bounds[1])
    parameters = int(options.poles + options.zeros + 1 + (bounds is not None))
    total, left = extent.samples_after(0.0), extent.samples_after(latest)
    if latest >= extent.duration and latest > 0:
        yield (
            (key,),
            f"a delay of {latest:g} s is not shorter than the record ({extent.duration:g} s), so no sample would be "
            "left to use; lower it, or take more samples",
        )
    elif left <= parameters:
        masked = f" after the first {latest:g} s" if left < total else ""
        yield (
            (),
            f"{left} samples{masked} are too few for {parameters} parameters; "
            "take more samples, fewer poles or zeros, or a smaller largest delay",
        )


def _start_failures(
    starts: StartsSection, name: str, cases: Sequence[Variant]
) -> Iterator[tuple[KeyPath, str, Mapping[KeyPath, Any]]]:
    for variant in cases:
        if not (variant.options.uses_start and hasattr(variant.options, "delay_bounds")):
            continue
        low, high = variant.options.delay_bounds
        for k, point in enumerate(starts.points):
            ends = point.uniform if isinstance(point, UniformStart) else [point]
            outside = [end for end in ends if not low <= end <= high]
            if outside:
                message = f"{outside[0]:g} s is outside the delay bounds [{low:g}, {high:g}] s of estimator {name!r}"
                yield ("starts", "initial_delay", k), message, variant.swept


def _joint_warnings(spec: Spec) -> list[Complaint]:
    warnings: list[Complaint] = []
    if spec.system is not None and spec.sampling is not None:
        model = TransferFunction(spec.system.numerator, spec.system.denominator)
        fastest = float(np.abs(model.poles).max())
        slow = []
        cases = variants(spec.sampling)
        for variant in cases:
            interval = _mean_interval(variant.options)
            if interval > math.pi / fastest:
                key: KeyPath = ("sampling", "interval") if hasattr(variant.options, "interval") else ("sampling",)
                message = (
                    f"sampling every {interval:g} s is slower than twice the fastest pole ({fastest:.4g} rad/s, "
                    f"{fastest / (2 * math.pi):.4g} Hz): intervals below {math.pi / fastest:.4g} s see it"
                )
                slow.append((key, message, variant.swept))
        warnings += grouped(slow, len(cases))
    if spec.data is not None and spec.monte_carlo is not None and spec.monte_carlo.runs > 1:
        warnings.append((("monte_carlo", "runs"), "a measured record is one data set; it is run once"))
    if spec.starts is not None and not any(
        variant.options.uses_start for section in spec.estimators.values() for variant in variants(section)[:1]
    ):
        warnings.append((("starts",), "no estimator here uses a start; each is run once"))
    return warnings


def _complex_text(value: complex) -> str:
    if value.imag == 0:
        return f"{value.real:.4g}"
    return f"{value.real:.4g}{value.imag:+.4g}j"
