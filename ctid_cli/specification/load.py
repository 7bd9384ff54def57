"""From a YAML file to a checked specification; everything that is wrong with it is reported at once."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError, create_model

from ctid_cli.errors import DataError, Problem, RefusedError, SpecError
from ctid_cli.signals.csv_file import read_held_signal
from ctid_cli.signals.files import is_inside
from ctid_cli.simulation.dataset import LoopOptions, file_sha256, joined, located
from ctid_cli.specification.joint_checks import joint_complaints, too_many_cases
from ctid_cli.specification.joint_warnings import joint_warnings
from ctid_cli.specification.loop_section import LoopSection
from ctid_cli.specification.messages import Complaint, Located, explained, shown
from ctid_cli.specification.option_sections import EstimatorSection
from ctid_cli.specification.own_sections import names_code, own_places, with_own_kinds
from ctid_cli.specification.sections import case_count, replaced, variants
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.yaml_source import (
    OVERRIDE_FILE,
    KeyPath,
    apply_overrides,
    parse_yaml,
    path_text,
    read_yaml,
    written,
)


class _PartialSpec(Spec):
    """What is left of a specification when the broken sections are taken out."""

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        yield from ()


# Same fields, none of them required.
_Remainder = create_model(
    "_Remainder", __base__=_PartialSpec, experiment=(str | None, None), estimators=(dict[str, EstimatorSection], {})
)


def load_spec(
    given: Path | Mapping[str, Any],
    overrides: Sequence[str] = (),
    *,
    allow_code: bool = False,
    allow_outside: bool = False,
) -> Spec:
    """Read and check a specification, of a file or as a mapping.

    Code that it names is run, and data files outside its folder are read, only if that is allowed; whoever gives a
    mapping names the files himself.

    Sampling is called slow, which is a warning and no error, if its (mean) interval exceeds pi / max |p| over the
    poles p [rad/s] of the system: its rate is then below twice the frequency of the fastest pole.
    """
    if isinstance(given, Mapping):
        folder, text = Path(), written(given)
        source = parse_yaml(text, "(specification)")
    else:
        folder, source = given.parent, read_yaml(given)
        text = source.text
    apply_overrides(source, overrides)
    tree = source.tree
    if not isinstance(tree, dict):
        message = f"the file must hold a mapping that begins with 'experiment: name', not {shown(tree)}"
        raise SpecError([Problem(source.file, 1, 1, "", "the file is empty" if tree is None else message)])
    _require_allowed(tree, source.problem, allow_code)
    spec, complaints = _validated(with_own_kinds(tree, folder))
    spec._folder, spec._source = folder, source
    if too_many := too_many_cases(spec):
        raise SpecError([source.problem((), too_many)])
    spec, about_files = _with_files(spec, own=isinstance(given, Mapping), anywhere=allow_outside)
    broken = frozenset(str(where[0]) for where, _, _ in complaints if where)
    joint = joint_complaints(spec, broken, files_are_good=not about_files)
    complaints += [(where, message, False) for where, message in (*about_files, *joint)]
    if complaints:
        problems = {source.problem(where, message, key=at_key) for where, message, at_key in complaints}
        in_order = sorted(problems, key=lambda p: (p.file == OVERRIDE_FILE, p.line, p.column, p.key, p.message))
        raise SpecError(in_order)
    spec._warnings = tuple(str(source.problem(where, message)) for where, message in joint_warnings(spec))
    spec._text = text
    return spec


def load_loop(path: Path) -> LoopOptions:
    """The section ``loop`` of a file, for a record whose reference is a column of it."""
    source = read_yaml(path)
    tree = source.tree.get("loop") if isinstance(source.tree, dict) else None
    if tree is None:
        raise SpecError([source.problem((), "there is no section loop; write loop: {controller: {...}}")])
    problems: list[Located] = []
    try:
        section = LoopSection.model_validate(tree)
        if section.reference is not None:
            problems = [(("reference",), "belongs to simulated data; that of a record is a column, --reference", True)]
        elif case_count(section) > 1:
            problems = [((), "has lists of values; a record was taken in one loop: keep one of each", False)]
    except ValidationError as error:
        problems = [explained(detail, {}) for detail in error.errors(include_url=False)]
    if problems:
        raise SpecError([source.problem(("loop", *where), message, key=key) for where, message, key in problems])
    options: LoopOptions = section.options()
    return options


def spec_from_canonical(canonical: Mapping[str, Any], folder: Path | None = None, *, allow_code: bool = False) -> Spec:
    """A specification from its canonical form."""

    def problem(path: KeyPath, message: str) -> Problem:
        return Problem("(canonical specification)", 1, 1, path_text(path), message)

    _require_allowed(canonical, problem, allow_code)
    spec, complaints = _validated(with_own_kinds(canonical, folder or Path()))
    if complaints:
        raise SpecError([problem(path, message) for path, message, _ in complaints])
    spec._folder = folder or Path()
    return spec


def _require_allowed(tree: Mapping[str, Any], problem: Callable[[KeyPath, str], Problem], allow_code: bool) -> None:
    """Refuse to run code that a specification names, as a specification may come from anywhere."""
    ask = "names code, which would be run; if you trust it, repeat the command with --allow-code (or CTID_ALLOW_CODE=1)"
    places = [(*path, "kind") for path, _, kind in own_places(tree) if names_code(kind)]
    if places and not allow_code:
        raise RefusedError("\n".join(str(problem(path, ask)) for path in places))


def json_schema() -> dict[str, Any]:
    """JSON Schema of specifications, for editors."""
    schema = Spec.model_json_schema()
    ways = ("data", "system excitation sampling", "system loop sampling", "signal sampling")
    schema["anyOf"] = [{"required": way.split()} for way in ways]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ctid experiment"}


def _validated(tree: dict[str, Any]) -> tuple[Spec, list[Located]]:
    """A specification and what is wrong with it; if anything is, the specification is what remains without it."""
    try:
        return Spec.model_validate(tree), []
    except ValidationError as error:
        complaints = _complaints(error)
    good = _without({key: value for key, value in tree.items() if key in Spec.model_fields}, complaints)
    while True:
        try:
            return _Remainder.model_validate(good), complaints
        except ValidationError as error:
            # What is left may be wrong for want of what is not: two estimators the same without the loop, say.
            less = _without(good, _complaints(error))
            good = less if less != good else {}


def _complaints(error: ValidationError) -> list[Located]:
    return [explained(detail, {}) for detail in error.errors(include_url=False)]


def _without(tree: dict[str, Any], complaints: Iterable[Located]) -> dict[str, Any]:
    """A specification without the sections and estimators that are complained of."""
    good = dict(tree)
    for path, _, _ in complaints:
        if path[:1] == ("estimators",) and len(path) > 1 and isinstance(good.get("estimators"), dict):
            good["estimators"] = {name: item for name, item in good["estimators"].items() if name != path[1]}
        elif path:
            good.pop(str(path[0]), None)
    if not good.get("estimators"):
        good.pop("estimators", None)
    return good


def _with_files(spec: Spec, *, own: bool, anywhere: bool) -> tuple[Spec, list[Complaint]]:
    """The specification with the content hash of its file filled in, and what is wrong with the file.

    Nothing that a file outside the folder holds is repeated, unless the specification is the caller's own.
    """
    place: tuple[str, ...]
    section: Any
    place, section = (("data",), spec.data) if spec.data is not None else spec.generator or ((), None)
    if not hasattr(section, "sha256") or section.own:
        return spec, []
    file = joined(spec.folder, section.file)
    open_to_all = own or is_inside(file, spec.folder)
    if not (anywhere or open_to_all):
        ask = "if you trust the specification, repeat the command with --allow-outside (or CTID_ALLOW_OUTSIDE=1)"
        return spec, [((*place, "file"), f"lies outside the folder of the specification and is not read; {ask}")]
    readable = False
    try:
        content = file_sha256(file)
        readable = True
        if section.sha256 not in (None, content):
            return spec, [((*place, "sha256"), f"the SHA-256 of {file} is {content}; is it another file?")]
        spec = replaced(spec, (*place, "sha256"), content)
        if spec.measured is not None:
            spec.measured.dataset(0)
        else:
            source = located(variants(section)[0].options, spec.folder)
            read_held_signal(source.file, time=source.time, input=source.input, hold=source.hold)
    except DataError as error:
        silent = f"{file} cannot be used; it lies outside the folder, so that nothing of it is repeated here"
        said = str(error) if open_to_all or not readable else f"{silent}: 'ctid check' says what is wrong with it"
        return spec, [((*place, "file"), said)]
    return spec, []
