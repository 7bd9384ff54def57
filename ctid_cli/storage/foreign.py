"""What a results file must hold before it is used: somebody else may have made it, and its checksum with it."""

import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from ctid_cli.storage.manifest import Manifest
from ctid_cli.written_files import EXPERIMENT

#: Estimates that one file may plan.
MAX_ESTIMATES = 100_000_000
#: Letters of a name.
MAX_NAME = 1000

Check = Callable[[Any, str], Any]


def read_json(text: str) -> Any:
    """JSON without the numbers that it has no words for."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    return json.loads(text, parse_constant=refuse)


def require_manifest(found: Any) -> Manifest:
    """The plan in a file, if it has the form of one; a ValueError says what has not."""
    plan = _with_parts(found, "the plan", _PLAN)
    if not re.fullmatch(EXPERIMENT, plan["experiment"]):
        raise ValueError("its experiment has a name that none may have")
    if plan.get("seed") is not None:
        _count(plan["seed"], "seed")
    _require_shard(plan.get("shard", [1, 1]))
    # A rule may be none, but it must be there.
    for rule in (plan["success"], plan["spec"].get("success")):
        _require_success(rule)
    starts = plan["starts"]
    if not all(start is None or isinstance(start, str) or _is_number(start) for start in starts.values()):
        raise ValueError("a start is no number")
    for cell in _listed(plan, "data_cells", _CELL):
        if cell["content"].get("system") is not None:
            _mapping(cell["content"]["system"], "the system")
    for estimator in _listed(plan, "estimators", _ESTIMATOR):
        wanted = estimator.get("starts")
        if not (isinstance(wanted, list) and wanted and all(isinstance(start, str) for start in wanted)):
            raise ValueError("an estimator has no starts")
        if not set(wanted) <= set(starts):
            raise ValueError("a start is not described")
    total = sum(cell["replicates"] for cell in plan["data_cells"]) * sum(len(e["starts"]) for e in plan["estimators"])
    if total > MAX_ESTIMATES:
        raise ValueError(f"{total} planned estimates are too many")
    return plan


def _require_shard(shard: Any) -> None:
    if not (isinstance(shard, list) and [type(part) for part in shard] == [int, int] and 1 <= shard[0] <= shard[1]):
        raise ValueError("the shard is none")


def _require_success(rule: Any) -> None:
    if rule is None:
        return
    values = _mapping(rule, "the success rule").values()
    if not all(
        value is None or all(map(_is_number, value if isinstance(value, list) else [value])) for value in values
    ):
        raise ValueError("the success rule holds something else than numbers")


def _listed(plan: Mapping[str, Any], key: str, parts: Mapping[str, Check]) -> list[dict[str, Any]]:
    found, what = plan.get(key), key.replace("_", " ")
    if not isinstance(found, list) or not found:
        raise ValueError(f"there are no {what}")
    return [_with_parts(part, what, parts) for part in found]


def _with_parts(value: Any, what: str, parts: Mapping[str, Check]) -> dict[str, Any]:
    found = _mapping(value, what)
    for key, check in parts.items():
        check(found.get(key), key)
    return found


def _mapping(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is no mapping")
    return value


def _text(value: Any, what: str) -> None:
    if not isinstance(value, str) or not 0 < len(value) <= MAX_NAME:
        raise ValueError(f"{what} is no text")


def _count(value: Any, what: str) -> None:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{what} is no whole number")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


#: What every plan, data cell and estimator has.
_PLAN = {"experiment": _text, "runs": _count, "spec_hash": _text, "spec": _mapping, "starts": _mapping}
_CELL = {"hash": _text, "replicates": _count, "swept": _mapping, "content": _mapping}
_ESTIMATOR = {"name": _text, "kind": _text, "hash": _text, "swept": _mapping, "content": _mapping}
