"""Loading of a specification from a YAML file; all errors are reported at once."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ctid_cli.custom_code import is_shipped
from ctid_cli.errors import DataError, RefusedError, SpecError
from ctid_cli.kinds import KINDS, resolve
from ctid_cli.signals.files import file_sha256, is_inside
from ctid_cli.signals.measurement import read_held_signal
from ctid_cli.simulation.dataset import LoopOptions, joined, located
from ctid_cli.specification.custom_sections import names_code
from ctid_cli.specification.joint_checks import joint_violations, joint_warnings, too_many_cases
from ctid_cli.specification.messages import Violation, explained, shown
from ctid_cli.specification.sections import Section
from ctid_cli.specification.spec import Spec, SpecPart
from ctid_cli.specification.sweeps import case_count, replaced, variants
from ctid_cli.specification.yaml_source import KEY, OVERRIDE_FILE, KeyPath, YamlSource, parse_yaml, read_yaml, written


def load_spec(
    given: Path | Mapping[str, Any],
    overrides: Sequence[str] = (),
    *,
    allow_code: bool = False,
    allow_outside: bool = False,
    trial: Callable[[Spec], Any] | None = None,
) -> Spec:
    """Read and check a specification from a file or a mapping.

    Code that it names is run, and data files outside its folder are read, only if allowed; a caller that passes a
    mapping chooses the files. A trial function receives the valid part and returns its errors and warnings.

    Sampling is called slow (a warning, not an error) if its (mean) interval exceeds pi / max |p| over the poles
    p [rad/s] of the system: the sampling rate is then below twice the frequency of the fastest pole.
    """
    if isinstance(given, Mapping):
        folder, source = Path(), parse_yaml(written(given), "(specification)", overrides)
    else:
        folder, source = given.parent, read_yaml(given, overrides)
    tree = source.tree
    if not isinstance(tree, dict):
        message = f"the file must hold a mapping that begins with 'experiment: name', not {shown(tree)}"
        raise SpecError([source.problem((), "the file is empty" if tree is None else message)])
    spec, violations = _validated(source, folder, allow_code)
    broken = frozenset(str(where[0]) for where, _ in violations if where)
    if too_many := too_many_cases(spec):
        raise SpecError([source.problem((), too_many)])
    spec, about_files = _with_files(spec, own=isinstance(given, Mapping), anywhere=allow_outside)
    from_trial: list[Violation] = []

    def tried(part: Spec) -> Sequence[Violation]:
        found = trial(part) if trial is not None else None
        from_trial.extend(found.warnings if found is not None else ())
        return found.errors if found is not None else ()

    joint = joint_violations(spec, broken, tried, files_are_good=not about_files)
    _require_none(source, [*violations, *about_files, *joint])
    warnings = [*joint_warnings(spec), *from_trial]
    spec._warnings = tuple(str(source.problem(where, message)) for where, message in warnings)
    return spec


def spec_from_canonical(canonical: Mapping[str, Any], folder: Path | None = None, *, allow_code: bool = False) -> Spec:
    """Return a specification from its canonical form."""
    source = YamlSource("(stored specification)", tree=dict(canonical))
    spec, violations = _validated(source, folder or Path(), allow_code)
    _require_none(source, violations)
    return spec


def load_loop(path: Path) -> LoopOptions:
    """Return the section ``loop`` of a file, for a record with its reference in a column."""
    source = read_yaml(path)
    tree = source.tree.get("loop") if isinstance(source.tree, dict) else None
    if tree is None:
        raise SpecError([source.problem((), "there is no section loop; write loop: {controller: {...}}")])
    part, problems = _right_part({"loop": tree}, path.parent)
    section, problems = part.loop, [problem for problem in problems if problem[0][0] == "loop"]
    if section is not None and section.reference is not None:
        message = "belongs to simulated data; that of a record is a column, --reference"
        problems = [(("loop", "reference", KEY), message)]
    elif case_count(section) > 1:
        problems = [(("loop",), "has lists of values; a record was taken in one loop: keep one of each")]
    _require_none(source, problems)
    assert section is not None
    options: LoopOptions = section.options()
    return options


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of specifications, for editors."""
    schema = Spec.model_json_schema()
    ways = ("data", "system excitation sampling", "inputs sampling", "system loop sampling", "signal sampling")
    schema["properties"]["loop"] = {"anyOf": [schema["properties"]["loop"], {"const": "unknown"}]}
    schema["anyOf"] = [{"required": way.split()} for way in ways]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ctid experiment"}


def _require_none(source: YamlSource, violations: Sequence[Violation]) -> None:
    """Raise a SpecError if there are problems: each one once, in the order of the file."""
    problems = {source.problem(where, message) for where, message in violations}
    if problems:
        in_order = sorted(problems, key=lambda p: (p.file == OVERRIDE_FILE, p.line, p.column, p.key, p.message))
        raise SpecError(in_order)


