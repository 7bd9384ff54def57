"""However many estimates there are, only some of them are in memory at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ctid_cli.storage import packing, pieces, timings
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Slot, slots
from ctid_cli.storage.packing import Packed, PackedTable
from ctid_cli.storage.planned import KeySet
from ctid_cli.storage.sealed import open_sealed, write_sealed
from ctid_cli.storage.stored import Stored
from tests.running.fakes import FakePlan, Toy

ORIGIN = Origin("c", "p", ())


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> int:
    """Pieces of few rows, of which hardly any stay in memory."""
    monkeypatch.setattr(pieces, "ROWS", 7)
    monkeypatch.setattr(packing, "ROWS", 7)
    monkeypatch.setattr(pieces, "IN_MEMORY", 100)
    return 7


def result(slot: Slot) -> dict[str, Any]:
    """Estimates that differ in form from one piece to the next."""
    k = slot.key.replicate
    if k % 5 == 3:
        return failed(f"failed at {k} " + "x" * k, "FAILED")
    errors = {"b0": 0.1, "delay": None} if k % 2 else {f"a{k % 3 + 1}": 0.5}
    found = {"numerator": [1.0] * (k % 4), "denominator": [1.0, float(k)], "standard_errors": errors}
    return no_result() | found | {"status": "CONVERGED", "message": "", "delay": 8.0 + k / 1000, "iterations": k}


def filled(runs: int, held: list[int] | None = None) -> tuple[dict[str, Any], PackedTable]:
    manifest = FakePlan(Toy(), Toy(order=3), runs=runs).manifest()  # type: ignore[arg-type]
    alive: set[int] = set()

    class Seen(dict[str, Any]):
        def __init__(self, content: dict[str, Any]) -> None:
            super().__init__(content)
            alive.add(id(self))
            if held is not None:
                held.append(len(alive))

        def __del__(self) -> None:
            alive.discard(id(self))

    rows = (Packed(slot, Seen(result(slot)), 0.5, None, 1) for slot in slots(manifest))
    return manifest, PackedTable(manifest, rows)


@pytest.mark.usefixtures("small")
def test_packing_and_reading_hold_few_estimates(monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[int] = []
    manifest, table = filled(40, held)
    assert table.count == 240
    assert max(held) <= 2 * 7
    read: list[int] = []
    unpacked = packing.unpacked

    def counted(table: Any, column: Any, start: int, stop: int) -> list[Any]:
        read.append(stop - start)
        return unpacked(table, column, start, stop)

    monkeypatch.setattr("ctid_cli.storage.stored.unpacked", counted)
    assert sum(1 for _ in Stored(manifest, (ORIGIN,), table).every()) == 240
    assert max(read) <= 7


@pytest.mark.usefixtures("small")
def test_pieces_give_the_same_file_and_rows_as_all_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest, in_pieces = filled(11)
    write_sealed(manifest, (ORIGIN,), in_pieces, tmp_path / "pieces.h5")
    rows = Stored(manifest, (ORIGIN,), in_pieces).rows()
    assert Stored(manifest, (ORIGIN,), open_sealed(tmp_path / "pieces.h5").table).every()[3]["id"] == rows[3]["id"]
    for module in (pieces, packing):
        monkeypatch.setattr(module, "ROWS", 8192)
    _, at_once = filled(11)
    write_sealed(manifest, (ORIGIN,), at_once, tmp_path / "once.h5")
    assert (tmp_path / "pieces.h5").read_bytes() == (tmp_path / "once.h5").read_bytes()
    assert Stored(manifest, (ORIGIN,), at_once).rows() == rows
    with h5py.File(tmp_path / "once.h5") as file:
        assert file["estimates/message"].dtype.itemsize == max(len(row["message"]) for row in rows)


def test_columns_at_some_places_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest, table = filled(11)
    places = [range(3, 9), range(40, 44), [65, 1, 30], range(66), [8]]
    # Blocks have 22 or 11 rows: once that is many, once few.
    for rows in (7, 8192):
        monkeypatch.setattr("ctid_cli.storage.stored.ROWS", rows)
        stored = Stored(manifest, (ORIGIN,), table)
        for name in ("delay", "numerator", "status", "delay"):
            for some in places:
                chosen = np.array(some)
                np.testing.assert_array_equal(stored.at(name, chosen), table.read(name)[chosen])
    assert stored.at("status", np.zeros(0, dtype=int)).size == 0


def test_a_row_alone_is_what_it_is_among_others() -> None:
    manifest, table = filled(11)
    rows = Stored(manifest, (ORIGIN,), table).rows()
    for k in (0, 3, 64):
        alone = Stored(manifest, (ORIGIN,), pieces.Window(table, k, k + 1))
        assert alone.rows() == [rows[k]]
        assert alone.blocks[0].last == 1


@pytest.mark.parametrize("at_once", [50, 1_000_000])
def test_times_belong_to_ids_whatever_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr(timings, "AT_ONCE", at_once)
    _, table = filled(5)
    content = timings.times_table(table, shared=False)
    head, *lines = content.decode().splitlines()
    lines = [line.replace(",0.5,", f",{k}.25,") for k, line in enumerate(lines)]
    expected = np.arange(table.count) + 0.25

    def read(*lines: str) -> Any:
        (tmp_path / "timings.csv").write_text("".join(f"{line}\n" for line in lines))
        timed = timings.TimedTable(table, tmp_path / "timings.csv")
        few = timed.read("seconds", 2, 4)
        whole = timed.read("seconds")
        np.testing.assert_array_equal(few, whole[2:4])
        return whole

    np.testing.assert_array_equal(read(head, *lines), expected)
    np.testing.assert_array_equal(read(head, *lines[::-1]), expected)
    without = read(head, *lines[:2], *lines[3:])
    assert np.isnan(without[2])
    np.testing.assert_array_equal(np.delete(without, 2), np.delete(expected, 2))
    assert np.isnan(read(head)).all()
    assert np.isnan(read("no", "such", "file")).all()
    assert np.isnan(timings.TimedTable(table, tmp_path / "none.csv").read("cpu_seconds")).all()


def test_found_values_are_those_of_single_rows() -> None:
    manifest, table = filled(11)
    stored = Stored(manifest, (ORIGIN,), table)
    names = ("a1", "b0", "b1", "delay")
    found = stored.every().found(names)
    from ctid_cli.storage.manifest import found_values

    for k, row in enumerate(stored.rows()):
        for array, expected in zip(found, found_values(row, names), strict=True):
            wanted = np.array([expected[name] for name in names], dtype=float)
            np.testing.assert_array_equal(array[k], wanted)


def test_keys_are_counted_without_a_list() -> None:
    manifest = FakePlan(Toy(), Toy(order=3), runs=5).manifest()  # type: ignore[arg-type]
    for plan in (manifest, manifest | {"shard": [2, 3]}):
        planned, wanted, there = KeySet.planned(plan), [slot.key for slot in slots(plan)], KeySet()
        assert len(planned) == len(wanted)
        assert all(key in planned for key in wanted)
        for key in wanted[::3]:
            there.add(key)
        there.add(wanted[0]._replace(replicate=99))
        assert (planned.count_in(there), len(there)) == (len(wanted[::3]), len(wanted[::3]) + 1)
        assert wanted[0]._replace(replicate=99) not in planned
        assert all(key in there for key in (*wanted[::3], wanted[0]._replace(replicate=99)))
        there.discard(wanted[0])
        assert wanted[0] not in there
