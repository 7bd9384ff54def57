"""Stored estimates that a test makes, and may change until they are first read as a table."""

from functools import cached_property

from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import slots
from ctid_cli.storage.packing import Packed, PackedTable
from ctid_cli.storage.stored import Stored

ORIGINS = (Origin("c", "p", ()),)


class MadeResults(Stored):
    """Results by key, all of which took the same time but those that have their own [s]; some hold a CPU time."""

    def __init__(self, manifest, results, origins=ORIGINS, seconds=0.02):
        vars(self).update(manifest=manifest, origins=origins, results=results, usual=seconds, seconds={})

    @cached_property
    def table(self):
        planned = [slot for slot in slots(self.manifest) if slot.key in self.results]
        found = [(slot, self.results[slot.key], self.seconds.get(slot.key, self.usual)) for slot in planned]
        rows = [Packed(*row, row[1].get("cpu_seconds")) for row in found]
        return PackedTable(self.manifest, rows)
