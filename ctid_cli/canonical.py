"""Canonical JSON of plain data, its hash as identity, and strict parsing."""

import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any, NoReturn


def canonical_json(content: Any) -> str:
    """Return the unique JSON text of some content."""
    return json.dumps(content, sort_keys=True, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def content_hash(content: Any) -> str:
    """Return the hash of some content."""
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Return a value as JSON-compatible data."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_json(text: str) -> Any:
    """Parse JSON; refuse numbers that are not valid JSON."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    return json.loads(text, parse_constant=refuse)
