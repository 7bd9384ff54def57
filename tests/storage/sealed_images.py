"""Sealed files as tests make and read them: whole, in memory."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctid_cli.storage import sealed
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Key, Manifest, slots
from ctid_cli.storage.packing import Packed, PackedTable, keys, results
from ctid_cli.storage.pieces import ranges
from ctid_cli.temporary import TemporaryFolder


@dataclass(frozen=True)
class SealedRuns:
    """Content of a sealed file."""

    manifest: Manifest
    origins: tuple[Origin, ...]
    results: Mapping[Key, dict[str, Any]]
    checksum: str


def seal_image(
    manifest: Manifest, origins: Sequence[Origin], given: Mapping[Key, dict[str, Any]]
) -> tuple[bytes, str, int]:
    """The sealed file of few estimates as bytes, its checksum, and the number of estimates in it."""
    stored = [Packed(slot, given[slot.key]) for slot in slots(manifest) if slot.key in given]
    with TemporaryFolder() as folder:
        path = folder / "runs.h5"
        checksum = sealed.write_sealed(manifest, origins, PackedTable(manifest, stored), path)
        return path.read_bytes(), checksum, len(stored)


def headed(image: bytes) -> bytes:
    """HDF5 data behind their user block."""
    return sealed._head(hashlib.sha256(image).hexdigest()) + image


def read_sealed(path: Path) -> SealedRuns:
    """Read all of a sealed file, and compare it with its checksums."""
    found = sealed.open_sealed(path, fully=True)
    rows: dict[Key, dict[str, Any]] = {}
    with sealed._saying_where(path):
        for start, stop in ranges(found.table.count):
            rows |= zip(keys(found.table, start, stop), results(found.table, start, stop), strict=True)
    return SealedRuns(found.manifest, found.origins, rows, found.checksum)
