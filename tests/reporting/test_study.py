import pytest

from ctid_cli.errors import UsageError
from ctid_cli.reporting.report import build_tables, write_tables
from ctid_cli.reporting.study import load_study

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
            for row in empty[number].rows
            if (row["sampling"], row["snr_db"], row["method"]) == (sampling, snr, "existing")
        }

    assert published(2 * case - 1) == dict(zip([0, 1, 3, 5, 7, 9], fixed, strict=True))
    assert published(2 * case) == {"random": random}


def test_the_proposed_method_reached_99_or_100_percent_everywhere(empty):
    published = {number: [] for number in empty}
    for number, table in empty.items():
        for row in table.rows:
            if row["method"] == "proposed":
                published[number].append((row["sampling"], row["snr_db"], row["published_percent"]))
    assert {number: len(values) for number, values in published.items()} == {1: 24, 2: 4, 3: 24, 4: 4}
    below = {(number, *value) for number, values in published.items() for value in values if value[2] != 100}
    assert below == {(3, "regular", 5, 99), (4, "regular", 5, 99)}


def test_without_results_every_cell_says_not_run_and_keeps_its_published_value(empty):
    for number, table in empty.items():
        assert all(row["n"] == 0 and row["percent"] is None and row["low"] is None for row in table.rows)
        assert "not run" in table.text
        assert f"case{(number + 1) // 2}_regular.yaml" in "\n".join(table.notes)
        assert max(len(line) for line in table.text.splitlines()) <= 100


def test_the_whole_study_is_the_default(tmp_path):
    tables = build_tables([], tmp_path)
    assert [table.rows[0]["table"] for table in tables] == [1, 2, 3, 4]
    text = write_tables(tables, "text")
    assert all(f"Table {number}." in text for number in (1, 2, 3, 4))
    assert "arXiv:1703.09344" in text


@pytest.mark.parametrize("name", ["5", "useful-redundancy/0", "quickstrat", "other-study/1"])
def test_unknown_names_are_refused(tmp_path, name):
    with pytest.raises(UsageError):
        build_tables([name], tmp_path)
