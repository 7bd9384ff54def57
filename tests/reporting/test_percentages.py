import json

import pytest

from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.reporting.layout import Report, csv_text, write_reports
from ctid_cli.reporting.percentages import experiment_rows, settings_of, study_rows
from ctid_cli.reporting.results import differences
from ctid_cli.reporting.study import load_study
from ctid_cli.reporting.table_blocks import study_blocks
from ctid_cli.reporting.tables import experiment_report

RANDOM = "uniform(0, 9)"


@pytest.fixture
def results(make_results, estimate):
    return make_results(
        {
            (5.0, "0.0"): [estimate(8.05), estimate(8.0), estimate(3.0), estimate(0, "FAILED")],
            (5.0, RANDOM): [estimate(7.95)] * 4,
            (15.0, "0.0"): [estimate(8.0)],
        }
    )


def study_table(study, table, rows, style="text"):
    return Report(study_blocks(study, table, rows, style)).draw(style)


def cell(rows, snr, delay, method="existing"):
    (row,) = [r for r in rows if (r["snr_db"], r["initial_delay"], r["method"]) == (snr, delay, method)]
    return row


def test_percentages_count_failures_as_not_converged(results):
    rows = experiment_rows(results, "e")
    row = cell(rows, 5.0, 0.0)
    low, high = wilson_interval(2, 4)
    assert (row["n"], row["failed"], row["converged"], row["percent"]) == (4, 1, 2, 50.0)
    assert (row["low"], row["high"]) == pytest.approx((100 * low, 100 * high))
    assert row["median_seconds"] == pytest.approx(0.02)
    assert cell(rows, 5.0, "random")["percent"] == 100.0
    assert cell(rows, 15.0, 0.0)["n"] == 1
    assert (cell(rows, 15.0, "random")["n"], cell(rows, 15.0, "random")["percent"]) == (0, None)


def test_fixed_and_random_starts_go_to_their_tables_beside_the_published_values(results):
    study = load_study()
    found = {results.experiment: results}
    fixed = study_rows(study, study.tables[1], found)
    row = cell([r for r in fixed if r["sampling"] == "regular"], 5.0, 0.0)
    assert (row["n"], row["percent"], row["published_percent"]) == (4, 50.0, 65.0)
    random = study_rows(study, study.tables[2], found)
    row = cell([r for r in random if r["sampling"] == "regular"], 5.0, "random")
    assert (row["n"], row["percent"], row["published_percent"]) == (4, 100.0, 90.0)
    # what was not run stays in the table
    assert len(fixed) == 72
    assert len(random) == 12
    assert all(r["n"] == 0 for r in fixed if r["sampling"] == "irregular" or r["method"] != "existing")


def test_a_setting_that_is_not_swept_still_finds_its_row(make_results, estimate):
    results = make_results({(15.0, "0.0"): [estimate(8.0)]}, snrs=(15.0,), swept=False)
    study = load_study()
    rows = [r for r in study_rows(study, study.tables[1], {results.experiment: results}) if r["n"]]
    assert [(r["snr_db"], r["initial_delay"], r["n"], r["published_percent"]) for r in rows] == [(15.0, 0.0, 1, 69.0)]


def test_the_snr_is_a_key_of_an_experiment_that_does_not_sweep_it(make_results, estimate):
    results = make_results({(15.0, "0.0"): [estimate(8.0)]}, snrs=(15.0,), swept=False)
    assert {row["snr_db"] for row in experiment_rows(results, "e")} == {15.0}
    results.settings["noise"]["snr_db"] = None
    assert {row["snr_db"] for row in experiment_rows(results, "e")} == {None}
    assert "SNR" not in experiment_report(results).draw()


def test_values_beyond_the_published_ones_get_rows_without_a_published_value(make_results, estimate):
    results = make_results({(10.0, "0.0"): [estimate(8.0)]}, snrs=(10.0,))
    study = load_study()
    rows = [r for r in study_rows(study, study.tables[1], {results.experiment: results}) if r["n"]]
    assert [(r["snr_db"], r["published_percent"]) for r in rows] == [(10.0, None)]
    text = study_table(study, study.tables[1], study_rows(study, study.tables[1], {results.experiment: results}))
    assert "10 dB" in text


