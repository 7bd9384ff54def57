"""Specifications: one YAML file describes one experiment.

`load_spec` reads a file, reports everything that is wrong with it at once, each problem with its line, column and key,
and returns a validated `Spec`. Its canonical form has every default filled in and no trace of how the file was
written; hashes of parts of it are the identity of data and estimators.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PrivateAttr, ValidationError, create_model

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import DataError, Problem, SpecError
from ctid_cli.simulation.dataset import LoopOptions, MeasuredSource, check_input_file, file_sha256, joined, located
from ctid_cli.specification.joint_checks import joint_complaints, joint_warnings
from ctid_cli.specification.loop_section import LoopSection
from ctid_cli.specification.option_sections import (
    SHA256,
    SHA256_DOC,
    EstimatorSection,
    ExcitationSection,
    NoiseSection,
    check_of,
)
from ctid_cli.specification.sections import (
    Complaint,
    Section,
    checked,
    choice,
    number,
    optional,
    plain_text,
    several_wrong,
    shown,
    variants,
    whole,
    wrong,
)
from ctid_cli.specification.signal_sections import (
    AnySamplingSection,
    DisturbanceOrNone,
    SignalSection,
    TracksSection,
    disturbance_section,
    sampling_section,
)
from ctid_cli.specification.start_sections import StartsSection
from ctid_cli.specification.system_sections import AdditiveSystemSection, SystemSection, system_section
from ctid_cli.specification.yaml_source import (
    OVERRIDE_FILE,
    KeyPath,
    apply_overrides,
    path_text,
    read_yaml,
)

_EXPERIMENT_PATTERN = r"(?!.*\.\.)(?=.{1,200}\Z)[A-Za-z0-9][A-Za-z0-9._-]*(?:/[A-Za-z0-9][A-Za-z0-9._-]*)*"
_EXPERIMENT_RULE = "use letters, digits, '-', '_' and '.', with '/' between parts, no '..', 200 characters at most"
_SIMULATED = ("system", "excitation", "sampling")
#: Sections that belong to the identification of systems.
_OF_SYSTEMS = ("system", "excitation", "loop", "noise", "data", "starts")


class MeasuredSection(Section):
    """A measured record in place of a simulated one."""

    added_later: ClassVar[frozenset[str]] = frozenset({"reference"})

    file: Annotated[str, checked(plain_text())] = Field(
        description="Comma-separated file, relative to the folder of the specification"
    )
    sha256: Annotated[str | None, checked(SHA256)] = Field(default=None, description=SHA256_DOC)
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
    reference: Annotated[str | None, checked(optional(plain_text()))] = Field(
        default=None, description="Column of the reference, if the record was taken in a loop; loop has the controller"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that a loop does not have such an input."""
        if self.reference is not None and self.hold != "zoh":
            yield ("hold",), "must be zoh in a loop: a discrete controller holds the input between its samples"

    def source(self, folder: Path, loop: LoopOptions | None = None) -> MeasuredSource:
        """Reader of the record."""
        file = joined(folder, self.file)
        own = {"file": file, "sha256": self.sha256 or file_sha256(file), "loop": loop}
        return MeasuredSource(**(self.model_dump() | own))


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

    added_later: ClassVar[frozenset[str]] = frozenset({"parameter_relative_error", "band", "by"})

    delay_relative_error: Annotated[float | None, checked(optional(number(above=0.0)))] = Field(
        default=None, description="Largest error of the delay, as a fraction of the true delay [-]"
    )
    fit_percent: Annotated[float | None, checked(optional(number("%", at_most=100.0)))] = Field(
        default=None, description="Least fit of the simulated output [%]"
    )
    parameter_relative_error: Annotated[float | None, checked(optional(number(above=0.0)))] = Field(
        default=None, description="Largest error of a parameter of the submodels, as a fraction of the true value [-]"
    )
    band: Annotated[float | None, checked(optional(number("rad/s", above=0.0)))] = Field(
        default=None, description="Largest error of a settled frequency of a signal [rad/s]"
    )
    by: Annotated[float | None, checked(optional(number("s", above=0.0)))] = Field(
        default=None, description="Frequencies must settle so soon after the start and after their last step [s]"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that nothing is asked for."""
        if all(getattr(self, name) is None for name in type(self).model_fields):
            yield (), f"give {', '.join(type(self).model_fields)} or several of them, or leave the section out"
        if self.by is not None and self.band is None:
            yield ("by",), "is the time of settling into a band; add band [rad/s]"


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


_estimator_check = check_of(EstimatorSection)


class Spec(Section):
    """One experiment: simulated or measured data or a signal, estimators, starts, and what counts as success."""

    added_later: ClassVar[frozenset[str]] = frozenset({"loop", "signal", "disturbance", "tracks"})

    experiment: Annotated[str, checked(plain_text(_EXPERIMENT_PATTERN, _EXPERIMENT_RULE))] = Field(
        description="Name of the experiment and of its results folder; '/' makes folders in folders"
    )
    system: Annotated[SystemSection | AdditiveSystemSection | None, checked(optional(system_section))] = Field(
        default=None, description="The system to simulate"
    )
    excitation: Annotated[ExcitationSection | None, checked(optional(check_of(ExcitationSection)))] = Field(
        default=None, description="The input of the system, in open loop"
    )
    loop: Annotated[LoopSection | None, checked(optional(LoopSection.model_validate))] = Field(
        default=None, description="What makes the input from the output, in place of excitation"
    )
    signal: Annotated[SignalSection | None, checked(optional(SignalSection.model_validate))] = Field(
        default=None, description="A sum of sinusoids whose frequencies are estimated, in place of a system"
    )
    disturbance: Annotated[DisturbanceOrNone | None, checked(disturbance_section)] = Field(
        default=None, description="What is added to the signal; none by default"
    )
    sampling: Annotated[AnySamplingSection | None, checked(optional(sampling_section))] = Field(
        default=None, description="When the output is sampled"
    )
    noise: Annotated[NoiseSection | None, checked(optional(check_of(NoiseSection)))] = Field(
        default=None, description="What is added to the output; none by default"
    )
    data: Annotated[MeasuredSection | None, checked(optional(MeasuredSection.model_validate))] = Field(
        default=None, description="A measured record, in place of system, excitation, sampling and noise"
    )
    estimators: Annotated[dict[str, EstimatorSection], checked(_estimators_check)] = Field(
        description="Estimators by the names that tables show"
    )
    starts: Annotated[StartsSection | None, checked(optional(StartsSection.model_validate))] = Field(
        default=None, description="Initial delays and parameters; by default every estimator chooses its own"
    )
    monte_carlo: Annotated[MonteCarloSection | None, checked(optional(MonteCarloSection.model_validate))] = Field(
        default=None, description="Number of data sets and their seed; needed for simulated data"
    )
    success: Annotated[SuccessSection | None, checked(optional(SuccessSection.model_validate))] = Field(
        default=None, description="When an estimate counts as converged"
    )
    tracks: Annotated[TracksSection | None, checked(optional(TracksSection.model_validate))] = Field(
        default=None, description="What is stored of the frequencies of a signal over time; nothing by default"
    )

    _warnings: tuple[str, ...] = PrivateAttr(default=())
    _text: str = PrivateAttr(default="")
    _folder: Path = PrivateAttr(default=Path())

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        """Say which sections are missing or too many."""
        present = {name for name in cls.model_fields if raw.get(name) is not None}
        if "signal" in present:
            for name in _OF_SYSTEMS:
                if name in present:
                    other = "; what is added to a signal is its disturbance" if name == "noise" else ""
                    message = (
                        f"belongs to the identification of a system, and 'signal' is none; keep one of the two{other}"
                    )
                    yield (name,), message
            for name, example in (
                ("sampling", "{kind: regular, interval: 0.001, duration: 60}"),
                ("monte_carlo", "{runs: 10, seed: 1}"),
            ):
                if name not in present:
                    yield (name,), f"is missing; a signal needs it, for example {example}"
            return
        for name in ("disturbance", "tracks"):
            if name in present:
                yield (name,), "belongs to a signal, and there is none; add signal, or leave it out"
        loop = raw.get("loop")
        has_reference = isinstance(loop, Mapping) and loop.get("reference") is not None
        if "data" in present:
            for name in (*_SIMULATED, "noise"):
                if name in present:
                    yield (name,), "belongs to simulated data, and 'data' names a measured record; keep one of the two"
            if has_reference:
                message = "belongs to simulated data; the reference of a measured record is a column, data.reference"
                yield ("loop", "reference"), message
            data = raw["data"]
            column = isinstance(data, Mapping) and data.get("reference") is not None
            if column and loop is None:
                yield ("data", "reference"), "needs the controller too; add loop: {controller: {…}}"
            elif loop is not None and isinstance(data, Mapping) and not column:
                yield ("data", "reference"), "is missing; a loop has a reference: name its column"
            return
        if "loop" in present and "excitation" in present:
            yield (
                ("excitation",),
                "the loop makes the input; keep one of the two (a reference stands in loop.reference)",
            )
        elif isinstance(loop, Mapping) and not has_reference:
            yield (
                ("loop", "reference"),
                "is missing; add what the loop is driven by, for example {kind: gaussian, standard_deviation: 1.0}",
            )
        missing = [
            name for name in _SIMULATED if name not in present and not (name == "excitation" and "loop" in present)
        ]
        if len(missing) == len(_SIMULATED):
            yield (
                (),
                (
                    "there are no data: give system, excitation and sampling to simulate them, data for a record, or "
                    "signal and sampling to estimate frequencies"
                ),
            )
            return
        for name in missing:
            yield (name,), "is missing; data are simulated with system, excitation (or loop) and sampling"
        if "monte_carlo" not in present:
            yield ("monte_carlo",), "is missing; add it, for example {runs: 100, seed: 1}"

    def complaints(self) -> Iterator[Complaint]:
        """Say which estimators are the same."""
        seen: dict[str, str] = {}
        for name, section in self.estimators.items():
            for variant in variants(section):
                other = seen.setdefault(canonical_json(variant.values), name)
                if other != name:
                    yield ("estimators", name), f"the same settings as {other!r}; its estimates would be the same too"
                    break

    @property
    def measured(self) -> MeasuredSource | None:
        """Reader of the measured record, its file as seen from the working directory; None for simulated data."""
        if self.data is None:
            return None
        loop = None if self.loop is None else variants(self.loop)[0].options
        return self.data.source(self.folder, loop)

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

    def with_runs(self, runs: int) -> Spec:
        """The same experiment with another number of data sets."""
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
    broken = frozenset(str(where[0]) for where, _, _ in complaints if where)
    joint = joint_complaints(spec, broken, files_are_good=not about_files)
    complaints += [(where, message, False) for where, message in (*about_files, *joint)]
    if complaints:
        problems = {source.problem(where, message, key=at_key) for where, message, at_key in complaints}
        in_order = sorted(problems, key=lambda p: (p.file == OVERRIDE_FILE, p.line, p.column, p.key, p.message))
        raise SpecError(in_order)
    spec._warnings = tuple(str(source.problem(where, message)) for where, message in joint_warnings(spec))
    spec._text = Path(path).read_text(encoding="utf-8-sig")
    return spec


def spec_from_canonical(canonical: Mapping[str, Any], folder: Path | None = None) -> Spec:
    """A specification from its canonical form."""
    spec, complaints = _validated(dict(canonical))
    if complaints:
        name = "(canonical specification)"
        raise SpecError([Problem(name, 1, 1, path_text(path), message) for path, message, _ in complaints])
    spec._folder = folder or Path()
    return spec


def json_schema() -> dict[str, Any]:
    """JSON Schema of specifications, for editors."""
    schema = Spec.model_json_schema()
    schema["anyOf"] = [
        {"required": ["data"]},
        {"required": ["system", "excitation", "sampling", "monte_carlo"]},
        {"required": ["system", "loop", "sampling", "monte_carlo"]},
        {"required": ["signal", "sampling", "monte_carlo"]},
    ]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ctid experiment"}


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
    problems: list[Complaint] = []
    if spec.data is not None:
        data = _pinned(spec.data, ("data",), spec.folder, problems)
        spec = spec.model_copy(update={"data": data})
        if not problems:
            try:
                if spec.measured is not None:
                    spec.measured.dataset(0)
            except DataError as error:
                problems.append((("data", "file"), str(error)))
    elif spec.generator is not None:
        path, section = spec.generator
        pinned = _pinned(section, path, spec.folder, problems)
        if path == ("excitation",):
            spec = spec.model_copy(update={"excitation": pinned})
        elif spec.loop is not None:
            spec = spec.model_copy(update={"loop": spec.loop.model_copy(update={"reference": pinned})})
        if not problems and hasattr(pinned, "sha256"):
            try:
                check_input_file(located(variants(pinned)[0].options, spec.folder))
            except DataError as error:
                problems.append(((*path, "file"), str(error)))
    return spec, problems


def _pinned(section: Any, path: KeyPath, folder: Path, problems: list[Complaint]) -> Any:
    """A section with the content hash of its file, if it names one; what is wrong with the file goes to `problems`."""
    if not hasattr(section, "sha256"):
        return section
    file = joined(folder, section.file)
    try:
        content = file_sha256(file)
    except DataError as error:
        problems.append(((*path, "file"), str(error)))
        return section
    if section.sha256 not in (None, content):
        problems.append(((*path, "sha256"), f"the SHA-256 of {file} is {content}; is it another file?"))
        return section
    return section.model_copy(update={"sha256": content})
