"""What is said before a run about a design that cannot give what is asked for."""

import re

import pytest

from ctid_cli.specification.load import load_spec

GOOD = """\
experiment: one
system: {numerator: [2], denominator: [0.25, 0.7, 1], delay: 8.0}
excitation: {kind: prbs, stages: 10, clock_period: 0.5}
sampling: {kind: regular, interval: 0.05, samples: 400}
noise: {kind: white, snr_db: 15}
estimators:
  known: {kind: srivc, poles: 2, zeros: 0, delay: 8}
  searched: {kind: delay_profile, poles: 2, zeros: 0, delay_bounds: [0, 15]}
monte_carlo: {runs: 1, seed: 1}
"""

SUM = "{additive: [{numerator: [3], denominator: [0.25, 0.25, 1]}, {numerator: [1], denominator: [0.025, 0.01, 1]}]}"
IRREGULAR = "sampling={kind: uniform_intervals, low: 0.01, high: 0.09, samples: %d, input_record: %s}"


@pytest.fixture
def warnings(tmp_path):
    """Warnings about GOOD with other values, without the name of the file."""

    def load(*overrides):
        file = tmp_path / "spec.yaml"
        file.write_text(GOOD, encoding="utf-8")
        return [warning.removeprefix(f"{file}:") for warning in load_spec(file, overrides).warnings]

    return load


def test_standard_errors_for_white_noise_in_coloured_noise(warnings):
    coloured = "noise={kind: arma, numerator: [1.0], denominator: [1.0, -0.9], snr_db: 15}"
    assert warnings(coloured) == []
    (said,) = warnings(coloured, "estimators.searched.covariance=white")
    assert "estimators.searched.covariance: is for white noise" in said
    assert warnings("estimators.searched.covariance=white") == []


def test_nothing_is_said_of_what_is_right(warnings):
    assert warnings() == []
    assert warnings(IRREGULAR % (400, "exact")) == []
    # Edges every 0.15 s and samples every 0.05 s: products that differ in the last bit are one instant.
    assert warnings("excitation.clock_period=0.15") == []
    # Parts may be larger than needed.
    assert warnings("estimators.known.poles=3", "estimators.known.zeros=1") == []


def test_a_delay_that_is_not_estimated(warnings):
    (said,) = warnings("estimators.known.delay=0")
    assert said.startswith("--set:1:24: estimators.known.delay: ")
    assert "taken as 0 s and the system has 8 s" in said
    assert "write delay: 8 or, to estimate it, use kind: delay_profile" in said
    (said,) = warnings("system.delay=[2, 8]")
    assert "has 2 s" in said
    assert said.endswith("(with system.delay = 2.0)")


def test_the_place_is_that_of_the_estimator_where_no_delay_is_given(tmp_path):
    file = tmp_path / "spec.yaml"
    file.write_text(GOOD.replace(", delay: 8}", "}"), encoding="utf-8")
    (said,) = load_spec(file).warnings
    assert said.startswith(f"{file}:7:3: estimators.known.delay: is taken as 0 s")


def test_bounds_that_do_not_hold_the_delay(warnings):
    (said,) = warnings("estimators.searched.delay_bounds=[0, 5]")
    assert "estimators.searched.delay_bounds: [0, 5] s do not hold the delay of the system, 8 s" in said
    assert warnings("estimators.searched.delay_bounds=[8, 8]") == []


def test_a_record_that_is_too_short(warnings):
    # Both poles at 2 rad/s: 3 time constants of 0.5 s after 8 s.
    near = "estimators.searched.delay_bounds=[7, 8.5]"
    enough = int(re.search(r"write samples: (\d+) or more", *warnings(near, "sampling.samples=180"))[1])
    assert (enough - 1) * 0.05 == pytest.approx(9.5)
    assert warnings(near, f"sampling.samples={enough}") == []
    assert "sampling.samples" in warnings(near, f"sampling.samples={enough - 1}")[0]
    # A lightly damped mode shows within its period, and an integrator is no slow pole.
    beam = "system={additive: [{numerator: [1], denominator: [0.25, 0.001, 1]}, {numerator: [1], denominator: [1],"
    terms = "terms: [{poles: 2, zeros: 0}, {poles: 0, zeros: 0, integrators: 1}]"
    known = f"estimators={{known: {{kind: additive_srivc, {terms}}}}}"
    assert warnings(beam + " integrators: 1}]}", known) == []


def test_a_model_that_cannot_be_the_system(warnings):
    (said,) = warnings("estimators.known.poles=1")
    assert "estimators.known.poles: the system has 2 poles and this model 1" in said
    (said,) = warnings("system.numerator=[1, 2]", "estimators.known.zeros=1")
    assert "estimators.searched.zeros: the system has 1 zero and" in said


def test_sums_are_compared_as_one_fraction(warnings):
    """Of the true system both numbers of zeros are those of its fraction."""
    terms = "terms: [{poles: 2, zeros: 0}, {poles: 2, zeros: 0}]"
    sums = f"estimators={{sum: {{kind: additive_srivc, {terms}}}, one: {{kind: srivc, poles: 4, zeros: 2}}}}"
    assert warnings(f"system={SUM}", sums) == []
    (said,) = warnings(f"system={SUM}", sums, "estimators.one.zeros=1")
    assert "estimators.one.zeros: the system has 2 zeros" in said
    (said,) = warnings(f"system={SUM}", sums, "estimators.sum.terms=[{poles: 2, zeros: 0}]")
    assert "estimators.sum.terms: the system has 4 poles" in said


def test_an_input_that_is_known_at_its_samples_only(warnings):
    """Each edge waits for the end of the interval it falls in: E[T^2] / 2 E[T], long intervals catch more edges."""
    (said,) = warnings(IRREGULAR % (40_000, "sampled"))
    expected = (0.05**2 + 0.08**2 / 12) / (2 * 0.05)
    # Some 1000 edges, each late by up to 0.09 s with a standard deviation of 0.02 s; shown with two digits.
    assert float(re.search(r"each change (\S+) s late", said)[1]) == pytest.approx(expected, abs=0.002)
    assert "sampling.input_record" in said
    assert "write input_record: exact" in said


def test_edges_between_the_samples_of_a_regular_clock(warnings):
    # Edges at multiples of 0.24 s, samples at those of 0.05 s: late by 0, 0.01, ... 0.04 s, each as often.
    (said,) = warnings("excitation.clock_period=0.24", "sampling.samples=40000")
    assert float(re.search(r"each change (\S+) s late", said)[1]) == pytest.approx(0.02, abs=0.0011)
    assert warnings("excitation.clock_period=0.24", "sampling.input_record=exact") == []
    assert warnings("excitation={kind: gaussian}") == []


def test_samples_that_the_output_asks_for_never_come_with_the_edges(warnings):
    sent = "sampling={kind: send_on_delta, interval: 0.05, samples: 400, delta: 0.1, input_record: %s}"
    (said,) = warnings(sent % "sampled")
    assert "each change not before the next one" in said
    assert warnings(sent % "exact") == []
