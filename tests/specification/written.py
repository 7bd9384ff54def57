"""Specifications written to a file by tests, and their errors."""

from pathlib import Path

import pytest

from ctid_cli.errors import SpecError
from ctid_cli.running.trial import load_tried

SIMULATED, CLOSED_LOOP, SIGNAL, OPEN_LOOP, MEASURED, MEASURED_LOOP, CUSTOM, CUSTOM_PARTS, RECORD = (
    Path(__file__).with_name(name).read_text(encoding="utf-8")
    for name in (
        *("simulated.yaml", "closed_loop.yaml", "signal.yaml", "open_loop.yaml", "measured.yaml", "measured_loop.yaml"),
        *("custom.yaml", "custom_parts.txt", "record.csv"),
    )
)


def load(folder, text, *overrides, allow_code=False):
    file = folder / "spec.yaml"
    file.write_text(text, encoding="utf-8")
    return load_tried(file, overrides, allow_code=allow_code)


def problems(folder, text, *overrides):
    with pytest.raises(SpecError) as error:
        load(folder, text, *overrides)
    found = error.value.problems
    assert all(problem.file in (str(folder / "spec.yaml"), "--set") for problem in found)
    return found


def changed(text, *changes):
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text
