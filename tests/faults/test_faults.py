"""Whatever somebody hands over, ctid answers: a result, or one message and a documented exit code.

A short form runs with all tests; 20,000 inputs are part of ``make faults``. What these found once stands in
``regressions.json``, made small, and is tried every time.
"""

import base64
import json
import os
from pathlib import Path

import pytest

from tests.faults.harness import fault_of, faults, shrunk

#: Inputs of the short form, of each kind.
FEW = {"yaml": 75, "csv": 75, "mat": 45, "results": 45, "arguments": 60}
FOUND = json.loads(Path(__file__).with_name("regressions.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("kind", FEW)
def test_no_input_brings_about_a_traceback_or_hangs(kind, fuzzer):
    found = faults(fuzzer, kind, range(FEW[kind]))
    for number, fault in found.items():
        data = fuzzer.made(kind, number)
        if "hangs" not in fault and "died" not in fault:
            data = shrunk(data, lambda smaller: bool(fault_of(fuzzer, kind, smaller)))
        text = base64.b64encode(data).decode()
        print(json.dumps({"kind": kind, "number": number, "input": text, "was": fault.strip().splitlines()[-1][:200]}))
        print(fault)
    assert not found, f"{len(found)} of {FEW[kind]} inputs of kind {kind}: {sorted(found)[:20]}"


@pytest.mark.parametrize("entry", FOUND, ids=[f"{entry['kind']}-{entry['number']}" for entry in FOUND])
def test_what_was_found_once(entry, fuzzer):
    assert fault_of(fuzzer, entry["kind"], base64.b64decode(entry["input"])) == ""


def test_an_input_is_made_small():
    assert shrunk(b"a" * 50 + b"x" + b"b" * 70, lambda data: b"x" in data) == b"x"


def test_the_watch_sees_what_hangs_and_what_dies(fuzzer, monkeypatch):
    from tests.faults import harness

    def tried(self, kind, data, number):
        if number == 1:
            os._exit(3)
        while number == 2:
            pass

    monkeypatch.setattr(harness, "PATIENCE", 1.0)
    monkeypatch.setattr(harness.Fuzzer, "tried", tried)
    found = faults(fuzzer, "csv", range(4))
    assert found.keys() == {1, 2}
    assert "died" in found[1]
    assert "hangs" in found[2]