def _code_in(tree: Any, folder: Path) -> Iterator[KeyPath]:
    """Yield the places of kinds in a tree that name code outside the program."""
    waiting: list[tuple[KeyPath, Any]] = [((), tree)]
    while waiting:
        path, node = waiting.pop()
        items = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
        waiting += (((*path, key), value) for key, value in items)
        named = path and path[-1] == "kind" and isinstance(node, str) and names_code(node)
        if named and not is_shipped(node, folder):
            yield path


def _validated(source: YamlSource, folder: Path, allow_code: bool) -> tuple[Spec, list[Violation]]:
    """Return the valid part of a specification, and all problems of its individual sections."""
    tree = source.tree
    # A specification is untrusted input.
    ask = "names code, which would be run; if you trust it, repeat the command with --allow-code (or CTID_ALLOW_CODE=1)"
    code = [source.problem(path, ask) for path in _code_in(tree, folder)]
    if code and not allow_code:
        raise RefusedError("\n".join(map(str, sorted(code, key=lambda p: (p.line, p.column)))))
    spec, violations = _right_part(tree, folder)
    violations += [((*where, KEY), message) for where, message in presence_violations(spec, tree)]
    # Invalid sections are excluded from the following checks.
    wrong = {str(where[0]) for where, _ in violations if where and where[0] != "estimators"}
    spec = spec.model_copy(update=dict.fromkeys(wrong & Spec.model_fields.keys()))
    spec._folder, spec._source = folder, source
    return spec, violations


def _right_part(tree: Mapping[str, Any], folder: Path) -> tuple[Spec, list[Violation]]:
    """Return the valid sections and estimators, and the problems of the others."""
    context = {"folder": folder, "of_signal": tree.get("signal") is not None}
    try:
        return Spec.model_validate(tree, context=context), []
    except ValidationError as error:
        violations = [explained(detail, {}) for detail in error.errors(include_url=False)]
    places = [where for where, _ in violations]
    right = {name: value for name, value in tree.items() if not any(where[:1] == (name,) for where in places)}
    named = tree.get("estimators")
    if isinstance(named, Mapping):
        faulty = {where[1] for where in places if where[:1] == ("estimators",) and len(where) > 1}
        right["estimators"] = {name: value for name, value in named.items() if name not in faulty}
    return SpecPart.model_validate(right, context=context), violations


def _with_files(spec: Spec, *, own: bool, anywhere: bool) -> tuple[Spec, list[Violation]]:
    """Return the specification with the content hashes of its files, and the problems of the files."""
    sections: dict[KeyPath, Any] = {("data",): spec.data, ("sampling",): spec.sampling}
    if spec.data is None:
        sections |= spec.generators
    violations: list[Violation] = []
    for place, section in sections.items():
        if hasattr(section, "sha256") and not section.custom:
            try:
                content = _checked_content(spec, place, section, own=own, anywhere=anywhere)
                spec = replaced(spec, (*place, "sha256"), content)
            except DataError as error:
                violations.append(((*place, error.field or "file"), str(error)))
    return spec, violations


def _checked_content(spec: Spec, place: KeyPath, section: Any, *, own: bool, anywhere: bool) -> str:
    """Return the content hash of a file after checking that it is usable.

    The content of files outside the folder never appears in messages, unless the caller wrote the specification.
    """
    file = joined(spec.folder, section.file)
    open_to_all = own or is_inside(file, spec.folder)
    if not (anywhere or open_to_all):
        ask = "if you trust the specification, repeat the command with --allow-outside (or CTID_ALLOW_OUTSIDE=1)"
        raise DataError(f"lies outside the folder of the specification and is not read; {ask}")
    content = file_sha256(file)
    if section.sha256 not in (None, content):
        raise DataError(f"the SHA-256 of {file} is {content}; is it another file?", "sha256")
    options = located(variants(section)[0].options, spec.folder)
    try:
        if spec.measured is not None:
            spec.measured.dataset(0)
        elif place == ("sampling",):
            options.times(None)
        else:
            read_held_signal(options.file, time=options.time, input=options.input, hold=options.hold)
    except DataError as error:
        silent = f"{file} cannot be used; it lies outside the folder, so that nothing of it is repeated here"
        raise DataError(str(error) if open_to_all else f"{silent}: 'ctid check' says what is wrong with it") from None
    return content


# --- required and forbidden sections ---------------------------------------------------------------------------------

