"""Copy the tables of a finished reproduction to results/published, with the environment that made them.

After ``make reproduce``: ``.venv/bin/python experiments/useful_redundancy/publish.py``.
"""

import argparse
import json
import shutil
from pathlib import Path

#: What is kept of a session: nothing that names a machine, a user or a folder.
KEPT = ("started", "stopped", "computed", "failed", "jobs", "processors", "code_version", "numeric_platform")


def main() -> None:
    """Parse the command line and copy."""
    parser = argparse.ArgumentParser(description="Publish the tables of a finished reproduction.")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--out", type=Path, default=Path("results/published/useful_redundancy"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for suffix in ("md", "csv"):
        shutil.copyfile(arguments.results / f"useful_redundancy.{suffix}", arguments.out / f"tables.{suffix}")
    sessions = {}
    for folder in sorted((arguments.results / "useful-redundancy").iterdir()):
        for file in sorted((folder / "provenance").glob("*.json")):
            session = json.loads(file.read_text(encoding="utf-8"))
            sessions.setdefault(folder.name, []).append({key: session[key] for key in (*KEPT, "packages")})
    text = json.dumps(sessions, indent=2) + "\n"
    (arguments.out / "environment.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
