"""Damaged results: detection, messages, recovery and recomputation."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import DamageError
from ctid_cli.storage.estimates import read_estimates
from ctid_cli.storage.export import write_runs
from ctid_cli.storage.folder import reading_journal
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.merge import keep_readable
from ctid_cli.storage.sqlite_file import announce
from ctid_cli.storage.status import verify
from tests.storage.made_results import ORIGIN, SPEC, outcomes_of, plan_of, run_folder

#: Large enough for several pages of the journal.
MANIFEST = plan_of(40).manifest()


def ctid(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert "Traceback" not in done.output
    return done.exit_code, done.output


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_folder(MANIFEST, tmp_path_factory.mktemp("large") / "toys")


def damage_page(path: Path, number: int) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: number * 4096] + b"\xa5" * 4096 + data[(number + 1) * 4096 :])


def changed_plan(place: Path) -> None:
    log = open_journal(place / "journal.sqlite")
    log.replan(plan_of(41).manifest())
    log.close()


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda place: None, {}),
        (lambda place: (place / "runs.h5").write_bytes(b"damaged"), {"runs.h5": "damaged"}),
        (lambda place: (place / "runs.h5").unlink(), {"runs.h5": "missing"}),
        (lambda place: (place / ".runs.h5-1-1.tmp").touch(), {".runs.h5-1-1.tmp": "left over"}),
        (lambda place: damage_page(place / "journal.sqlite", 3), {"journal.sqlite": "damaged"}),
        (changed_plan, {"runs.h5": "stale"}),
    ],
)
def test_verify_says_what_is_damaged(place: Path, damage: Callable[[Path], Any], expected: dict[str, str]) -> None:
    damage(place)
    found = verify(place)
    states = {finding.file: finding.state for finding in found.findings if finding.state != "intact"}
    assert states == expected
    assert found.is_intact == (not {"damaged", "missing"} & set(expected.values()))
    code, text = ctid("verify", "toys", "--out", place.parent)
    assert (code, all(word in text for word in states.values())) == (0 if found.is_intact else 7, True), text
    if not expected:
        assert [finding.message for finding in found.findings] == ["240 of 240 estimates, 1 run", "240 estimates"]


@pytest.mark.parametrize("command", ["status", "table", "export"])
def test_reading_a_damaged_journal_is_refused_in_one_sentence(place: Path, command: str) -> None:
    (place / "runs.h5").unlink()
    data = (place / "journal.sqlite").read_bytes()
    (place / "journal.sqlite").write_bytes(data[: len(data) // 2])
    code, text = ctid(command, "toys", "--out", place.parent)
    assert (code, "is damaged" in text, "'ctid run --fresh --keep-readable'" in text) == (6, True, True), text


@pytest.mark.parametrize("export", [True, False])
def test_what_can_be_read_of_damaged_results_is_kept(place: Path, export: bool) -> None:
    whole = read_estimates(place).drop(columns=["seconds", "cpu_seconds"])
    if not export:
        (place / "runs.h5").write_bytes(b"damaged")
    pages = (place / "journal.sqlite").stat().st_size // 4096
    for number in random.Random(1).sample(range(8, pages), 4):
        damage_page(place / "journal.sqlite", number)
    with reading_journal(place) as damaged:
        assert damaged is not None
        with pytest.raises(DamageError):
            list(damaged.rows())
    aside = place.rename(place.with_name("aside"))
    place.mkdir()
    log = open_journal(place / "journal.sqlite")
    kept = keep_readable(aside, log, MANIFEST, ORIGIN)
    assert kept.planned == 240
    assert 120 < kept.from_journal < 240
    assert kept.from_export == (240 - kept.from_journal if export else 0)
    assert str(kept).startswith(f"{240 if export else kept.from_journal} of 240 estimates could be read and are kept")
    write_runs(place, log)
    log.close()
    found = read_estimates(place).drop(columns=["seconds", "cpu_seconds"])
    assert found.equals(whole[whole["id"].isin(found["id"])].reset_index(drop=True))
    assert verify(place).is_intact
    # Results of other code are recovered only if mixing is allowed.
    other = Origin("other", "p", ())
    for allow_mixed in (False, True):
        folder = place.with_name(f"mixed {allow_mixed}")
        folder.mkdir()
        log = open_journal(folder / "journal.sqlite")
        kept = keep_readable(aside, log, MANIFEST, other, allow_mixed=allow_mixed)
        assert (kept.from_journal > 0) is allow_mixed
        log.close()


@pytest.mark.parametrize("kept", [0.0, 0.5])
def test_estimates_that_were_reported_and_are_lost_with_the_log_are_noticed(tmp_path: Path, kept: float) -> None:
    place, dead = tmp_path / "toys", tmp_path / "dead"
    place.mkdir()
    dead.mkdir()
    log = open_journal(place / "journal.sqlite")
    session = log.begin(MANIFEST, ORIGIN, "now", {})
    for outcome in outcomes_of(MANIFEST):
        log.add([outcome], session)
    announce(place, "toys", "now", 5, 5, log.count())
    for name in ("journal.sqlite", "journal.sqlite-wal", "running.json"):
        (dead / name).write_bytes((place / name).read_bytes())
    log.close()
    assert verify(dead).is_intact
    data = bytearray((dead / "journal.sqlite-wal").read_bytes())
    data[int(len(data) * kept) + 100] ^= 255
    (dead / "journal.sqlite-wal").write_bytes(data)
    assert not verify(dead).is_intact
    with pytest.raises(DamageError, match="is damaged"):
        read_estimates(dead)
    with pytest.raises(DamageError, match="is damaged"):
        open_journal(dead / "journal.sqlite")


def test_a_damaged_run_goes_on_with_what_can_be_read_and_ends_with_the_same_bytes(tmp_path: Path) -> None:
    estimators = {"known": SPEC["estimators"]["known"]}  # type: ignore[index]
    spec, place = tmp_path / "toys.yaml", tmp_path / "toys"
    spec.write_text(yaml.safe_dump({**SPEC, "estimators": estimators, "monte_carlo": {"runs": 60, "seed": 1}}))
    run = ("run", spec, "--out", tmp_path, "--jobs", "2")
    assert ctid(*run)[0] == 0
    expected = (place / "runs.h5").read_bytes()
    damage_page(place / "journal.sqlite", (place / "journal.sqlite").stat().st_size // 4096 - 2)
    (place / "runs.h5").unlink()
    code, text = ctid(*run)
    assert (code, "--fresh --keep-readable" in text) == (6, True), text
    code, text = ctid(*run, "--fresh", "--keep-readable")
    assert (code, "could be read and are kept" in text) == (0, True), text
    assert (place / "runs.h5").read_bytes() == expected
