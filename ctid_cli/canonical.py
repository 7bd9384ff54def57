"""The identity of what is described in plain data."""

from __future__ import annotations

import hashlib
import json
from typing import Any


def canonical_json(content: Any) -> str:
    """The one JSON text of some content."""
    return json.dumps(content, sort_keys=True, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def content_hash(content: Any) -> str:
    """Identity of some content."""
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:16]
