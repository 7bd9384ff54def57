"""Results that were stored before the columns had one registry, and each estimator an identity of its own."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ctid_cli.errors import RefusedError
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage import columns, manifest
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.journal_reader import read_journal
from ctid_cli.storage.store import load_estimates, read_stored, read_tracks
from tests.storage.sealed_images import read_sealed, seal_image

STORED = Path(__file__).parent / "stored"
NAMES = ("system", "sum", "signal")
ADDED = (
    columns.Column("peak", "float64", "a number", "s"),
    columns.Column("visits", "Int64", "a count", of="systems"),
    columns.Column("remark", "str", "a text"),
    columns.Column("poles", "coefficients", "a list", prefix="pole_"),
    columns.Column("shares", "by name", "numbers by name", prefix="share_"),
)


@pytest.fixture(params=["sealed", "journal"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    for name in NAMES:
        shutil.copytree(STORED / name, tmp_path / name)
        (tmp_path / name / ("journal.sqlite" if request.param == "sealed" else "runs.h5")).unlink()
    return tmp_path


@pytest.fixture
def added(monkeypatch: pytest.MonkeyPatch) -> None:
    """New columns, in the middle and at the end."""
    before = list(columns.COLUMNS)
    monkeypatch.setattr(manifest, "_row_columns", manifest._row_columns.__wrapped__)
    monkeypatch.setattr(columns, "COLUMNS", (*before[:10], *ADDED[:2], *before[10:-2], *ADDED[2:], *before[-2:]))


def ctid(*arguments: object) -> str:
    from ctid_cli.cli.main import app

    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def exported(name: str, out: Path) -> list[dict[str, Any]]:
    """What is exported now, without columns that were added since and are missing."""
    rows: list[dict[str, Any]] = json.loads(ctid("export", name, "--format", "json", "--out", out))
    then = stored_export(name)[0].keys()
    since = {key for row in rows for key in row} - then - {column.name for column in ADDED}
    assert {row[key] for row in rows for key in since} <= {None}
    return [{key: value for key, value in row.items() if key not in since} for row in rows]


def stored_export(name: str) -> list[dict[str, Any]]:
    """What was exported when the results were stored."""
    rows: list[dict[str, Any]] = json.loads((STORED / name / "export.json").read_text())
    # Without a model there are no errors; that was once an empty object.
    return [row | {"standard_errors": row["standard_errors"] or None} for row in rows]


@pytest.mark.parametrize("name", NAMES)
def test_export_table_and_show_read_them(name: str, out: Path) -> None:
    assert exported(name, out) == stored_export(name)
    assert "1" in ctid("table", name, "--out", out)
    row = exported(name, out)[0]
    shown = json.loads(ctid("show", row["id"], "--json", "--out", out))
    assert {key: shown[key] for key in ("id", "status", "converged")} == {
        k: row[k] for k in ("id", "status", "converged")
    }
    assert shown["origins"][0]["code_version"] == "64dead06a043ab0d"
    assert not read_stored(out / name).mixed


def test_tracks_are_read(out: Path) -> None:
    (track,) = read_tracks(out / "signal").values()
    assert track["omega"].shape == (track["t"].size, 2)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.usefixtures("added")
def test_a_column_that_they_lack_is_missing(name: str, out: Path) -> None:
    frame, names = load_estimates(out / name), {column.name for column in ADDED}
    here = [column.name for column in ADDED if name != "signal" or column.of == "all"]
    assert set(here) <= set(frame.columns)
    assert frame[here].isna().all(axis=None)
    assert [{k: v for k, v in row.items() if k not in names} for row in exported(name, out)] == stored_export(name)
    assert {row[key] for row in exported(name, out) for key in names & row.keys()} == {None}
    ctid("table", name, "--out", out)
    ctid("show", frame["id"][0], "--out", out)


@pytest.mark.usefixtures("added")
def test_a_column_that_is_added_is_sealed_and_read(tmp_path: Path) -> None:
    stored = read_sealed(STORED / "system" / "runs.h5")
    values = {"peak": 1.5, "visits": 3, "remark": "well", "poles": [1.0, None], "shares": {"b": None, "a": 0.5}}
    first = next(iter(stored.results))
    # A text that is missing reads as an empty one.
    results = {key: result | {"remark": "", "covariance": ""} for key, result in stored.results.items()}
    results[first] |= values
    (tmp_path / "runs.h5").write_bytes(seal_image(stored.manifest, stored.origins, results)[0])
    assert read_sealed(tmp_path / "runs.h5").results == results
    row = load_estimates(tmp_path).set_index("id").loc[first.id]
    assert {name: row[name] for name in values} == values


@pytest.mark.parametrize("name", NAMES)
def test_the_journal_is_upgraded_without_loss(name: str, tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    shutil.copyfile(STORED / name / "journal.sqlite", path)
    with read_journal(path) as old:
        assert old is not None
        before, made = old.entries(), old.made()
    for _ in range(2):
        log = open_journal(path)
        assert (log.entries(), log.made()) == (before, made)
        log.close()
    with read_journal(path) as new:
        assert new is not None
        assert (new.entries(), new.made(), len(new.sessions())) == (before, made, 1)


def test_nothing_of_the_present_code_is_added_to_them(tmp_path: Path) -> None:
    place = Path(shutil.copytree(STORED / "system", tmp_path / "system"))
    before = {file.name: file.read_bytes() for file in place.iterdir()}
    plan = build_plan(load_spec(STORED / "system" / "spec.yaml"))
    with pytest.raises(RefusedError, match=r"code version 64dead06a043ab0d then, [0-9a-f]+-[0-9a-f]+ now"):
        run_experiment(plan, place, warm=lambda plan: None)
    assert {file.name: file.read_bytes() for file in place.iterdir()} == before


def test_the_documentation_lists_the_columns() -> None:
    text = (Path(__file__).parents[2] / "docs" / "machine-readable.md").read_text(encoding="utf-8")
    table = text.partition("## An estimate\n")[2].partition("\n\nIn experiments on a signal")[0]
    listed = [re.split(r" ?\| ?", line)[1:-1] for line in table.splitlines() if line.startswith("| `")]
    words = {
        "str": "text",
        "int64": "integer",
        "Int64": "integer",
        "float64": "number",
        "coefficients": "list of numbers",
    }
    words |= {"by name": "object", "initial delay": "number or text", "boolean": "boolean"}
    expected = [[f"`{c.name}`", words[c.type], c.unit or "", c.meaning] for c in columns.COLUMNS]
    lines = "\n".join(f"| {' | '.join(cells)} |" for cells in expected)
    assert listed == expected, f"the table of columns in docs/machine-readable.md is to be\n{lines}"
