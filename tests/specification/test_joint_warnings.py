"""Warnings before a run about designs that cannot give the requested result."""

import re

import pytest

from ctid_cli.specification.load import load_spec
from tests.specification.written import OPEN_LOOP

IRREGULAR = "sampling={kind: uniform_intervals, low: 0.01, high: 0.09, samples: %d, input_record: %s}"


@pytest.fixture
def warnings(tmp_path):
    """Return the warnings about OPEN_LOOP with other values, without the name of the file."""

    def load(*overrides):
        file = tmp_path / "spec.yaml"
        file.write_text(OPEN_LOOP, encoding="utf-8")
        return [warning.removeprefix(f"{file}:") for warning in load_spec(file, overrides).warnings]

    return load


def test_an_input_that_is_known_at_its_samples_only(warnings):
    """Each edge is delayed to the end of its interval: E[T^2] / 2 E[T], since long intervals contain more edges."""
    (said,) = warnings(IRREGULAR % (40_000, "sampled"))
    expected = (0.05**2 + 0.08**2 / 12) / (2 * 0.05)
    # About 1000 edges, each late by up to 0.09 s with a standard deviation of 0.02 s; printed with two digits.
    assert float(re.search(r"each change (\S+) s late", said)[1]) == pytest.approx(expected, abs=0.002)
    assert "sampling.input_record" in said
    assert "write input_record: exact" in said


def test_edges_between_the_samples_of_a_regular_clock(warnings):
    # Edges at multiples of 0.24 s, samples at multiples of 0.05 s: late by 0, 0.01, ... 0.04 s, equally often.
    (said,) = warnings("excitation.clock_period=0.24", "sampling.samples=40000")
    assert float(re.search(r"each change (\S+) s late", said)[1]) == pytest.approx(0.02, abs=0.0011)
    assert warnings("excitation.clock_period=0.24", "sampling.input_record=exact") == []
    assert warnings("excitation={kind: gaussian}") == []


def test_a_data_set_that_cannot_be_made_and_was_not_tried(warnings):
    (said,) = warnings("excitation={kind: step, time: 1e6}", "sampling.input_record=sampled")
    assert "excitation: the step at 1e+06 s comes too late" in said
    assert said.endswith("estimates of such data sets are stored as FAILED")
