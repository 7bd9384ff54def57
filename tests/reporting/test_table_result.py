"""Tables of experiments from hand-made estimates: counted estimates, machine-readable output, and text."""

import json

import pytest

from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.reporting.measures import percentage_frame, records_of, settings_of
from ctid_cli.reporting.results import differences
from ctid_cli.reporting.table_result import experiment_table, joined, measure_table
from tests.reporting.made_frequencies import frequency_results, of_record, of_track

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


def cell(results, snr, delay):
    rows = records_of(percentage_frame(results))
    (row,) = [row for row in rows if (row["snr_db"], row["initial_delay"]) == (snr, delay)]
    return row


def test_percentages_count_failures_as_not_converged(results):
    row = cell(results, 5.0, 0.0)
    low, high = wilson_interval(2, 4)
    assert (row["n"], row["failed"], row["converged"], row["percent"]) == (4, 1, 2, 50.0)
    assert (row["low"], row["high"]) == pytest.approx((100 * low, 100 * high))
    assert row["median_seconds"] == pytest.approx(0.02)
    assert cell(results, 5.0, "random")["percent"] == 100.0
    empty = cell(results, 15.0, "random")
    assert (empty["n"], empty["failed"], empty["converged"], empty["percent"]) == (0, 0, 0, None)


def test_an_experiment_in_every_form(results, snapshot):
    table = experiment_table(results, ["something to know"])
    assert {form: table.write(form) for form in ("text", "md", "latex", "csv", "json")} == snapshot


def test_several_tables_are_one_list_of_rows(results, make_results, estimate):
    other = make_results({(5.0, "0.0"): [estimate(8.0)]}, experiment="other")
    both = joined([experiment_table(results, ["note"]), experiment_table(other, ["note"])])
    assert [row["experiment"] for row in json.loads(both.write("json"))] == [results.experiment] * 4 + ["other"] * 4
    assert both.write("text").count("Note: note") == 1
    assert len(both.write("csv").splitlines()) == 9


def test_without_a_success_rule_there_are_errors_in_place_of_percentages(make_results, estimate, snapshot):
    found = {(5.0, "0.0"): [estimate(8.0)] * 2, (5.0, RANDOM): [estimate(8.1), estimate(7.8)]}
    results = make_results(found, success=None)
    row = cell(results, 5.0, 0.0)
    assert (row["n"], row["converged"], row["percent"], row["low"]) == (2, None, None, None)
    assert experiment_table(results).summary() == snapshot


def test_measures_of_parameters_of_estimates_and_of_failures_have_tables_of_their_own(make_results, estimate, snapshot):
    found = [estimate(8.0 + 0.1 * k, standard_errors={"delay": 0.1} if k < 4 else {}) for k in range(6)]
    results = make_results({(5.0, "0.0"): [*found, estimate(None, status="FAILED")]})
    for data_cell in results.manifest["data_cells"]:
        data_cell["replicates"] = 7
    table = measure_table(results, ["bias:delay", "standard_error:delay", "percent", "failures", "cpu_90"])
    assert table.summary() == snapshot


@pytest.mark.parametrize(("last", "said"), [(8.0, False), (1e6, True)])
def test_an_rmse_of_a_few_large_errors_is_said_to_be_one(make_results, estimate, last, said):
    results = make_results({(5.0, "0.0"): [estimate(8.0 + 0.1 * k) for k in range(10)] + [estimate(last)]})
    for data_cell in results.manifest["data_cells"]:
        data_cell["replicates"] = 11
    assert ("median_bias,robust_deviation" in measure_table(results, ["rmse:delay"]).summary()) == said


def test_the_snr_is_a_key_of_an_experiment_that_does_not_sweep_it(make_results, estimate):
    results = make_results({(15.0, "0.0"): [estimate(8.0)]}, snrs=(15.0,), swept=False)
    assert set(percentage_frame(results)["snr_db"]) == {15.0}
    results.settings["noise"]["snr_db"] = None
    assert set(percentage_frame(results)["snr_db"]) == {None}
    assert "SNR" not in experiment_table(results).summary()


def test_several_initial_parameters_are_told_apart(make_results, estimate):
    results = make_results({(15.0, "0.0"): [estimate(8.0)], (15.0, RANDOM): [estimate(3.0)]}, snrs=(15.0,), swept=False)
    assert "start" not in settings_of(percentage_frame(results))
    starts = results.manifest["starts"]
    starts.clear()
    starts |= {"0.0": None, RANDOM: None, "none": None}
    rows = records_of(percentage_frame(results))
    assert [(row["start"], row["percent"]) for row in rows] == [("0.0", 100.0), (RANDOM, 0.0)]
    assert "100  [21, 100]  1" in experiment_table(results).summary()


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


# --- frequencies of a signal ----------------------------------------------------------------------------------------


def measured(results):
    """Return the medians of the tracker and of the estimator of whole records."""
    names = ("median_settling_time", "median_settling_after_step", "median_rms_1", "median_rms_2", "false_alarms")
    return [[row.get(name) for name in names] for row in records_of(percentage_frame(results))]


def test_medians_are_of_the_slowest_tone(tmp_path):
    tracks = [of_track(1.0, 3.0, 2.0, 0.1, 0), of_track(2.0, 1.5, 3.0, 0.3, 2), of_track(5.0, 0.0, 9.0, 0.2, 1)]
    results = frequency_results(tmp_path, tracks, [of_record(0.01)])
    assert measured(results) == [[3.0, 3.0, 0.2, 0.2, 3], [None, None, 0.01, 0.05, None]]
    # Settled in time: not the one with 5 and 9 s; of the whole records, those with errors inside the band.
    assert percentage_frame(results)["converged"].tolist() == [2, 1]


@pytest.mark.parametrize(("never", "median", "converged"), [(1, 1.0, 2), (2, None, 2)])
def test_what_never_settles_counts_as_later_than_all_others(tmp_path, never, median, converged):
    tracks = [of_track(None, 1.0, None, 0.1, 0)] * never + [of_track(1.0, 1.0, 1.0, 0.1, 0)] * 2
    results = frequency_results(tmp_path, tracks, [])
    assert measured(results)[0][0] == median
    assert percentage_frame(results)["converged"][0] == converged


def test_estimates_of_frequencies_that_failed_have_no_measures(tmp_path, snapshot):
    results = frequency_results(tmp_path, [of_track(1.0, 1.0, 1.0, 0.1, 1), None, None], [None])
    assert measured(results) == [[None, None, None, None, 1], [None] * 5]
    rows = records_of(percentage_frame(results))
    assert [(row["n"], row["failed"], row["converged"]) for row in rows] == [(3, 2, 1), (1, 1, 0)]
    assert experiment_table(results).summary() == snapshot
    assert [row["n"] for row in records_of(percentage_frame(frequency_results(tmp_path, [None], [])))] == [1, 0]
