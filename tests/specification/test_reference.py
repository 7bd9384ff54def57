"""The reference has the description of every key from the option classes and sections."""

import re
from dataclasses import MISSING, fields

import pytest

from ctid_cli.errors import UsageError
from ctid_cli.kinds import KINDS, classes
from ctid_cli.specification.reference import reference_text
from ctid_cli.specification.spec import Spec


@pytest.mark.parametrize("name", KINDS)
def test_every_option_is_there_with_its_default(name):
    for kind, target in classes(name).items():
        text = reference_text(kind)
        said = set(re.findall(r"^ *(\w+): [^;\n]*; (required|optional|default [^\n]*)$", text, re.MULTILINE))
        for option in fields(target):
            if option.init and option.default is MISSING:
                assert (option.name, "required") in said
            elif option.init and option.default is None:
                assert (option.name, "optional") in said
            elif option.init and isinstance(option.default, (int, str, float)):
                default = str(option.default).lower() if isinstance(option.default, bool) else option.default
                assert (option.name, f"default {default}") in said


def test_every_section_is_there_and_fits_a_terminal():
    text = reference_text()
    assert [line.partition(":")[0] for line in text.splitlines()[4:] if re.match(r"\w", line)] == list(
        Spec.model_fields
    )
    assert max(map(len, text.splitlines())) <= 100
    for name in Spec.model_fields:
        assert reference_text(name) in text


def test_types_units_and_choices_in_words():
    text = reference_text("td_srivc")
    assert "    delay_bounds: list of 2 numbers [s]; required\n        Least and greatest delay. " in text
    assert "    variant: plain | guarded (or a list); default guarded\n" in text
    assert "        cutoff: number [rad/s] (or a list); required\n" in text  # of its low-pass filter
    assert "svf: " not in text
    assert "    runs: whole number at least 1, at most 1000000; optional\n" in reference_text("monte_carlo")
    # A column of times is text, not a number of seconds.
    assert "    time: text; default t\n        Column of the instants [s].\n" in reference_text("data")
    assert "null for a new value" in reference_text("gaussian")


def test_a_kind_of_several_sections_is_shown_in_each():
    assert re.findall(r"^(\w+):", reference_text("white"), re.MULTILINE) == ["disturbance", "noise"]


def test_what_is_not_there():
    with pytest.raises(UsageError, match="did you mean 'sampling'"):
        reference_text("samplings")
    with pytest.raises(UsageError, match="sections: experiment, system"):
        reference_text("qqq")
