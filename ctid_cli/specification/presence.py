"""Which sections an experiment must have, and which it must not, whatever they hold."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from ctid_cli.kinds import KINDS, resolve
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import Section
from ctid_cli.specification.spec import Spec


class Sections(NamedTuple):
    """Sections of one kind of experiment, with what is said where one is missing or too many."""

    required: Mapping[str, str]
    forbidden: Mapping[str, str]


_SAMPLING = "is missing; for example {kind: regular, interval: 0.001, duration: 60}"
_MISSING = "is missing; data are simulated with system, excitation (or loop) and sampling"
_OF_SYSTEM = "belongs to a system, and there is none here; leave it out"
_OF_SIGNAL = "belongs to a signal, and there is none here; leave it out"
_OF_SIMULATION = "belongs to simulated data, and 'data' names a measured record; keep one of the two"
_OF_LOOP = "the loop makes the input; keep one of the two (a reference stands in loop.reference)"
#: By the section that tells the kind of an experiment; the first that is present counts, the last where none is.
EXPERIMENTS = {
    "signal": Sections(
        required={"sampling": _SAMPLING},
        forbidden=dict.fromkeys(("system", "excitation", "loop", "data", "starts"), _OF_SYSTEM)
        | {"noise": f"{_OF_SYSTEM}; what is added to a signal is its disturbance"},
    ),
    "data": Sections(
        required={},
        forbidden=dict.fromkeys(("system", "excitation", "sampling", "noise"), _OF_SIMULATION)
        | {"disturbance": _OF_SIGNAL},
    ),
    "loop": Sections(
        required=dict.fromkeys(("system", "sampling"), _MISSING),
        forbidden={"excitation": _OF_LOOP, "disturbance": _OF_SIGNAL},
    ),
    "system": Sections(
        required=dict.fromkeys(("system", "excitation", "sampling"), _MISSING),
        forbidden={"disturbance": _OF_SIGNAL},
    ),
}


def presence_complaints(spec: Spec, raw: Mapping[str, Any]) -> Iterator[Complaint]:
    """Say which sections are missing or too many, whatever they hold."""
    present = {name for name in Spec.model_fields if raw.get(name) is not None}
    kind = next((kind for kind in EXPERIMENTS if kind in present), "system")
    required, forbidden = EXPERIMENTS[kind]
    yield from (((name,), message) for name, message in forbidden.items() if name in present)
    if kind == "system" and not present & required.keys():
        yield (), "there are no data: give system, excitation and sampling; or data; or signal and sampling"
    else:
        yield from (((name,), message) for name, message in required.items() if name not in present)
    if kind == "data":
        yield from _references_of_a_record(raw, present)
    elif kind == "loop" and "excitation" not in present and _lacks_a_reference(raw["loop"]):
        yield ("loop", "reference"), "is missing; for example {kind: gaussian, standard_deviation: 1.0}"
    random = _random_section(spec, raw, present)
    if random and "monte_carlo" not in present:
        yield ("monte_carlo",), f"is missing, and the {random} is random; for example {{runs: 100, seed: 1}}"


def _references_of_a_record(raw: Mapping[str, Any], present: set[str]) -> Iterator[Complaint]:
    if _reference(raw, "loop") is not None:
        yield ("loop", "reference"), "belongs to simulated data; that of a record is a column, data.reference"
    column = _reference(raw, "data") is not None
    if column and "loop" not in present:
        yield ("data", "reference"), "needs the controller too; add loop: {controller: {…}}"
    elif not column and "loop" in present and isinstance(raw["data"], Mapping):
        yield ("data", "reference"), "is missing; a loop has a reference: name its column"


def _lacks_a_reference(loop: Any) -> bool:
    """Return whether a loop has no reference and no relay, which needs none."""
    if not isinstance(loop, Mapping) or loop.get("reference") is not None:
        return False
    controller = loop.get("controller")
    return not (isinstance(controller, Mapping) and "relay" in controller)


def _reference(raw: Mapping[str, Any], section: str) -> Any:
    """Return the reference in a section, whatever the section is."""
    content = raw.get(section)
    return content.get("reference") if isinstance(content, Mapping) else None


def _random_section(spec: Spec, raw: Mapping[str, Any], present: set[str]) -> str:
    """Return a section of simulated data that draws random numbers; empty if none does."""
    if "data" in present:
        return ""
    parts = {name: (raw.get(name), getattr(spec, name)) for name in ("excitation", "sampling", "noise", "disturbance")}
    parts["excitation of the loop"] = _reference(raw, "loop"), getattr(spec.loop, "reference", None)
    for name, (content, section) in parts.items():
        if content not in (None, "none") and not _draws_nothing(name.split()[0], content, section):
            return name
    return ""


def _draws_nothing(part: str, content: Any, section: Section | None) -> bool:
    """Return whether the class that a section, which may be broken, names draws no random number with its options."""
    target = None if section is None else section.target
    options = content if isinstance(content, Mapping) else {}
    kind = options.get("kind")
    if target is None and isinstance(kind, str) and kind in KINDS[part]:
        target = resolve(part, kind)
    without = getattr(target, "deterministic_with", {})
    if getattr(target, "deterministic", False) is True:
        return True
    return any(options.get(name) in without[name] for name in without)
