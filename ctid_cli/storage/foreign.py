"""What a results file must hold before it is used: somebody else may have made it, and its checksum with it."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any, NoReturn

from ctid_cli.storage.manifest import Manifest
from ctid_cli.written_files import EXPERIMENT

#: Estimates that one file may plan.
MAX_ESTIMATES = 100_000_000
#: Letters of a name.
MAX_NAME = 1000


def read_json(text: str) -> Any:
    """JSON without the numbers that it has no words for."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no number of JSON")

    return json.loads(text, parse_constant=refuse)


def require_manifest(found: Any) -> Manifest:
    """The plan in a file, if it has the form of one; a ValueError says what has not."""
    plan = _mapping(found, "the plan")
    name = _text(plan, "experiment")
    if not re.fullmatch(EXPERIMENT, name):
        raise ValueError("its experiment has a name that none may have")
    _count(plan, "runs")
    if plan.get("seed") is not None:
        _count(plan, "seed")
    _text(plan, "spec_hash")
    spec = _mapping(plan.get("spec"), "the specification")
    _require_shard(plan.get("shard", [1, 1]))
    # A rule may be none, but it must be there.
    _require_success(plan["success"])
    _require_success(spec.get("success"))
    starts = _mapping(plan.get("starts"), "the starts")
    if not all(start is None or isinstance(start, str) or _is_number(start) for start in starts.values()):
        raise ValueError("a start is no number")
    cells, estimators = _parts(plan, "data_cells"), _parts(plan, "estimators")
    for cell in cells:
        _require_cell(cell)
    for estimator in estimators:
        _require_estimator(estimator, starts)
    total = sum(cell["replicates"] for cell in cells) * sum(len(item["starts"]) for item in estimators)
    if total > MAX_ESTIMATES:
        raise ValueError(f"{total} planned estimates are too many")
    return plan


def _require_cell(cell: Mapping[str, Any]) -> None:
    _text(cell, "hash")
    _count(cell, "replicates")
    _mapping(cell.get("swept"), "what is swept")
    content = _mapping(cell.get("content"), "a data cell")
    system = content.get("system")
    if system is not None:
        _mapping(system, "the system")


def _require_estimator(estimator: Mapping[str, Any], starts: Mapping[str, Any]) -> None:
    for key in ("name", "kind", "hash"):
        _text(estimator, key)
    _mapping(estimator.get("swept"), "what is swept")
    _mapping(estimator.get("content"), "an estimator")
    wanted = estimator.get("starts")
    if not (isinstance(wanted, list) and wanted and all(isinstance(start, str) for start in wanted)):
        raise ValueError("an estimator has no starts")
    if not set(wanted) <= set(starts):
        raise ValueError("a start is not described")


def _require_shard(shard: Any) -> None:
    if not (isinstance(shard, list) and [type(part) for part in shard] == [int, int] and 1 <= shard[0] <= shard[1]):
        raise ValueError("the shard is none")


def _require_success(rule: Any) -> None:
    if rule is None:
        return
    if any(not (value is None or _is_number(value)) for value in _mapping(rule, "the success rule").values()):
        raise ValueError("the success rule holds something else than numbers")


def _parts(plan: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    parts = plan.get(key)
    if not isinstance(parts, list) or not parts:
        raise ValueError(f"there are no {key.replace('_', ' ')}")
    return [_mapping(part, key.replace("_", " ")) for part in parts]


def _mapping(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is no mapping")
    return value


def _text(part: Mapping[str, Any], key: str) -> str:
    value = part.get(key)
    if not isinstance(value, str) or not 0 < len(value) <= MAX_NAME:
        raise ValueError(f"{key} is no text")
    return value


def _count(part: Mapping[str, Any], key: str) -> None:
    value = part.get(key)
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{key} is no whole number")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