def test_the_text_of_a_study_table(results):
    study = load_study()
    lines = study_table(study, study.tables[1], study_rows(study, study.tables[1], {results.experiment: results}))
    first = lines.splitlines()[5:8]
    assert first[0].split()[:8] == ["regular", "5", "dB", "existing", "n", "=", "4", "50"]
    assert first[1].split() == ["95", "%", "15-85"]
    assert first[2].split() == ["published", "65", "100", "100", "97", "100", "100"]


def test_the_markdown_of_a_study_table_has_one_cell_per_column(results):
    study = load_study()
    text = study_table(study, study.tables[1], study_rows(study, study.tables[1], {results.experiment: results}), "md")
    tables = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert len(tables) == 2
    for lines in tables:
        assert len({line.count("|") for line in lines}) == 1
    assert "| regular | 5 dB | existing | 4 | 50 [15, 85] (pub 65) |" in text


def test_the_text_of_an_experiment(results):
    text = experiment_report(results).draw()
    row = next(line for line in text.splitlines() if line.startswith("5 dB") and "0 s" in line)
    assert row.split() == ["5", "dB", "0", "s", "50", "[15,", "85]", "4", "20", "ms"]
    assert any("15 dB" in line and "not run" in line for line in text.splitlines())
    assert "count as not converged" in text


def test_without_a_success_rule_there_is_no_percentage(make_results, estimate):
    results = make_results({(5.0, "0.0"): [estimate(8.0)] * 2}, success=None)
    row = cell(experiment_rows(results, "e"), 5.0, 0.0)
    assert (row["n"], row["converged"], row["percent"], row["low"]) == (2, None, None, None)
    text = experiment_report(results).draw()
    assert "converged" not in text
    # Bias and root mean square error instead.
    lines = [line.split() for line in text.splitlines()]
    assert ["5", "dB", "0", "s", "existing", "delay", "0", "±", "0", "0", "±", "0", "2", "0"] in lines
    assert ["15", "dB", "0", "s", "existing", "-", "-", "-", "not", "run"] in lines


def test_rows_become_json_and_csv(results):
    report = Report([], experiment_rows(results, "e"))
    rows = json.loads(write_reports([report], "json"))
    assert rows[0] == {
        "table": "e",
        "experiment": "useful-redundancy/case1-regular",
        "sampling": "regular",
        "snr_db": 5.0,
        "initial_delay": 0.0,
        "method": "existing",
        "n": 4,
        "failed": 1,
        "converged": 2,
        "percent": 50.0,
        "low": pytest.approx(15.0, abs=0.1),
        "high": pytest.approx(85.0, abs=0.1),
        "published_percent": None,
        "median_seconds": pytest.approx(0.02),
        "median_cpu_seconds": None,
    }
    header, first = csv_text(report.records).splitlines()[:2]
    assert header.startswith("table,experiment,sampling,snr_db,initial_delay,method,n,")
    assert first.startswith("e,useful-redundancy/case1-regular,regular,5.0,0.0,existing,4,1,2,50.0,")


def test_differing_settings_are_named(results):
    reference = json.loads(json.dumps(results.settings))
    assert differences(results.settings, reference, {"noise.snr_db"}) == []
    reference["sampling"]["samples"] = 500
    reference["monte_carlo"]["runs"] = 100
    reference["noise"]["snr_db"] = 5
    reference["estimators"]["other"] = {"kind": "svf"}
    reference["starts"]["initial_delay"] = [1, {"uniform": [0.0, 9.0]}]
    assert differences(results.settings, reference, {"noise.snr_db"}) == ["sampling.samples = 4000 (not 500)"]
    reference["starts"]["initial_delay"] = [{"uniform": [0.0, 15.0]}]
    assert len(differences(results.settings, reference, {"noise.snr_db"})) == 2


def test_several_initial_parameters_are_told_apart(make_results, estimate):
    results = make_results({(15.0, "0.0"): [estimate(8.0)], (15.0, RANDOM): [estimate(3.0)]}, snrs=(15.0,), swept=False)
    assert "start" not in settings_of(experiment_rows(results, "e"))
    starts = results.manifest["starts"]
    starts.clear()
    starts |= {"0.0": None, RANDOM: None, "none": None}
    rows = experiment_rows(results, "e")
    assert [(row["start"], row["percent"]) for row in rows] == [("0.0", 100.0), (RANDOM, 0.0)]
    del starts[RANDOM]
    results.manifest["estimators"][0]["starts"] = ["0.0", "none"]
    assert "start" not in settings_of(experiment_rows(results, "e"))
