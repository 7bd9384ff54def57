"""What the published results of every study have beside their tables: figures, and the environment that made them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path

#: What is kept of a session: nothing that names a machine, a user or a folder.
KEPT = ("started", "stopped", "computed", "failed", "jobs", "processors", "code_version", "numeric_platform")


def environment(results: Path, experiments: Iterable[str]) -> str:
    """Sessions of experiments."""
    sessions: dict[str, list[dict[str, object]]] = {}
    for name in sorted(experiments):
        for file in sorted((results / name / "provenance").glob("*.json")):
            session = json.loads(file.read_text(encoding="utf-8"))
            sessions.setdefault(name.rpartition("/")[2], []).append({key: session[key] for key in (*KEPT, "packages")})
    return json.dumps(sessions, indent=2) + "\n"


def copy_figures(source: Path, target: Path) -> None:
    """Put figures in place of those of an earlier reproduction; nothing happens where none were drawn."""
    figures = sorted(source.glob("*.svg"))
    if not figures:
        return
    target.mkdir(exist_ok=True)
    for old in target.glob("*.svg"):
        old.unlink()
    for figure in figures:
        shutil.copyfile(figure, target / figure.name)
