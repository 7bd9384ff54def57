"""Output of commands in a pipe: text, to be read when it changes, and JSON, validated against its schema."""

import csv
import io
import json
import re

import pytest

from tests.cli.records import COMMANDS


@pytest.mark.parametrize("command", COMMANDS["text"], ids=str)
def test_text(ctid, home, snapshot, command):
    done = ctid(command)
    # The last digits of full-precision numbers depend on the processor.
    text = re.sub(r"\d+\.\d{6,}(e[-+]\d+)?", lambda number: f"{float(number[0]):.4g}", done.stdout)
    # Identifiers of estimates by the code of a study depend on its path.
    text = re.sub(r"\b[0-9a-f]{12}\b", "(identifier)", text)
    assert [text, done.stderr] == snapshot


@pytest.mark.parametrize("name", ["tiny", "loop", "beat"])
def test_one_estimate_in_full(ctid, home, snapshot, name):
    estimates = json.loads(ctid(f"export {name} --json").stdout)
    some = {each["estimator"]: each for each in estimates}
    # A prefix of the identifier is enough; code of a study is named by a path of this machine.
    shown = [ctid(f"export --id {each['id'][:10]}").stdout for each in some.values() if ":" not in each["kind"]]
    assert shown == snapshot
    for each in some.values():
        whole = json.loads(ctid(f"export --id {each['id']} --json").stdout)
        assert {key: whole[key] for key in each if key != "parameters"} == {
            key: value for key, value in each.items() if key != "parameters"
        }
        assert (whole["seed"], whole["settings"]["kind"]) == (1, each["kind"])


@pytest.mark.parametrize("command", COMMANDS["json"], ids=str)
def test_json_follows_its_schema(ctid, home, command):
    # The schema is compared in ``ctid``.
    assert ctid(f"{command} --json").stdout == ctid(f"{command} --format json").stdout


@pytest.mark.parametrize("name", ["tiny", "loop", "beat"])
def test_csv_holds_what_json_holds(ctid, home, name):
    estimates = json.loads(ctid(f"export {name} --json").stdout)
    text = ctid(f"export {name}").stdout
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["id"] for row in rows] == [each["id"] for each in estimates]
    for row, each in zip(rows, estimates, strict=True):
        flat = {key: value for key, value in each.items() if not isinstance(value, dict | list)}
        flat |= each.get("measures") or {}
        flat |= {f"se_{key}": value for key, value in (each.get("standard_errors") or {}).items()}
        flat |= each.get("parameters") or {}
        # Columns without any value in the experiment are omitted.
        assert {flat.pop(key) for key in [*flat] if key not in row} <= {None, "none", ""}
        assert {key: row[key] for key in flat} == {
            key: "" if value is None else str(value) for key, value in flat.items()
        }
        for letter, part in (("a", "denominator"), ("b", "numerator")):
            if each.get(part):
                assert [float(row[f"{letter}{k}"]) for k in range(letter == "a", len(each[part]))] == (
                    each[part][letter == "a" :]
                )
    table = json.loads(ctid(f"table {name} --json").stdout)
    shown = list(csv.DictReader(io.StringIO(ctid(f"table {name} --format csv").stdout)))
    assert [list(row) for row in shown] == [list(table[0])] * len(table)


@pytest.mark.parametrize(
    ("name", "keys"),
    [("tiny", ["initial_delay", "snr_db"]), ("loop", ["samples", "start"]), ("beat", ["half_width", "h"])],
)
def test_a_table_counts_the_estimates_that_meet_the_rule(ctid, home, name, keys):
    estimates = json.loads(ctid(f"export {name} --json").stdout)
    for row in json.loads(ctid(f"table {name} --json").stdout):
        cell = [row["method"], *(row[key] for key in keys)]
        mine = [each for each in estimates if [each["estimator"], *map(each.get, keys)] == cell]
        assert (row["n"], row["converged"]) == (len(mine), sum(each["converged"] for each in mine))
        assert row["percent"] == 100 * row["converged"] / row["n"]
