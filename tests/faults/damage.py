"""Damaged files: flipped bits, zeroed sectors, files cut short or gone; what is read is right, or refused."""

from __future__ import annotations

import json
import random
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import monotonic

from ctid_cli.errors import CtidError
from ctid_cli.storage.repair import repair
from ctid_cli.storage.store import load_estimates
from ctid_cli.storage.verify import verify
from tests.faults.counts import Count
from tests.faults.storage_faults import Scene, scenes
from tests.faults.trials import Found, Place, Reference, apart, hasten, run

FILES = ("journal.sqlite", "runs.h5", "journal.sqlite-wal", "spec.canonical.json", "timings.csv", "spec.yaml")
SECTOR = 512


def damaged(rng: random.Random, data: bytes, how: str) -> bytes:
    """A file with one damage, or with several of one kind."""
    found = bytearray(data)
    match how:
        case "bits flipped":
            for _ in range(rng.choice((1, 1, 1, 8))):
                found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
        case "sector zeroed":
            for _ in range(rng.choice((1, 1, 8))):
                start = rng.randrange(-(-len(found) // SECTOR)) * SECTOR
                found[start : start + SECTOR] = bytes(len(found[start : start + SECTOR]))
        case "cut short":
            del found[rng.choice((0, rng.randrange(len(found)), len(found) // SECTOR * SECTOR // 2)) :]
    return bytes(found)


class Damages:
    """Trials on copies of the folders of a sealed and of a killed run."""

    def __init__(self, seed: int) -> None:
        hasten()
        self.rng, self.place = random.Random(seed), Place()
        kept = self.place.top / "kept"
        self.reference = Reference(kept / "reference")
        _, killed, sealed, *_ = scenes(kept)
        self.scenes: list[tuple[Scene, int]] = [(one, len(load_estimates(one.before))) for one in (killed, sealed)]  # type: ignore[arg-type]

    def trial(self, name: str, how: str) -> Found:
        """One damaged file."""
        scene, count = self.scenes[0 if name.endswith("-wal") else self.rng.randrange(2)]
        folder = scene.set(self.place)
        path = folder / name
        if not path.exists():
            scene, count = self.scenes[1]
            folder = scene.set(self.place)
            path = folder / name
        before = path.read_bytes()
        after = damaged(self.rng, before, how)
        path.write_bytes(after)

        def work(say: Callable[[str], object]) -> None:
            say(json.dumps(self._looked_at(folder, name, count, after != before)).replace(" ", "\0"))

        said, wrong = apart(work)
        return [
            *wrong,
            *(tuple(entry) for entry in json.loads(" ".join(said).replace("\0", " ") or "[]")),
            *self.place.left(),
        ]

    def _looked_at(self, folder: Path, name: str, count: int, changed: bool) -> Found:
        found: Found = []
        try:
            frame = load_estimates(folder)
            found += self.reference.compare(frame)
            # A write-ahead log that was cut is one that ended earlier: nothing says what it held.
            if len(frame) != count and not name.endswith("-wal"):
                found.append(("wrong", f"{len(frame)} of {count} estimates, and no word of it"))
        except CtidError:
            pass
        # In a journal there is room that holds nothing, or what the log beside it has replaced.
        if changed and not name.startswith("journal") and verify(folder).is_intact:
            found.append(("wrong", "verify finds nothing"))
        try:
            run(folder)
            if (folder / "runs.h5").read_bytes() != self.reference.bytes:
                found.append(("differing", "runs.h5 after going on"))
        except CtidError:
            found += self._repaired(folder)
        return found

    def _repaired(self, folder: Path) -> Found:
        with tempfile.TemporaryDirectory() as place:
            try:
                fixed = repair(folder, Path(place))
                return self.reference.compare(load_estimates(fixed.folder))
            except CtidError:
                return []
            finally:
                shutil.rmtree(folder, ignore_errors=True)


def campaign(at_most: int, seed: int = 0, seconds: float = 1e9) -> list[Count]:
    """Counts of all kinds of damage to all files."""
    until, damages, counts = monotonic() + seconds, Damages(seed), dict[str, Count]()
    try:
        for number in range(at_most):
            name, how = FILES[number // 3 % len(FILES)], ("bits flipped", "sector zeroed", "cut short")[number % 3]
            count = counts.setdefault(how, Count(how))
            count.add(damages.trial(name, how), f"{name}, number {number}")
            if monotonic() > until:
                break
    except Exception:
        print(traceback.format_exc(), file=sys.stderr)
        raise
    finally:
        damages.place.close()
    return list(counts.values())


if __name__ == "__main__":
    some, first, limit = sys.argv[1:]
    print(json.dumps([asdict(count) for count in campaign(int(some), int(first), float(limit))]))
