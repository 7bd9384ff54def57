"""Rows of results in a file of JSON lines, so that a stopped benchmark goes on where it ended."""

import json
from collections.abc import Callable
from pathlib import Path


class Rows:
    """Rows of a file by some of their values; others are computed and added."""

    def __init__(self, file: Path, *names: str) -> None:
        self.file, lines = file, file.read_text().splitlines() if file.exists() else []
        self.known = {tuple(row[name] for name in names): row for row in map(json.loads, lines)}

    def row(self, key: tuple, compute: Callable[[], dict]) -> dict:
        """Return the row with these values."""
        if key not in self.known:
            self.known[key] = compute()
            with self.file.open("a") as file:
                file.write(json.dumps(self.known[key]) + "\n")
        return self.known[key]
