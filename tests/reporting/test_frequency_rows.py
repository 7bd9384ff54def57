"""Rows, tables and sentences of experiments on a signal, from estimates made by hand."""

import pytest

from ctid_cli.custom_code import STUDIES
from ctid_cli.reporting.percentages import experiment_rows, measures_of
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.table_blocks import success_sentence
from ctid_cli.reporting.tables import experiment_report
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import slots
from tests.storage.made_results import MadeResults

COMPARATORS = STUDIES / "finite_time_frequency" / "comparators"
SPEC = f"""\
experiment: made
signal: {{tones: [{{frequency: 2.0}}, {{frequency: [{{until: 10, value: 3.0}}, {{value: 3.5}}]}}]}}
sampling: {{kind: regular, interval: 0.05, duration: 20}}
estimators:
  tracker: {{kind: restarting_least_squares, tones: 2, h: 0.7}}
  whole: {{kind: "{COMPARATORS}/whole_record.py:Esprit", tones: 2}}
success: {{band: 0.1, by: 4}}
monte_carlo: {{runs: 4, seed: 1}}
"""


def of_track(first, second, after, rms, alarms):
    return {
        "status": "VALID",
        "message": "good",
        "measures": {
            "settling_time_1": first,
            "settling_time_2": second,
            "settling_after_step_1": 0.0,
            "settling_after_step_2": after,
            "rms_1": rms,
            "rms_2": 0.2,
            "false_alarms": alarms,
        },
    }


def of_record(rms):
    return {"status": "VALID", "message": "good", "measures": {"omega_1": 2.0, "rms_1": rms, "rms_2": 0.05}}


@pytest.fixture
def results(tmp_path):
    """Results from the estimates of the tracker and of ESPRIT."""

    def make(tracks, records):
        file = tmp_path / "made.yaml"
        file.write_text(SPEC, encoding="utf-8")
        manifest = build_plan(load_spec(file)).manifest()
        values = {"tracker": tracks, "whole": records}
        found = {
            slot.key: values[slot.estimator["name"]][slot.key.replicate]
            for slot in slots(manifest)
            if slot.key.replicate < len(values[slot.estimator["name"]])
        }
        return Results(tmp_path, MadeResults(manifest, found, seconds=0.25))

    return make


def tracker_and_whole(results):
    tracker, whole = experiment_rows(results, "made")
    assert (tracker["method"], whole["method"]) == ("tracker", "whole")
    return tracker, whole


def measured(row):
    return {name: row[name] for name in measures_of([row])}


def test_medians_are_of_the_slowest_tone(results):
    tracks = [of_track(1.0, 3.0, 2.0, 0.1, 0), of_track(2.0, 1.5, 3.0, 0.3, 2), of_track(5.0, 0.0, 9.0, 0.2, 1)]
    tracker, whole = tracker_and_whole(results(tracks, [of_record(0.01)]))
    assert measured(tracker) == {
        "median_settling_time": 3.0,
        "median_settling_after_step": 3.0,
        "median_rms_1": 0.2,
        "median_rms_2": 0.2,
        "false_alarms": 3,
    }
    # settled in time: not the one with 5 and 9 s
    assert (tracker["n"], tracker["converged"]) == (3, 2)
    assert measured(whole) == {
        "median_settling_time": None,
        "median_settling_after_step": None,
        "median_rms_1": 0.01,
        "median_rms_2": 0.05,
        "false_alarms": None,
    }
    assert whole["converged"] == 1, "an estimate of a whole record has settled if its errors lie in the band"


def test_what_never_settles_counts_as_later_than_all_others(results):
    never = of_track(None, 1.0, None, 0.1, 0)
    once = of_track(1.0, 1.0, 1.0, 0.1, 0)
    tracker, _ = tracker_and_whole(results([never, once, once], []))
    assert tracker["median_settling_time"] == 1.0
    assert tracker["converged"] == 2
    tracker, _ = tracker_and_whole(results([never, never, once, once], []))
    assert tracker["median_settling_time"] is None, "half of them never did"
    assert tracker["percent"] == 50.0


def test_estimates_that_failed_have_no_measures_and_have_not_settled(results):
    broken = failed("ValueError: too short", "FAILED")
    tracker, whole = tracker_and_whole(results([of_track(1.0, 1.0, 1.0, 0.1, 1), broken, broken], [broken]))
    assert (tracker["n"], tracker["failed"], tracker["converged"]) == (3, 2, 1)
    assert tracker["median_rms_1"] is None
    assert tracker["false_alarms"] == 1
    assert (whole["failed"], whole["converged"], whole["median_rms_1"]) == (1, 0, None)
    nothing, _ = tracker_and_whole(results([broken], []))
    assert (nothing["n"], measures_of([nothing])) == (1, [])


def test_rows_that_were_not_run_stay_in_the_table(results):
    made = results([of_track(1.0, 1.0, 1.0, 0.1, 0)], [])
    rows = experiment_rows(made, "made")
    assert [row["n"] for row in rows] == [1, 0]
    assert "initial_delay" in rows[0]
    text = experiment_report(made).draw()
    lines = text.splitlines()
    header = next(k for k, line in enumerate(lines) if line.startswith("estimator"))
    assert lines[header].split("  ")[0] == "estimator"
    tracker, whole = lines[header + 2], lines[header + 3]
    assert tracker.split() == ["tracker", "100", "[21,", "100]", "1", "1", "1", "0.1", "0.2", "0", "250", "ms"]
    assert whole.split()[0] == "whole"
    assert "100" not in whole
    assert "alarms: false ones" in text
    markdown = experiment_report(made).draw("md")
    assert markdown.startswith(f"### made\n\nCounted: {success_sentence(made.settings)}.\n\n| estimator | % |")


def test_the_rule_in_words(results):
    made = results([], [])
    assert success_sentence(made.settings) == (
        "percent of the data sets whose frequencies all come to lie within 0.1 rad/s of the true ones within 4 s, "
        "to stay there"
    )
    made.manifest["success"] = {"band": 0.1, "by": None}
    made.manifest["spec"]["success"] = {"band": 0.1, "by": None}
    assert success_sentence(made.settings).endswith("of the true ones, to stay there")
