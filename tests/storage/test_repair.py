"""Damage is found by `verify`, and `repair` saves all that is intact."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ctid_cli.errors import RefusedError, StorageError
from ctid_cli.running.engine import RunSummary, run_experiment
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.journal_reader import read_journal
from ctid_cli.storage.packing import CLOCKS
from ctid_cli.storage.repair import repair
from ctid_cli.storage.store import load_estimates, read_stored
from ctid_cli.storage.verify import verify
from tests.running.fakes import FakePlan, Toy

PAGE = 4096
PLAN = FakePlan(Toy("raise", at=1), Toy(order=3))
FILES = {"journal.sqlite", "runs.h5", "spec.yaml", "spec.canonical.json", "timings.csv"}


def run(place: Path, plan: FakePlan = PLAN) -> RunSummary:
    return run_experiment(plan, place, jobs=1, warm=lambda plan: None)  # type: ignore[arg-type]


def ctid(*arguments: object) -> tuple[int, str]:
    from ctid_cli.cli.main import app

    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return done.exit_code, done.output


def content(place: Path) -> dict[str, str]:
    files = (path for path in place.rglob("*") if path.is_file())
    return {str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def change(path: Path, position: int, data: bytes) -> None:
    before = path.read_bytes()
    path.write_bytes(before[:position] + data + before[position + len(data) :])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("repair") / "results" / "toys"
    run(place, FakePlan(Toy("raise", at=1), Toy(order=3), runs=2))
    run(place)
    return place


@pytest.fixture
def place(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "results" / "toys"))


def test_every_file_is_checked(place: Path) -> None:
    found = verify(place)
    assert found.is_intact
    provenance = {f"provenance/{path.name}" for path in (place / "provenance").iterdir()}
    assert {finding.file: finding.state for finding in found.findings} == dict.fromkeys(FILES | provenance, "intact")
    assert len(provenance) == 2
    before = content(place)
    code, text = ctid("verify", "--out", place.parent)
    assert (code, text.splitlines()[0]) == (0, "toys: intact")
    assert "36 of 36 estimates, 2 runs" in text
    assert content(place) == before


def test_one_changed_byte_in_any_file_is_named(place: Path) -> None:
    for name in content(place):
        intact = (place / name).read_bytes()
        where = intact.index(b"CONVERGED") if name == "journal.sqlite" else len(intact) // 2
        change(place / name, where, bytes([intact[where] ^ 4]))
        assert [finding.file for finding in verify(place).findings if finding.state == "damaged"] == [name]
        code, text = ctid("verify", "toys", "--out", place.parent)
        assert (code, f"not as it was written: {place}" in text) == (7, True)
        (place / name).write_bytes(intact)
    assert verify(place).is_intact


def test_a_file_that_is_gone_is_named_and_leftovers_are_mentioned(place: Path) -> None:
    (place / "spec.yaml").unlink()
    (place / "runs.h5").unlink()
    (place / ".runs.h5-12-1.tmp").touch()
    states = {finding.file: finding.state for finding in verify(place).findings}
    assert {states["spec.yaml"], states["runs.h5"]} == {"missing"}
    assert states[".runs.h5-12-1.tmp"] == "left over"
    assert run(place).computed == 0
    assert verify(place).is_intact


def test_another_sealed_file_is_not_read_for_the_right_one(place: Path, tmp_path: Path) -> None:
    run(tmp_path / "other", FakePlan(runs=1))
    shutil.copyfile(tmp_path / "other" / "runs.h5", place / "runs.h5")
    assert [finding.state for finding in verify(place).findings if finding.file == "runs.h5"] == ["stale"]
    assert len(load_estimates(place)) == 36


def test_changed_times_are_not_read(place: Path) -> None:
    before = load_estimates(place)
    text = (place / "timings.csv").read_text()
    (place / "timings.csv").write_text(text.replace("0.", "7.", 5))
    assert load_estimates(place).equals(before)


def damage_a_leaf(path: Path) -> None:
    data = path.read_bytes()
    pages = [k for k in range(0, len(data), PAGE) if data[k] == 0x0A and data[k : k + PAGE].count(b'"status"') > 2]
    change(path, pages[1], bytes(PAGE))


def damage_a_row(path: Path) -> None:
    change(path, path.read_bytes().index(b"CONVERGED"), b"D")


def damage_the_first_page(path: Path) -> None:
    change(path, 0, bytes(PAGE))


@pytest.mark.parametrize("damage", [damage_a_leaf, damage_a_row, damage_the_first_page])
@pytest.mark.parametrize("sealed", [True, False], ids=["sealed", "unsealed"])
def test_what_is_intact_is_saved_and_the_rest_computed_again(
    place: Path, made: Path, damage: Callable[[Path], None], sealed: bool
) -> None:
    damage(place / "journal.sqlite")
    if not sealed:
        (place / "runs.h5").unlink()
    before = content(place)
    readers = [("table", "toys"), ("export", "toys"), ("status", "toys"), ("figure", "toys"), ("report", "toys")]
    if not (sealed and damage is damage_a_row):
        for arguments in readers:
            code, text = ctid(*arguments, "--out", place.parent)
            assert (code, "is damaged" in text, "ctid repair" in text) == (6, True, True), text
    with pytest.raises(StorageError, match="damaged"):
        run(place)
    code, text = ctid("repair", "toys", "--out", place.parent, "--json")
    assert code == 0, text
    found = json.loads(text)
    missing = {damage_a_leaf: range(2, 12), damage_a_row: range(1, 2), damage_the_first_page: range(1)}[damage]
    assert len(found["missing"]) in ([0] if sealed else missing)
    assert found["saved"] == 36 - len(found["missing"])
    assert content(place) == before
    saved = Path(found["saved_in"])
    assert saved == place.parent.with_name("results-repaired") / "toys"
    assert verify(saved).is_intact
    assert len(load_estimates(saved)) == found["saved"]
    assert run(saved).computed == len(found["missing"])
    assert (saved / "runs.h5").read_bytes() == (made / "runs.h5").read_bytes()
    ours, theirs = read_stored(saved), read_stored(made)
    if not found["missing"] and not sealed:
        for clock in CLOCKS:
            np.testing.assert_array_equal(ours.column(clock), theirs.column(clock))
    code, text = ctid("repair", "toys", "--out", place.parent)
    assert (code, "results-repaired/toys exists; choose another folder with --to" in text) == (3, True)


def test_a_damaged_journal_of_a_killed_run_is_saved_from_its_log(place: Path, tmp_path: Path) -> None:
    (place / "runs.h5").unlink()
    log = open_journal(place / "journal.sqlite")
    with read_journal(place / "journal.sqlite", live=True) as before:
        assert before is not None
        entries = before.entries()
    log.replan(PLAN.manifest() | {"starts": {}})  # type: ignore[arg-type]
    dead = tmp_path / "dead" / "toys"
    shutil.copytree(place, dead)
    log.close()
    assert (dead / "journal.sqlite-wal").stat().st_size
    damage_the_first_page(dead / "journal.sqlite")
    change(dead / "journal.sqlite-wal", 0, bytes(32))
    found = repair(dead, tmp_path / "saved")
    assert (found.saved, found.missing) == (36, ())
    with read_journal(found.saved_in / "journal.sqlite") as after:
        assert after is not None
        assert after.entries() == entries
        assert [session["reason"] for session in after.sessions()] == ["finished", "finished", "repaired"]
    assert json.loads(ctid("verify", "--out", tmp_path / "saved", "--json")[1])["intact"]


def test_where_nothing_can_be_read_nothing_is_written(place: Path, tmp_path: Path) -> None:
    for name in ("journal.sqlite", "runs.h5"):
        (place / name).write_bytes(bytes(5000))
    with pytest.raises(StorageError, match=r"nothing of .* can be saved: neither journal.sqlite nor runs.h5"):
        repair(place, tmp_path / "saved")
    assert not (tmp_path / "saved").exists()
    assert verify(place).findings[0].message.endswith("Nothing of it can be read")


def test_a_folder_that_is_being_written_to_is_not_repaired(place: Path, tmp_path: Path) -> None:
    from ctid_cli.storage.folder import lock

    with lock(place), pytest.raises(RefusedError, match="in use"):
        repair(place, tmp_path / "saved")
