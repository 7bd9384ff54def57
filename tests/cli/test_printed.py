"""Output of commands in a pipe: text, to be read when it changes, and JSON, validated against its schema."""

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
def test_json_follows_its_schema(ctid, home, few_candidates, command):
    # The schema is compared in ``ctid``.
    ctid(f"{command} --json")


def test_two_options_ask_for_json(ctid, home):
    assert ctid("status tiny --json").stdout == ctid("status tiny --format json").stdout
