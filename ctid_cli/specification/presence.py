"""Which sections an experiment must have, and which it must not, whatever they hold."""

from collections.abc import Iterator, Mapping
from typing import Any

from ctid_cli.kinds import KINDS, resolve
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import Section
from ctid_cli.specification.spec import Spec

_SAMPLING = "is missing; for example {kind: regular, interval: 0.001, duration: 60}"
_MISSING = "is missing; data are simulated with system, excitation (or loop) and sampling"
_OF_SYSTEM = "belongs to a system, and there is none here; leave it out"
_OF_SIGNAL = "belongs to a signal, and there is none here; leave it out"
_OF_SIMULATION = "belongs to simulated data, and 'data' names a measured record; keep one of the two"
_OF_LOOP = "the loop makes the input; keep one of the two (a reference stands in loop.reference)"
#: Sections that are required and forbidden, with what is said of them, by the section that tells the kind of an
#: experiment; the first that is present counts, the last where none is.
EXPERIMENTS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "signal": (
        {"sampling": _SAMPLING},
        dict.fromkeys(("system", "excitation", "loop", "data", "starts"), _OF_SYSTEM)
        | {"noise": f"{_OF_SYSTEM}; what is added to a signal is its disturbance"},
    ),
    "data": (
        {},
        dict.fromkeys(("system", "excitation", "sampling", "noise"), _OF_SIMULATION) | {"disturbance": _OF_SIGNAL},
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
    loop, data = (_mapping(raw, name) for name in ("loop", "data"))
    reference, column = loop.get("reference") is not None, data.get("reference") is not None
    if kind == "data" and reference:
        yield ("loop", "reference"), "belongs to simulated data; that of a record is a column, data.reference"
    if kind == "data" and column and "loop" not in present:
        yield ("data", "reference"), "needs the controller too; add loop: {controller: {…}}"
    elif kind == "data" and isinstance(raw["data"], Mapping) and not column and "loop" in present:
        yield ("data", "reference"), "is missing; a loop has a reference: name its column"
    needed = kind == "loop" and isinstance(raw["loop"], Mapping) and "relay" not in _mapping(loop, "controller")
    if needed and not reference and "excitation" not in present:
        yield ("loop", "reference"), "is missing; for example {kind: gaussian, standard_deviation: 1.0}"
    random = _random_section(spec, raw, present)
    if random and "monte_carlo" not in present:
        yield ("monte_carlo",), f"is missing, and the {random} is random; for example {{runs: 100, seed: 1}}"


def _mapping(raw: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a mapping in another one; an empty one where there is something else."""
    content = raw.get(name)
    return content if isinstance(content, Mapping) else {}


def _random_section(spec: Spec, raw: Mapping[str, Any], present: set[str]) -> str:
    """Return a section of simulated data that draws random numbers; empty if none does."""
    if "data" in present:
        return ""
    parts = {name: (raw.get(name), getattr(spec, name)) for name in ("excitation", "sampling", "noise", "disturbance")}
    parts["excitation of the loop"] = _mapping(raw, "loop").get("reference"), getattr(spec.loop, "reference", None)
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
    return getattr(target, "deterministic", False) is True or any(
        options.get(name) in without[name] for name in without
    )
