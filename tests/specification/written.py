"""Specifications that tests write to a file, and what is wrong with them."""

import pytest

from ctid_cli.errors import SpecError
from ctid_cli.specification.load import load_spec


def load(folder, text, *overrides):
    file = folder / "spec.yaml"
    file.write_text(text, encoding="utf-8")
    return load_spec(file, overrides)


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
