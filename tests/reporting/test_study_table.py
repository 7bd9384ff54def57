"""Tables of the published study: its numbers next to ours, and placeholders for cells that were not run."""

import pytest

from ctid_cli.reporting.document import render_markdown, render_text
from ctid_cli.reporting.measures import records_of
from ctid_cli.reporting.study import find_study
from ctid_cli.reporting.study_table import build_tables, pooled_frame, study_frame, study_sections
from experiments.useful_redundancy.tables import failures, searches

RANDOM = "uniform(0, 9)"
STUDY = find_study()

# Ha, Welsh and Alamir, arXiv:1703.09344, Tables 1 and 3 (initial delays 0, 1, 3, 5, 7, 9 s) and 2 and 4 (random),
# existing method: case, sampling, SNR, six fixed delays, random delay.
EXISTING = [
    (1, "regular", 5, [65, 100, 100, 97, 100, 100], 90),
    (1, "regular", 15, [69, 89, 92, 99, 100, 100], 97),
    (1, "irregular", 5, [1, 1, 0, 17, 100, 90], 40),
    (1, "irregular", 15, [1, 0, 7, 18, 100, 89], 41),
    (2, "regular", 5, [1, 52, 22, 43, 76, 68], 52),
    (2, "regular", 15, [0, 60, 6, 28, 70, 69], 46),
    (2, "irregular", 5, [8, 16, 23, 26, 66, 48], 48),
    (2, "irregular", 15, [9, 10, 19, 27, 55, 50], 21),
]


def rows_of(number, *results):
    return records_of(frame_of(number, *results))


def frame_of(number, *results):
    return study_frame(STUDY, STUDY.tables[number], {one.experiment: one for one in results})


def sections_of(number, *results):
    return study_sections(STUDY, STUDY.tables[number], frame_of(number, *results))


def test_every_published_number_stands_in_its_cell():
    published = {number: {} for number in STUDY.tables}
    for number, cells in published.items():
        for row in rows_of(number):
            place = row["sampling"], row["snr_db"], row["method"]
            cells.setdefault(place, {})[row["initial_delay"]] = row["published_percent"]
            assert (row["n"], row["percent"], row["low"]) == (0, None, None)
    for case, sampling, snr, fixed, random in EXISTING:
        place = sampling, snr, "existing"
        assert published[2 * case - 1][place] == dict(zip([0, 1, 3, 5, 7, 9], fixed, strict=True))
        assert published[2 * case][place] == {"random": random}
    # The proposed method reached 99 or 100 % everywhere.
    redundancy = {
        n: [v for place, own in cells.items() if place[2] == "redundancy" for v in own.values()]
        for n, cells in published.items()
    }
    assert {number: (len(values), values.count(100)) for number, values in redundancy.items()} == {
        1: (24, 24),
        2: (4, 4),
        3: (24, 18),
        4: (4, 3),
    }


def test_fixed_and_random_starts_go_to_their_tables(make_results, estimate):
    results = make_results({(5.0, "0.0"): [estimate(8.0), estimate(3.0)], (5.0, RANDOM): [estimate(8.0)] * 4})
    (fixed,), (random,) = ([row for row in rows_of(number, results) if row["n"]] for number in (1, 2))
    assert [fixed[key] for key in ("initial_delay", "n", "percent", "published_percent")] == [0.0, 2, 50.0, 65.0]
    assert [random[key] for key in ("initial_delay", "n", "percent", "published_percent")] == ["random", 4, 100.0, 90.0]
    # Cells that were not run stay in the table.
    assert (len(rows_of(1, results)), len(rows_of(2, results))) == (72, 12)


@pytest.mark.parametrize(("snr", "swept", "published"), [(15.0, False, 69.0), (10.0, True, None)])
def test_a_setting_finds_its_cell_or_gets_one_of_its_own(make_results, estimate, snr, swept, published):
    results = make_results({(snr, "0.0"): [estimate(8.0)]}, snrs=(snr,), swept=swept)
    (row,) = [row for row in rows_of(1, results) if row["n"]]
    assert [row[key] for key in ("snr_db", "initial_delay", "n", "published_percent")] == [snr, 0.0, 1, published]
    assert f"{snr:g} dB" in render_text(sections_of(1, results))


@pytest.fixture
def mixed(make_results, add_estimator, estimate):
    """Return one experiment: part of the existing method, ours, and two without a start."""
    good, bad = estimate(8.0), estimate(5.0, "STALLED")
    results = make_results({(5.0, "0.0"): [good, bad, bad, bad], (5.0, RANDOM): [good, bad], (15.0, "0.0"): [good]})
    add_estimator(results, "other_profile", {(5.0, None): [good, good, good, bad], (15.0, None): [good] * 4})
    add_estimator(results, "redundancy", {(5.0, "0.0"): [good] * 4, (5.0, RANDOM): [good] * 3 + [bad]})
    add_estimator(results, "delay_profile", {(5.0, None): [good] * 4, (15.0, None): [good] * 3 + [bad]})
    return results


