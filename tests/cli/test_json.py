"""Machine-readable output: keys, types, and what the numbers have to do with each other."""

import csv
import io
import json
import math

import pytest

ESTIMATE = {
    "id": str,
    "experiment": str,
    "estimator": str,
    "cell": str,
    "replicate": int,
    "start": str,
    "status": str,
    "delay": float,
    "numerator": list,
    "denominator": list,
    "standard_errors": dict,
    "cost": float,
    "fit_percent": float,
    "iterations": int,
    "seconds": float,
}


def check_estimate(row):
    for key, kind in ESTIMATE.items():
        assert isinstance(row[key], kind), key
    assert row["denominator"][0] == 1.0
    assert len(row["id"]) == 12


@pytest.fixture
def estimates(ctid, done):
    return json.loads(ctid("export", "tiny", "--format", "json", "--out", done).stdout)


def test_export_json_holds_every_planned_estimate(estimates):
    # two noise levels, two data sets; the search from two starts, the other estimator from none
    assert len(estimates) == 2 * 2 * (2 + 1)
    for row in estimates:
        check_estimate(row)
        assert row["snr_db"] in (10, 20)
        assert row["true_delay"] == 0.35
        assert row["converged"] == (abs(row["delay"] - 0.35) <= 0.2 * 0.35)
    assert {(row["estimator"], row["initial_delay"]) for row in estimates} == {
        ("search", 0.3),
        ("search", "random"),
        ("known", None),
    }


def test_export_csv_has_the_same_numbers(ctid, done, estimates):
    rows = list(csv.DictReader(io.StringIO(ctid("export", "tiny", "--format", "csv", "--out", done).stdout)))
    assert len(rows) == len(estimates)
    for row, estimate in zip(rows, estimates, strict=True):
        for key in ("id", "experiment", "estimator", "cell", "start", "status"):
            assert row[key] == estimate[key]
        assert int(row["replicate"]) == estimate["replicate"]
        assert float(row["b0"]) == estimate["numerator"][0]
        assert float(row["a1"]) == estimate["denominator"][1]
        assert float(row["delay"]) == estimate["delay"]
        assert float(row["se_a1"]) == estimate["standard_errors"]["a1"]
        assert float(row["snr_db"]) == estimate["snr_db"]
    assert "numerator" not in rows[0]


def test_export_to_a_file(ctid, done, tmp_path):
    shown = ctid("export", "tiny", "--out", done)
    written = ctid("export", "tiny", "--out", done, "--file", tmp_path / "rows.csv")
    assert written.stdout == ""
    assert (tmp_path / "rows.csv").read_text(encoding="utf-8") == shown.stdout


def test_table_rows_of_an_experiment(ctid, done, estimates):
    rows = json.loads(ctid("table", "tiny", "--format", "json", "--out", done).stdout)
    assert len(rows) == 2 * 3
    for row in rows:
        mine = [e for e in estimates if (e["estimator"], e["initial_delay"], e["snr_db"]) == key(row)]
        assert row["table"] == row["experiment"] == "tiny"
        assert row["sampling"] == "regular"
        assert row["n"] == len(mine) == 2
        assert row["converged"] == sum(e["converged"] for e in mine)
        assert row["percent"] == 100 * row["converged"] / row["n"]
        assert 0 <= row["low"] <= row["percent"] <= row["high"] <= 100
        assert row["published_percent"] is None
        assert row["median_seconds"] == pytest.approx(sum(e["seconds"] for e in mine) / 2)
    header = ctid("table", "tiny", "--format", "csv", "--out", done).stdout.splitlines()[0]
    assert header.split(",") == list(rows[0])


def key(row):
    return (row["method"], row["initial_delay"], row["snr_db"])


