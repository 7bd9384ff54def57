"""What is worth knowing about a run that does not belong among its results: command, host, versions."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ctid_cli.storage.folder import PROVENANCE
from ctid_cli.storage.identity import Origin, numeric_platform, package_versions

#: What may be published of a session: nothing that names a machine, a user or a folder.
PUBLIC = (
    *("started", "stopped", "computed", "failed", "jobs", "processors"),
    *("code_version", "numeric_platform", "packages"),
)


def now() -> str:
    """The present time in UTC, for example ``2026-11-21T04:00:00Z``."""
    return as_text(datetime.now(UTC))


def as_text(moment: datetime) -> str:
    """A time in UTC, as it is stored."""
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def session_info(spec_text: str, spec_folder: Path, origins: Mapping[str, Origin]) -> dict[str, Any]:
    """Describe the run that is about to start."""
    return {
        "argv": sys.argv,
        "pid": os.getpid(),
        "host": platform.node(),
        "system": platform.platform(),
        "processors": os.cpu_count(),
        "code_version": {name: origin.code_version for name, origin in origins.items()},
        "numeric_platform": numeric_platform(),
        "packages": {"python": platform.python_version(), **package_versions()},
        "git_commit": git_commit(Path(__file__).resolve().parents[2]),
        "spec_folder": str(spec_folder.resolve()),
        "spec": spec_text,
    }


def canonical_text(spec: Mapping[str, Any]) -> str:
    """A canonical specification as its file holds it."""
    return json.dumps(spec, sort_keys=True, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def public_sessions(folder: Path) -> list[dict[str, Any]]:
    """The sessions that computed an experiment, as far as they may be published."""
    files = sorted((folder / PROVENANCE).glob("*.json"))
    read = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    return [{key: session.get(key) for key in PUBLIC} for session in read]


def git_commit(root: Path) -> str | None:
    """Commit of a checkout; None where there is none, or no git."""
    # An installed package may lie in a folder of some other repository.
    if (root / ".git").exists():
        with suppress(OSError, subprocess.CalledProcessError):
            asked = ["git", "-C", str(root), "rev-parse", "HEAD"]
            return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    return None