@pytest.mark.parametrize("number", [1, 2])
def test_methods_stand_below_each_setting_and_those_without_a_start_in_every_table(mixed, number, snapshot):
    mine = [row for row in rows_of(number, mixed) if row["method"] == "other_profile"]
    assert [(row["snr_db"], row["initial_delay"], row["n"], row["percent"]) for row in mine] == [
        (5.0, None, 4, 75.0),
        (15.0, None, 4, 100.0),
    ]
    sections = sections_of(number, mixed)
    assert {"text": render_text(sections), "md": render_markdown(sections)} == snapshot


def test_the_pooled_percentage_is_that_of_all_estimates_in_the_cells_of_the_table(mixed):
    pooled = pooled_frame(STUDY, STUDY.tables[1], frame_of(1, mixed)).set_index("method")
    # 1 of 4 at 5 dB, 1 of 1 at 15 dB; published from 0 s 65 and 69.
    assert pooled.loc["existing"].tolist() == ["2 of 24", 5, 2, "40.0", "67.0", "20 ms"]
    assert pooled.loc["delay_profile"].tolist()[:5] == ["2 of 4", 8, 7, "87.5", ""]
    # Without results, it is the mean of the table.
    values = [value for case, _, _, fixed, _ in EXISTING if case == 1 for value in fixed]
    (existing, *_) = records_of(pooled_frame(STUDY, STUDY.tables[1], frame_of(1)))
    assert (existing["cells"], existing["percent"]) == ("0 of 24", "not run")
    assert existing["published"] == f"{sum(values) / len(values):.1f}"


def test_what_was_run_beyond_the_table_is_not_pooled(make_results, estimate):
    results = make_results({(10.0, "0.0"): [estimate(8.0)], (5.0, "0.0"): [estimate(3.0)]}, snrs=(5.0, 10.0))
    for delay, n in ((2.0, 0), (0.0, 1)):
        results.manifest["starts"]["0.0"] = delay
        assert pooled_frame(STUDY, STUDY.tables[1], frame_of(1, results))["n"].sum() == n


def test_the_whole_study_is_the_default_and_committed_tables_stand_in(tmp_path):
    nothing = build_tables([], tmp_path)
    assert [row["table"] for row in nothing.rows] == sorted(row["table"] for row in nothing.rows)
    assert {row["table"] for row in nothing.rows} == {1, 2, 3, 4}
    assert all(f"Table {number}." in nothing.summary() for number in (1, 2, 3, 4))
    assert "case2_regular.yaml" in nothing.summary()
    committed = build_tables(["3"], tmp_path, committed=True)
    assert {row["table"] for row in committed.rows} == {3}
    # The method as printed was run from two of the delays only, because it is slow.
    ours = [row for row in committed.rows if row["method"] != "as_printed"]
    assert all(row["n"] == 100 and row["percent"] is not None for row in ours)
    assert "committed results of " in committed.remarks[0]


def test_failing_estimates_are_listed_with_what_makes_them_again(mixed):
    rows = records_of(failures(mixed))
    assert [(r["method"], r["snr_db"], r["initial_delay"], r["replicate"], r["delay"]) for r in rows] == [
        ("other_profile", 5.0, None, 3, 5.0),
        ("redundancy", 5.0, "random", 3, 5.0),
        ("delay_profile", 15.0, None, 3, 5.0),
    ]
    assert {(r["experiment"], r["sampling"], r["seed"], r["status"], r["true_delay"]) for r in rows} == {
        ("useful-redundancy/case1-regular", "regular", 1, "STALLED", 8.0)
    }


def test_searches_are_counted_by_method_and_cell(make_results, add_estimator, estimate):
    ends = [(7.93, 1), (8.5, 0), (8.0, 3), (2.0, 0)]
    found = [estimate(8.0 if end > 5 else end, search_delay=end, switches=count) for end, count in ends]
    results = make_results({(5.0, "0.0"): [estimate(8.0), estimate(5.0)]})
    add_estimator(results, "as_printed", {(5.0, "0.0"): found[:2], (5.0, RANDOM): found[2:]})
    existing, printed = (
        {key: row[key] for key in row if key != "median_seconds"} for row in records_of(searches(results))
    )
    alike = {"experiment": results.experiment, "snr_db": 5.0, "max_delay_step": None}
    nothing = {"search_percent": None, "switched": None, "most_switches": None}
    assert existing == alike | {"method": "existing", "n": 2, "percent": 50.0, **nothing}
    counts = {"search_percent": 50.0, "switched": 2, "most_switches": 3}
    assert printed == alike | {"method": "as_printed", "n": 4, "percent": 75.0, **counts}
