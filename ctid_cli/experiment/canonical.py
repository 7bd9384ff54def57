"""The identity of what is described in plain data."""

from __future__ import annotations

import hashlib
import json
from typing import Any


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
