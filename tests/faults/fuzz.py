"""One kind of inputs that nobody meant to write, tried by number: ``python -m tests.faults.fuzz yaml``."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.faults.campaigns import serve
from tests.faults.conftest import STORED, TINY
from tests.faults.counts import Trial
from tests.faults.harness import Fuzzer, Watched
from tests.storage.sealed_images import read_sealed, seal_image


def images() -> list[bytes]:
    """Sealed files of a system, of a sum of submodels and of a signal."""
    found = []
    for folder in sorted(STORED.iterdir()):
        runs = read_sealed(folder / "runs.h5")
        found.append(seal_image(runs.manifest, runs.origins, runs.results)[0])
    return found


def main(kind: str) -> None:
    """Answer numbers with what came of the inputs."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as place:
        fuzzer = Fuzzer(Path(place), images(), TINY, commands_every=50)
        with Watched(fuzzer, kind) as watched:

            def trial(number: int) -> Trial:
                text = watched.tried(number)
                found = [("hang" if text.startswith("hangs") else "traceback", text)] if text else []
                return Trial(f"fuzzed input: {kind}", number, kind, found)

            serve(trial)


if __name__ == "__main__":
    main(sys.argv[1])
