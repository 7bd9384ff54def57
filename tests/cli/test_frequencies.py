"""An experiment on the frequencies of a signal, through every command that reads its results."""

import csv
import io
import json
import re

import pytest

from ctid_cli.custom_code import STUDIES

COMPARATORS = STUDIES / "finite_time_frequency" / "comparators"
SPEC = f"""\
experiment: beat
signal:
  tones: [{{frequency: [{{until: 8, value: 1.8}}, {{value: 2.2}}]}}, {{frequency: 3.0, phase: 1.5}}]
disturbance: {{kind: uniform, half_width: [0.001, 0.01]}}
sampling: {{kind: regular, interval: 0.02, duration: 20}}
estimators:
  restarting: {{kind: restarting_least_squares, tones: 2, h: [0.6, 0.7], prefilter: 0.5}}
  finite: {{kind: drem_finite_time, tones: 2, h: 0.7, d: 0.4, epsilon: 0.1, gamma: 1.0, initial_frequencies: [2, 4]}}
  whole: {{kind: "{COMPARATORS}/whole_record.py:Esprit", tones: 2}}
success: {{band: 0.05, by: 8, window: [18, 20]}}
monte_carlo: {{runs: 3, seed: 1}}
"""
SETTLING = ("settling_time_1", "settling_time_2", "settling_after_step_1", "settling_after_step_2")


@pytest.fixture(scope="module")
def beat(tmp_path_factory, ctid):
    folder = tmp_path_factory.mktemp("beat")
    (folder / "beat.yaml").write_text(SPEC, encoding="utf-8")
    ctid("run", folder / "beat.yaml", "--jobs", 1, "--quiet", "--out", folder / "results")
    return folder / "results"


@pytest.fixture
def estimates(ctid, beat):
    return json.loads(ctid("export", "beat", "--format", "json", "--out", beat).stdout)


def test_export_has_every_measure_of_every_estimate(ctid, beat, estimates):
    assert len(estimates) == 2 * 3 * 4
    by_id = {row["id"]: row for row in estimates}
    rows = list(csv.DictReader(io.StringIO(ctid("export", "beat", "--out", beat).stdout)))
    assert [row["id"] for row in rows] == list(by_id)
    for row in rows:
        measures = by_id[row["id"]]["measures"]
        for name, value in measures.items():
            assert row[name] == ("" if value is None else repr(value)), name
        # columns of other estimators' measures are empty
        assert {name for name in row if re.search(r"_\d$", name) and row[name]} <= measures.keys()
        assert (row["converged"] == "True") == by_id[row["id"]]["converged"]
    whole = next(row for row in rows if row["estimator"] == "whole")
    assert [whole[name] for name in (*SETTLING, "valid_from", "false_alarms")] == [""] * 6
    assert not {"delay", "b0", "true_delay", "initial_delay", "measures"} & set(rows[0])


def test_success_is_settling_in_time(estimates):
    for row in estimates:
        if row["estimator"] != "whole":
            times = [row["measures"][name] for name in SETTLING]
            assert row["converged"] == all(time is not None and time <= 8 for time in times)
    assert {row["converged"] for row in estimates if row["estimator"] == "restarting"} == {True}


def test_table_summarises_the_estimates(ctid, beat, estimates):
    rows = json.loads(ctid("table", "beat", "--format", "json", "--out", beat).stdout)
    assert len(rows) == 2 * 4
    for row in rows:
        mine = [
            one
            for one in estimates
            if (one["estimator"], one["half_width"]) == (row["method"], row["half_width"]) and one.get("h") == row["h"]
        ]
        assert (row["n"], row["converged"]) == (3, sum(one["converged"] for one in mine))
        rms = sorted(one["measures"]["rms_2"] for one in mine)
        assert row["median_rms_2"] == rms[1]
        if row["method"] == "restarting":
            slowest = sorted(max(one["measures"][name] for name in SETTLING[2:]) for one in mine)
            assert row["median_settling_after_step"] == slowest[1]
            assert row["false_alarms"] == sum(one["measures"]["false_alarms"] for one in mine)
        else:
            assert row["false_alarms"] is None
    heads = next(csv.reader(io.StringIO(ctid("table", "beat", "--format", "csv", "--out", beat).stdout)))
    assert {"median_settling_time", "median_settling_after_step", "median_rms_1", "half_width", "h"} <= set(heads)


def test_table_for_people(ctid, beat):
    text = ctid("table", "beat", "--out", beat).stdout
    assert "within 0.05 rad/s of the true ones within 8 s" in " ".join(text.split())
    assert len(text.splitlines()[1]) <= 100
    header = next(line for line in text.splitlines() if "after step" in line)
    for word in ("half_width", "h", "after step", "rms 1", "rms 2", "alarms", "time"):
        assert word in header
    body = [line.split() for line in text.splitlines() if "[" in line and "100" in line]
    assert [line for line in body if "restarting" in line]
    markdown = ctid("table", "beat", "--format", "md", "--out", beat).stdout
    assert markdown.count("\n|") == 2 + 8


def test_an_estimate_has_its_measures_with_units(ctid, beat, estimates):
    row = next(row for row in estimates if row["estimator"] == "finite")
    text = ctid("export", "--id", row["id"], "--out", beat).stdout
    for part in ("VALID", "omega_1", "settling_after_step_2", "rad/s", "valid_share", "half_width"):
        assert part in text
    # The message of an estimate may speak of the delays of its estimator.
    assert not re.search(r"^delay\b", text, re.MULTILINE)
    for part in ("fit_percent", "condition number", "start none", "every iteration"):
        assert part not in text
    assert re.search(r"^omega_2 +" + re.escape(f"{row['measures']['omega_2']:.8g}"), text, re.MULTILINE)
    content = json.loads(ctid("export", "--id", row["id"], "--json", "--out", beat).stdout)
    assert content["measures"] == row["measures"]
    assert content["data"]["signal"]["tones"][1]["frequency"] == 3.0


def test_status_counts_kinds_of_estimates(ctid, beat):
    text = ctid("status", "beat", "--out", beat).stdout
    assert "24 of 24 estimates done" in text
    assert "VALID" in text