_SAMPLING = "is missing; for example {kind: regular, interval: 0.001, duration: 60}"
_MISSING = "is missing; data are simulated with system, excitation (or loop) and sampling"
_OF_INPUTS = "is given for each input in inputs; leave it out, or give one system and excitation in place of inputs"
_OF_SYSTEM = "belongs to a system, and there is none here; leave it out"
_OF_SIGNAL = "belongs to a signal, and there is none here; leave it out"
_OF_SIMULATION = "belongs to simulated data, and 'data' names a measured record; keep one of the two"
_OF_LOOP = "the loop makes the input; keep one of the two (a reference stands in loop.reference)"
#: Required and forbidden sections with their messages, by the section that determines the kind of an experiment: the
#: first one that is present, or the last entry if none is.
EXPERIMENTS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "signal": (
        {"sampling": _SAMPLING},
        dict.fromkeys(("system", "excitation", "inputs", "loop", "data", "starts"), _OF_SYSTEM)
        | {"noise": f"{_OF_SYSTEM}; what is added to a signal is its disturbance"},
    ),
    "data": (
        {},
        dict.fromkeys(("system", "excitation", "inputs", "sampling", "noise"), _OF_SIMULATION)
        | {"disturbance": _OF_SIGNAL},
    ),
    "inputs": (
        {"sampling": _MISSING},
        dict.fromkeys(("system", "excitation"), _OF_INPUTS)
        | {"loop": "closes around one input, and there are several here; leave it out", "disturbance": _OF_SIGNAL},
    ),
    "loop": (
        dict.fromkeys(("system", "sampling"), _MISSING),
        {"excitation": _OF_LOOP, "disturbance": _OF_SIGNAL},
    ),
    "system": (
        dict.fromkeys(("system", "excitation", "sampling"), _MISSING),
        {"disturbance": _OF_SIGNAL},
    ),
}


def presence_violations(spec: Spec, raw: Mapping[str, Any]) -> Iterator[Violation]:
    """Yield missing and superfluous sections, independent of their content."""
    present = {name for name in Spec.model_fields if raw.get(name) is not None}
    kind = next((kind for kind in EXPERIMENTS if kind in present), "system")
    required, forbidden = EXPERIMENTS[kind]
    yield from (((name,), message) for name, message in forbidden.items() if name in present)
    if kind == "system" and not present & required.keys():
        yield (), "there are no data: give system, excitation and sampling; or data; or signal and sampling"
    else:
        yield from (((name,), message) for name, message in required.items() if name not in present)
    loop, data = (_mapping(raw, name) for name in ("loop", "data"))
    reference, column = loop.get("reference") is not None, data.get("reference") is not None
    unknown = raw.get("loop") == "unknown" or "unknown" in _mapping(loop, "controller")
    if kind == "loop" and unknown:
        yield ("loop",), "unknown is for measured records; simulated data need the controller"
    if kind == "data" and reference:
        yield ("loop", "reference"), "belongs to simulated data; that of a record is a column, data.reference"
    if kind == "data" and column and "loop" not in present:
        yield ("data", "reference"), "needs the controller too; add loop: {controller: {…}}, or loop: unknown"
    elif kind == "data" and isinstance(raw["data"], Mapping) and not column and "loop" in present and not unknown:
        yield ("data", "reference"), "is missing; a loop has a reference: name its column"
    needed = kind == "loop" and isinstance(raw["loop"], Mapping) and "relay" not in _mapping(loop, "controller")
    if needed and not reference and "excitation" not in present:
        yield ("loop", "reference"), "is missing; for example {kind: gaussian, standard_deviation: 1.0}"
    random = _random_section(spec, raw, present)
    if random and "monte_carlo" not in present:
        yield ("monte_carlo",), f"is missing, and the {random} is random; for example {{runs: 100, seed: 1}}"


def _mapping(raw: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a mapping contained in another one; an empty one if the value is something else."""
    content = raw.get(name)
    return content if isinstance(content, Mapping) else {}


def _random_section(spec: Spec, raw: Mapping[str, Any], present: set[str]) -> str:
    """Return the name of a section of simulated data that draws random numbers; empty if none does."""
    if "data" in present:
        return ""
    parts = {name: (raw.get(name), getattr(spec, name)) for name in ("excitation", "sampling", "noise", "disturbance")}
    for name, content in _mapping(raw, "inputs").items():
        section = (spec.inputs or {}).get(name)
        given = content.get("excitation") if isinstance(content, Mapping) else None
        parts[f"excitation of {name}"] = given, section and section.excitation
    parts["excitation of the loop"] = _mapping(raw, "loop").get("reference"), getattr(spec.loop, "reference", None)
    for name, (content, section) in parts.items():
        if content not in (None, "none") and not _draws_nothing(name.split()[0], content, section):
            return name
    return ""


def _draws_nothing(part: str, content: Any, section: Section | None) -> bool:
    """Return whether the class named by a section, which may be invalid, draws no random numbers with its options."""
    target = None if section is None else section.target
    options = content if isinstance(content, Mapping) else {}
    kind = options.get("kind")
    if target is None and isinstance(kind, str) and kind in KINDS[part]:
        target = resolve(part, kind)
    without = getattr(target, "deterministic_with", {})
    return getattr(target, "deterministic", False) is True or any(
        options.get(name) in without[name] for name in without
    )
