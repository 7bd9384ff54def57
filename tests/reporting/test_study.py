import json

import pytest

from ctid_cli.errors import UsageError
from ctid_cli.reporting.committed import made_by
from ctid_cli.reporting.layout import Report, write_reports
from ctid_cli.reporting.percentages import pooled_rows, study_rows
from ctid_cli.reporting.study import data_folder, load_study
from ctid_cli.reporting.table_blocks import study_blocks
from ctid_cli.reporting.tables import build_tables
from ctid_cli.running.plan import build_plan, current_version
from ctid_cli.specification.load import load_spec
from experiments.useful_redundancy.tables import failures, searches

RANDOM = "uniform(0, 9)"

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


@pytest.fixture(scope="module")
def empty(tmp_path_factory):
    return {number: build_tables([str(number)], tmp_path_factory.mktemp("empty"))[0] for number in load_study().tables}


@pytest.mark.parametrize(("case", "sampling", "snr", "fixed", "random"), EXISTING)
def test_every_published_number_of_the_existing_method_stands_in_its_cell(empty, case, sampling, snr, fixed, random):
    def published(number):
        return {
            row["initial_delay"]: row["published_percent"]
            for row in empty[number].records
            if (row["sampling"], row["snr_db"], row["method"]) == (sampling, snr, "existing")
        }

    assert published(2 * case - 1) == dict(zip([0, 1, 3, 5, 7, 9], fixed, strict=True))
    assert published(2 * case) == {"random": random}


def test_the_proposed_method_reached_99_or_100_percent_everywhere(empty):
    published = {number: [] for number in empty}
    for number, table in empty.items():
        for row in table.records:
            if row["method"] == "redundancy":
                published[number].append((row["sampling"], row["snr_db"], row["published_percent"]))
    assert {number: len(values) for number, values in published.items()} == {1: 24, 2: 4, 3: 24, 4: 4}
    below = {(number, *value) for number, values in published.items() for value in values if value[2] != 100}
    assert below == {(3, "regular", 5, 99), (4, "regular", 5, 99)}


def test_without_results_every_cell_says_not_run_and_keeps_its_published_value(empty):
    for number, table in empty.items():
        assert all(row["n"] == 0 and row["percent"] is None and row["low"] is None for row in table.records)
        assert "not run" in table.draw()
        assert f"case{(number + 1) // 2}_regular.yaml" in "\n".join(table.notes)
        assert max(len(line) for line in Report(table.blocks).draw().splitlines()) <= 100


def test_the_whole_study_is_the_default(tmp_path):
    tables = build_tables([], tmp_path)
    assert [table.records[0]["table"] for table in tables] == [1, 2, 3, 4]
    text = write_reports(tables, "text")
    assert all(f"Table {number}." in text for number in (1, 2, 3, 4))
    assert "arXiv:1703.09344" in text


def test_in_a_fresh_clone_the_committed_tables_stand_in(tmp_path):
    (table,) = build_tables(["3"], tmp_path, committed=True)
    assert {row["table"] for row in table.records} == {3}
    # The printed method was run from two of the delays only, as it takes so long.
    ours = [row for row in table.records if row["method"] != "as_printed"]
    assert all(row["n"] == 100 and row["percent"] is not None for row in ours)
    assert "committed results of " in table.notes[0]
    assert "not run" not in Report(table.blocks).draw()
    assert json.loads(write_reports([table], "json"))[0]["table"] == 3


def test_results_of_earlier_code_are_called_so(tmp_path):
    plan = build_plan(load_spec(data_folder("configs") / "useful_redundancy" / "case1_regular.yaml"))
    current = {"code_version": current_version(plan)}
    assert made_by(tmp_path) == ""
    earlier = "computed by an earlier version of the code or of its numerical libraries (commit abcdefabcdef)"
    for sessions, said in (
        ({"case1-regular": [current]}, ""),
        ({"case1-regular": [current, {"code_version": "0" * 16}]}, earlier),
        # By the present code of other estimators, and by a specification that is no more.
        ({"as-printed-case1-regular": [current]}, ""),
        ({"case0": [current]}, earlier),
    ):
        content = {"commit": "abcdef" * 7, "sessions": sessions}
        (tmp_path / "environment.json").write_text(json.dumps(content), encoding="utf-8")
        assert made_by(tmp_path) == said


