"""Damaged files: flipped bits, zeroed sectors, files cut short or gone; what is read is right, or refused."""

from __future__ import annotations

import random
import shutil
import tempfile
from pathlib import Path

from ctid_cli.errors import CtidError
from ctid_cli.storage.repair import repair
from ctid_cli.storage.store import load_estimates
from ctid_cli.storage.verify import verify
from tests.faults.campaigns import serve
from tests.faults.counts import Trial
from tests.faults.storage_faults import Scene, scenes
from tests.faults.trials import Found, Place, Reference, apart_found, hasten, run

FILES = ("journal.sqlite", "runs.h5", "journal.sqlite-wal", "spec.canonical.json", "timings.csv", "spec.yaml")
DAMAGES = ("bits flipped", "sector zeroed", "cut short")
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

    def __init__(self) -> None:
        hasten()
        self.place = Place()
        kept = self.place.top / "kept"
        self.reference = Reference(kept / "reference")
        _, killed, sealed, *_ = scenes(kept)
        self.scenes: list[tuple[Scene, int]] = [(one, len(load_estimates(one.before))) for one in (killed, sealed)]  # type: ignore[arg-type]

    def trial(self, number: int) -> Trial:
        """One damaged file."""
        name, how = FILES[number // len(DAMAGES) % len(FILES)], DAMAGES[number % len(DAMAGES)]
        return Trial(how, number, name, self._tried(name, how, random.Random(number)))

    def _tried(self, name: str, how: str, rng: random.Random) -> Found:
        scene, count = self.scenes[0 if name.endswith("-wal") else rng.randrange(2)]
        folder = scene.set(self.place)
        path = folder / name
        if not path.exists():
            scene, count = self.scenes[1]
            folder = scene.set(self.place)
            path = folder / name
        before = path.read_bytes()
        after = damaged(rng, before, how)
        path.write_bytes(after)

        return [
            *apart_found(lambda: self._looked_at(folder, name, count, after != before)),
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


if __name__ == "__main__":
    damages = Damages()
    try:
        serve(damages.trial)
    finally:
        damages.place.close()
