"""``ctid check filters``: the verdict first, the numbers behind it, and JSON of the same."""

import json
import re

import pytest

CASE_2 = ("check", "filters", "--bandwidth", 26.85, "--filters", 15, "--beta", 10, "--largest-error", 15)
GAP = ("check", "filters", "--bandwidth", 6.283185307179586, "--filters", 6, "--beta", 2, "--largest-error", 15)


def test_text_of_a_set_that_passes(ctid):
    done = ctid(*CASE_2)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0].startswith("PASS: from every delay error up to 15 s ")
    assert re.search(r"^ +1 +2\.34 +2\.685 +1\.674$", done.stdout, re.MULTILINE)
    assert re.search(r"^ +15 +0\.234 +26\.85 +0\.1674$", done.stdout, re.MULTILINE)
    assert re.search(r"^0 to 1\.6735 +1 +0$", done.stdout, re.MULTILINE)
    assert re.search(
        r"Path \[s\] from 15: 14\.336 \(filter 5\), .* 1\.5825 \(filter 8\), 0 \(filter 1\)\. ", " ".join(lines)
    )
    assert "114 filters" in done.stdout
    assert "nothing closer" not in done.stdout
    assert max(map(len, lines)) <= 100


def test_text_of_a_set_with_a_gap(ctid):
    text = ctid(*GAP).stdout
    assert text.startswith(
        "NOT PASSED: from some delay errors up to 15 s no filter leads closer to zero: 14.097 to 14.248"
    )
    assert re.search(r"^14\.097 to 14\.248 +none +nothing closer$", text, re.MULTILINE)
    assert "14.248 (filter 6); from there no filter leads closer." in text
    # starting in the gap there is no path, and the exit code stays 0
    assert "No path: " in ctid(*GAP[:-1], 14.2).stdout


def test_text_where_one_filter_does_it_all(ctid):
    text = ctid("check", "filters", "--bandwidth", 2.02, "--largest-error", 15).stdout
    assert "One filter suffices: that of the longest period leads from 15 s to zero by itself." in text
    assert "Path [s] from 15: 0 (filter 1).\n" in text


def test_text_where_no_number_suffices(ctid):
    text = ctid("check", "filters", "--bandwidth", 2, "--filters", 20, "--beta", 1.717, "--largest-error", 9).stdout
    assert text.startswith("NOT PASSED")
    assert "Equation (56) asks for " in text
    # between the true and the printed first maximum of the widest filter, too
    text = ctid("check", "filters", "--bandwidth", 2.02, "--largest-error", 22.26).stdout
    assert "Equation (56) asks for 1 filter, but" in text


def test_json(ctid):
    content = json.loads(ctid(*CASE_2, "--json").stdout)
    assert content["passes"] is True
    assert content["gaps"] == []
    assert content["sufficient_number"] == 114
    assert [row["filter"] for row in content["filters"]] == list(range(1, 16))
    assert content["filters"][0]["cutoff"] == pytest.approx(2.685)
    # the intervals fill the range, each filter leads to a minimum below, and the path ends at zero
    assert content["intervals"][0]["low"] == 0
    assert content["intervals"][-1]["high"] == 15
    for one, two in zip(content["intervals"], content["intervals"][1:], strict=False):
        assert one["high"] == two["low"]
        assert two["minimum"] <= two["low"]
        assert one["filter"] != two["filter"] or one["minimum"] != two["minimum"]
    errors = [15, *(step["error"] for step in content["path"])]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] == 0

    content = json.loads(ctid(*GAP, "--json").stdout)
    assert content["passes"] is False
    (gap,) = content["gaps"]
    assert gap == {"low": pytest.approx(14.0974, abs=1e-4), "high": pytest.approx(14.2482, abs=1e-4)}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (("--bandwidth", -1), "--bandwidth must be a positive number [rad/s], not -1.0."),
        (("--largest-error", 0), "--largest-error must be a positive number [s], not 0.0."),
        (("--largest-error", "nan"), "--largest-error must be a positive number [s], not nan."),
        (("--largest-error", 1e9), "too many extrema"),
        (("--filters", 1), "--filters must be an integer of at least 2, not 1."),
        (("--beta", 1.5), "must be between 1.7170"),
        (("--beta", 11), "and 10, not 11.0."),
    ],
)
@pytest.mark.parametrize("as_json", [(), ("--json",)])
def test_bad_values(ctid, changed, message, as_json):
    option, value = changed
    place = CASE_2.index(option) + 1
    done = ctid(*CASE_2[:place], value, *CASE_2[place + 1 :], *as_json, code=2)
    assert done.stdout == ""
    assert done.stderr.startswith("ctid: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_missing_options_are_named(ctid):
    assert "Missing option '--largest-error'" in ctid("check", "filters", "--bandwidth", 2, code=2).stderr


def test_help_of_the_group_and_of_the_check(ctid):
    text = ctid("check", "--help").stdout
    assert "FILE" in text.splitlines()[0]
    assert "--input NAME" in text
    assert re.search(r"^  filters +Say whether a set of low-pass filters ", text, re.MULTILINE)
    text = ctid("check", "filters", "-h").stdout
    assert text.splitlines()[0].endswith("check filters [OPTIONS]")
    assert "--largest-error SECONDS" in text


def test_a_file_still_goes_to_the_check_of_a_record(ctid, tmp_path, monkeypatch):
    # also one of that very name, and with options first
    monkeypatch.chdir(tmp_path)
    (tmp_path / "filters").write_text("t,u,y\n", encoding="utf-8")
    rows = "".join(f"{k},{(k // 7) % 2},{k % 5}\n" for k in range(200))
    (tmp_path / "rig.csv").write_text("t,u,y\n" + rows, encoding="utf-8")
    assert "filters:2: the file has a header and no data" in ctid("check", "./filters", code=2).stderr
    assert "200 samples" in ctid("check", "rig.csv").stdout
    assert json.loads(ctid("check", "--json", "rig.csv").stdout)["n_samples"] == 200
    assert "Missing argument 'FILE'" in ctid("check", code=2).stderr
    assert "nowhere.csv: does not exist" in ctid("check", "nowhere.csv", code=2).stderr