@pytest.mark.parametrize("name", ["5", "useful-redundancy/0", "quickstrat", "other-study/1"])
def test_unknown_names_are_refused(tmp_path, name):
    with pytest.raises(UsageError):
        build_tables([name], tmp_path)


@pytest.fixture
def mixed(make_results, add_estimator, estimate):
    """Of one experiment: the existing method in part, ours, and two that take no start."""
    good, bad = estimate(8.0), estimate(5.0, "STALLED")
    results = make_results({(5.0, "0.0"): [good, bad, bad, bad], (5.0, RANDOM): [good, bad], (15.0, "0.0"): [good]})
    add_estimator(results, "other_profile", {(5.0, None): [good, good, good, bad], (15.0, None): [good] * 4})
    add_estimator(results, "redundancy", {(5.0, "0.0"): [good] * 4, (5.0, RANDOM): [good] * 3 + [bad]})
    add_estimator(results, "delay_profile", {(5.0, None): [good] * 4, (15.0, None): [good] * 3 + [bad]})
    return results


def tabulated(results, number, style="text"):
    study = load_study()
    rows = study_rows(study, study.tables[number], {results.experiment: results})
    return rows, Report(study_blocks(study, study.tables[number], rows, style)).draw(style)


def test_methods_stand_in_the_order_of_the_study_below_each_setting(mixed):
    for number in (1, 2):
        rows, text = tabulated(mixed, number)
        regular = [row for row in rows if (row["sampling"], row["snr_db"]) == ("regular", 5.0)]
        methods = ["existing", "as_printed", "redundancy", "delay_profile", "other_profile"]
        assert list(dict.fromkeys(row["method"] for row in regular)) == methods
        first = text.split("15 dB")[0]
        assert sorted(methods, key=lambda method: first.index(f"{method} ")) == methods


@pytest.mark.parametrize("number", [1, 2])
def test_an_estimator_without_a_start_is_in_every_table_with_one_estimate_per_data_set(mixed, number):
    rows, text = tabulated(mixed, number)
    mine = [row for row in rows if row["method"] == "other_profile"]
    assert [(row["snr_db"], row["initial_delay"], row["n"], row["percent"]) for row in mine] == [
        (5.0, None, 4, 75.0),
        (15.0, None, 4, 100.0),
    ]
    assert "delay_profile and other_profile were given no initial delay: one estimate per data set" in " ".join(
        text.split()
    )
    if number == 1:
        line = next(line for line in text.splitlines() if "other_profile" in line)
        assert line.split()[-9:] == ["n", "=", "4"] + ["75"] * 6
        assert "none" not in text.split("All cells")[0]


def test_without_such_an_estimator_nothing_is_said_about_it(make_results, estimate):
    _, text = tabulated(make_results({(5.0, "0.0"): [estimate(8.0)]}), 1)
    assert "no initial delay" not in text
    assert "delay_profile" not in text


@pytest.mark.parametrize("number", [1, 2])
def test_all_methods_fit_100_columns_also_with_many_data_sets(make_results, add_estimator, estimate, number):
    found = [estimate(8.0)] * 299 + [estimate(3.0)]
    results = make_results({(5.0, "0.0"): found, (5.0, RANDOM): found})
    for method in ("redundancy", "other_redundancy"):
        add_estimator(results, method, {(5.0, "0.0"): found, (5.0, RANDOM): found})
    for method in ("delay_profile", "other_profile"):
        add_estimator(results, method, {(5.0, None): found})
    for cell in results.manifest["data_cells"]:
        cell["replicates"] = 300
    text = tabulated(results, number)[1]
    assert text.count("99.7") >= 10
    assert max(map(len, text.splitlines())) <= 100


def test_times_stand_in_text_and_markdown(mixed):
    for style in ("text", "md"):
        for number in (1, 2):
            text = tabulated(mixed, number, style)[1]
            assert "20 ms" in text
            assert "500 ms" in text


