"""Damaged results, and runs that are killed: what is found, said, kept and computed again."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import DamageError
from ctid_cli.storage.announcement import announce
from ctid_cli.storage.estimates import read_estimates
from ctid_cli.storage.export import write_runs
from ctid_cli.storage.folder import reading_journal
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.keeping import keep_readable
from ctid_cli.storage.verify import verify
from tests.storage.made_results import ORIGIN, SPEC, outcomes_of, plan_of

ROOT = Path(__file__).parents[2]
#: Large enough for several pages of the journal.
MANIFEST = plan_of(40).manifest()


def ctid(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert "Traceback" not in done.output
    return done.exit_code, done.output


@pytest.fixture
def place(tmp_path: Path) -> Path:
    folder = tmp_path / "results" / "toys"
    folder.mkdir(parents=True)
    log = open_journal(folder / "journal.sqlite")
    log.add(outcomes_of(MANIFEST), log.begin(MANIFEST, ORIGIN, "now", {}))
    write_runs(folder, log)
    log.close()
    return folder


def damage_page(path: Path, number: int) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: number * 4096] + b"\xa5" * 4096 + data[(number + 1) * 4096 :])


def states(place: Path) -> dict[str, str]:
    return {finding.file: finding.state for finding in verify(place).findings}


def test_verify_says_what_is_damaged(place: Path) -> None:
    journal, export = place / "journal.sqlite", place / "runs.h5"
    found = verify(place)
    assert found.is_intact
    assert [finding.message for finding in found.findings] == ["240 of 240 estimates, 1 run", "240 estimates"]
    intact = export.read_bytes()
    export.write_bytes(intact.replace(b"toys", b"boys", 1))
    assert states(place) == {"journal.sqlite": "intact", "runs.h5": "damaged"}
    export.unlink()
    assert states(place) == {"journal.sqlite": "intact", "runs.h5": "missing"}
    export.write_bytes(intact)
    log = open_journal(journal)
    log.replan(plan_of(41).manifest())
    log.close()
    (place / ".runs.h5-1-1.tmp").touch()
    assert states(place) == {"journal.sqlite": "intact", "runs.h5": "stale", ".runs.h5-1-1.tmp": "left over"}
    damage_page(journal, 3)
    found = verify(place)
    assert not found.is_intact
    assert states(place) == {"journal.sqlite": "damaged", "runs.h5": "intact", ".runs.h5-1-1.tmp": "left over"}
    assert "--keep-readable" in found.findings[0].message
    code, text = ctid("verify", "toys", "--out", place.parent)
    assert (code, "journal.sqlite    " in text, "damaged" in text) == (7, True, True), text


@pytest.mark.parametrize("command", ["status", "table", "export", "show"])
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
    # Of other code nothing is kept, unless it may be mixed.
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


def run(spec: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "ctid_cli.cli.main", "run", str(spec), "--out", str(out), *more]


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    estimators = {"known": SPEC["estimators"]["known"]}  # type: ignore[index]
    file = tmp_path / "toys.yaml"
    file.write_text(yaml.safe_dump({**SPEC, "estimators": estimators, "monte_carlo": {"runs": 60, "seed": 1}}))
    return file


def done(*command: str, **options: object) -> subprocess.CompletedProcess[str]:
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, **options)  # type: ignore[call-overload]
    assert "Traceback" not in found.stderr
    return found


def test_killed_resumed_damaged_and_sharded_runs_end_with_the_same_bytes(spec: Path, tmp_path: Path) -> None:
    assert done(*run(spec, tmp_path / "one", "--jobs", "1")).returncode == 0
    expected = (tmp_path / "one" / "toys" / "runs.h5").read_bytes()
    place, journal = tmp_path / "killed" / "toys", tmp_path / "killed" / "toys" / "journal.sqlite"
    for seconds in (2.5, 3.5):
        with subprocess.Popen(
            run(spec, tmp_path / "killed", "--jobs", "2"), cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True
        ) as process:
            with suppress(subprocess.TimeoutExpired):
                process.wait(seconds)
            os.killpg(process.pid, signal.SIGKILL)
    assert done(*run(spec, tmp_path / "killed", "--jobs", "2")).returncode == 0
    assert (place / "runs.h5").read_bytes() == expected
    damage_page(journal, journal.stat().st_size // 4096 - 2)
    (place / "runs.h5").unlink()
    refused = done(*run(spec, tmp_path / "killed"))
    assert (refused.returncode, "--fresh --keep-readable" in refused.stderr) == (6, True), refused.stderr
    again = done(*run(spec, tmp_path / "killed", "--fresh", "--keep-readable"))
    assert (again.returncode, "could be read and are kept" in again.stderr) == (0, True), again.stderr
    assert (place / "runs.h5").read_bytes() == expected
    for k in ("1/2", "2/2"):
        assert done(*run(spec, tmp_path / "shards", "--shard", k, "--jobs", "1")).returncode == 0
    merge = [sys.executable, "-m", "ctid_cli.cli.main", "merge", str(tmp_path / "shards"), "--out", str(tmp_path / "m")]
    assert done(*merge).returncode == 0
    assert (tmp_path / "m" / "toys" / "runs.h5").read_bytes() == expected