def test_one_estimate_in_full(ctid, done, estimates):
    estimate = next(e for e in estimates if e["initial_delay"] == "random")
    shown = json.loads(ctid("export", "--id", estimate["id"], "--json", "--out", done).stdout)
    check_estimate(shown)
    assert {name: shown[name] for name in estimate if name != "parameters"} == {
        k: v for k, v in estimate.items() if k != "parameters"
    }
    by_name = {item["name"]: item for item in shown["parameters"]}
    assert list(by_name) == ["b0", "a1", "delay"]
    for name, item in by_name.items():
        error = shown["standard_errors"][name]
        assert item["standard_error"] == error
        assert item["high"] - item["low"] == pytest.approx(2 * shown["quantiles"][name] * error, rel=1e-12)
        assert item["relative_percent"] == pytest.approx(100 * error / abs(item["estimate"]))
    assert (by_name["b0"]["unit"], by_name["a1"]["unit"], by_name["delay"]["unit"]) == ("out/in/s", "1/s", "s")
    assert shown["seed"] == 1
    assert shown["data"]["system"]["denominator"] == [1, 2]
    assert shown["settings"]["poles"] == 1


def test_an_estimate_is_found_by_a_beginning_of_the_id_and_prints_text(ctid, done, estimates):
    text = ctid("export", "--id", estimates[0]["id"][:10], "--out", done).stdout
    assert estimates[0]["id"] in text
    assert estimates[0]["message"] in text
    assert "seed 1" in text
    assert "standard error" in text


def test_status(ctid, done, estimates):
    lines = ctid("status", "--json", "--out", done).stdout.splitlines()
    found = {item["experiment"]: item for item in map(json.loads, lines)}
    assert set(found) == {"tiny", "measured-tiny"}
    tiny = found["tiny"]
    assert (tiny["planned"], tiny["done"], tiny["todo"], tiny["failed"]) == (12, 12, 0, 0)
    assert (tiny["left_aside"], tiny["mixed"], tiny["running"]) == (0, False, None)
    assert sum(group["done"] for group in tiny["groups"]) == 12
    one = json.loads(ctid("status", "tiny", "--json", "--out", done).stdout)
    assert sum(outcome["estimates"] for outcome in one["outcomes"]) == 12
    assert one["failures"] == []
    text = ctid("status", "--out", done).stdout
    assert "measured-tiny" in text
    assert "12 of 12 estimates done" in ctid("status", "tiny", "--out", done).stdout


def test_run_reuses_what_is_stored(ctid, tiny, tmp_path, estimates):
    out = tmp_path / "results"
    planned = ctid("run", tiny, "--runs", 1, "--dry-run", "--out", out).stdout
    assert planned == f"tiny: would compute 6 estimates of 2 data sets into {out / 'tiny'}; 0 are already stored\n"
    assert not out.exists()
    run = ("run", tiny, "--jobs", 1, "--out", out)
    assert "6 of 6 estimates stored" in ctid(*run, "--runs", 1).stdout
    # ids depend on content alone: another folder, and another number of runs first, give the same ones
    done = ctid(*run)
    assert "6 estimates of 2 data sets to compute, 6 already stored" in done.stderr
    again = json.loads(ctid("export", "tiny", "--format", "json", "--out", out).stdout)
    assert [(row["id"], row["numerator"]) for row in again] == [(row["id"], row["numerator"]) for row in estimates]
    assert "(0 new, in " in ctid(*run).stdout


def test_a_measured_record(ctid, done):
    (row,) = json.loads(ctid("table", "measured-tiny", "--format", "json", "--out", done).stdout)
    assert (row["n"], row["percent"], row["sampling"], row["method"]) == (1, None, None, "known")
    # y' = -2 y + 2 u exactly, and exact for a zero-order hold
    assert row["denominator"] == pytest.approx([1, 2], rel=0.05)
    assert row["fit_percent"] > 90
    assert math.isfinite(row["validation_fit_percent"])
    text = ctid("table", "measured-tiny", "--out", done).stdout
    assert "fit, validation part" in text
    assert "±" in text


def test_a_record_is_found_again_from_another_folder(ctid, measured, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ctid("run", measured.name, "--jobs", 1, "--quiet", "--out", "here")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    ctid("run", f"../{measured.name}", "--jobs", 1, "--quiet", "--out", "there")
    sealed = "measured-tiny/runs.h5"
    assert (tmp_path / "here" / sealed).read_bytes() == (tmp_path / "elsewhere" / "there" / sealed).read_bytes()


def test_schema_is_a_json_schema(ctid):
    schema = json.loads(ctid("schema").stdout)
    assert {"experiment", "estimators"} <= schema["properties"].keys()