def test_the_pooled_percentage_is_that_of_all_estimates_in_the_cells_of_the_table(mixed):
    study = load_study()
    rows, text = tabulated(mixed, 1)
    pooled = {row["method"]: row for row in pooled_rows(study, study.tables[1], rows)}
    existing = pooled["existing"]
    # 1 of 4 at 5 dB, 1 of 1 at 15 dB; published from 0 s 65 and 69
    assert (existing["cells"], existing["cells_run"], existing["n"], existing["converged"]) == (24, 2, 5, 2)
    assert (existing["percent"], existing["published_percent"]) == (40.0, 67.0)
    assert (pooled["delay_profile"]["cells"], pooled["delay_profile"]["cells_run"]) == (4, 2)
    assert (pooled["delay_profile"]["percent"], pooled["delay_profile"]["published_percent"]) == (87.5, None)
    line = next(line for line in text.split("All cells")[1].splitlines() if line.startswith("existing"))
    assert line.split() == ["existing", "2", "of", "24", "5", "40.0", "67.0", "20", "ms"]


def test_what_was_run_beyond_the_table_is_not_pooled(make_results, estimate):
    study = load_study()
    results = make_results({(10.0, "0.0"): [estimate(8.0)], (5.0, "0.0"): [estimate(3.0)]}, snrs=(5.0, 10.0))
    results.manifest["starts"]["0.0"] = 2.0
    rows, _ = tabulated(results, 1)
    assert sum(row["n"] for row in rows) == 2
    assert all(row["n"] == 0 for row in pooled_rows(study, study.tables[1], rows))
    results.manifest["starts"]["0.0"] = 0.0
    (existing, *_) = pooled_rows(study, study.tables[1], tabulated(results, 1)[0])
    assert (existing["n"], existing["converged"]) == (1, 0)


def test_without_results_the_pooled_published_percentage_is_the_mean_of_the_table(empty):
    values = [value for case, _, _, fixed, _ in EXISTING if case == 1 for value in fixed]
    line = next(line for line in empty[1].draw().split("All cells")[1].splitlines() if line.startswith("existing"))
    assert line.split() == ["existing", "0", "of", "24", "0", "not", "run", f"{sum(values) / len(values):.1f}"]


def test_failing_estimates_are_listed_with_what_makes_them_again(mixed):
    rows = list(failures(mixed))
    assert [(r["method"], r["snr_db"], r["initial_delay"], r["replicate"], r["delay"]) for r in rows] == [
        ("other_profile", 5.0, None, 3, 5.0),
        ("redundancy", 5.0, "random", 3, 5.0),
        ("delay_profile", 15.0, None, 3, 5.0),
    ]
    assert {(r["experiment"], r["sampling"], r["seed"], r["status"], r["true_delay"]) for r in rows} == {
        ("useful-redundancy/case1-regular", "regular", 1, "STALLED", 8.0)
    }
    assert all(row["experiment"] == mixed.experiment and row["estimator"] != "existing" for row in rows)
    stored = {row["id"]: row for row in mixed.rows}
    assert all(not stored[row["id"]]["converged"] for row in rows)
    assert len({row["id"] for row in rows}) == 3


def test_searches_are_counted_by_method_and_cell(make_results, add_estimator, estimate):
    ends = [(7.93, 1), (8.5, 0), (8.0, 3), (2.0, 0)]
    found = [estimate(8.0 if end > 5 else end, search_delay=end, switches=count) for end, count in ends]
    results = make_results({(5.0, "0.0"): [estimate(8.0), estimate(5.0)]})
    add_estimator(results, "as_printed", {(5.0, "0.0"): found[:2], (5.0, RANDOM): found[2:]})
    existing, printed = ({key: row[key] for key in row if key != "median_seconds"} for row in searches(results))
    alike = {"experiment": results.experiment, "snr_db": 5.0, "max_delay_step": None}
    nothing = {"search_percent": None, "switched": None, "most_switches": None}
    assert existing == alike | {"method": "existing", "n": 2, "percent": 50.0, **nothing}
    counts = {"search_percent": 50.0, "switched": 2, "most_switches": 3}
    assert printed == alike | {"method": "as_printed", "n": 4, "percent": 75.0, **counts}
