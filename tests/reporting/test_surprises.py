"""Deviations of results from theory: false alarm rate, and stated reasons."""

import re

import numpy as np
import pytest

from ctid_cli.reporting.surprises import surprises
from ctid_cli.simulation.expected_accuracy import expected_accuracy
from tests.reporting.ideal_results import estimate, plan_of, results_of

# The input changes between the samples; four settings, two estimators, three parameters.
SPEC = """\
experiment: study
system:      {numerator: [2], denominator: [1, 1], delay: 1.5}
excitation:  {kind: prbs, stages: 8, clock_period: 0.5}
sampling:    {kind: uniform_intervals, low: 0.05, high: 0.15, samples: [300, 400, 500, 600]}
noise:       {kind: white, variance: 0.1}
estimators:
  one:       {kind: td_srivc, poles: 1, zeros: 0, delay_bounds: [0, 4]}
  other:     {kind: delay_profile, poles: 1, zeros: 0, delay_bounds: [1, 2]}
starts:      {initial_delay: 0.5}
monte_carlo: {runs: 60, seed: 3}
"""


@pytest.fixture
def results(tmp_path):
    """Return results with the theoretical variances, errors ``change(errors)``, and standard errors times a factor."""

    def make(text=SPEC, seed=1, change=None, width=1.0):
        plan = plan_of(text, tmp_path)
        rng, found = np.random.default_rng(seed), {}
        for cell in plan.data_cells:
            theory = expected_accuracy(cell.source, plan.estimators[-1].estimator).parameters
            for part in plan.estimators:
                errors = rng.multivariate_normal(np.zeros(3), theory.covariance, plan.runs)
                if change is not None and part.name == "one":
                    errors = change(errors, theory.standard_errors)
                a1, b0, delay = (theory.values + errors).T
                widths = dict(zip(theory.names, width * theory.standard_errors, strict=True))
                found[part.name, cell.source.sampling.samples] = [
                    estimate(None, widths, numerator=[b0[k]], denominator=[1.0, a1[k]], delay=delay[k])
                    for k in range(plan.runs)
                ]
        made = results_of(plan, found, tmp_path)
        start = next(key.start for key in made.stored.results)
        for key in [key for key in made.stored.results if key.estimator_hash == plan.estimators[-1].hash]:
            made.stored.results[key._replace(start="none")] = made.stored.results.pop(key)
        assert start != "none"
        return made

    return make


def biased(errors, deviations):
    return errors + [0.0, 0.0, 2.0] * deviations


@pytest.mark.slow
def test_there_is_no_sentence_about_what_is_as_expected(results):
    # At a level of 5 %, three or more of twenty have a probability of 8 %.
    assert sum(bool(surprises(results(seed=seed))) for seed in range(20)) <= 2


def biased_gain(errors, deviations):
    return errors + [0.0, 2.0, 0.0] * deviations


SAMPLED = SPEC.replace("kind: uniform_intervals", "kind: uniform_intervals, input_record: sampled")
COLOURED = SPEC.replace("kind: white", "kind: arma, numerator: [1], denominator: [1, -0.8]").replace(
    "variance", "innovation_variance"
)
WRONG = SPEC.replace("delay_bounds: [0, 4]", "delay_bounds: [2, 4]").replace("delay: 0.5", "delay: 2.5")


@pytest.mark.parametrize(
    "given",
    [
        pytest.param({"text": SAMPLED, "change": biased}, id="input known at its samples"),
        pytest.param({"change": biased_gain}, id="no reason known"),
        pytest.param({"text": COLOURED, "width": 0.5}, id="standard errors for white noise"),
        pytest.param({"width": 1.6}, id="standard errors too large"),
        pytest.param({"text": WRONG, "change": biased}, id="wrong model"),
        pytest.param({"text": SPEC.replace("runs: 60", "runs: 40"), "change": biased}, id="too few data sets"),
    ],
)
def test_sentences(results, given, snapshot):
    # The numbers and the worst cases depend on random draws.
    found = (re.sub(r"\(\w+, samples [^)]*\)", "(case)", text) for text in surprises(results(**given)))
    assert [re.sub(r"[\d.]*\d", "#", text) for text in found] == snapshot


def test_without_the_code_that_a_specification_names_there_is_no_reason(results):
    made = results(change=biased)
    made.manifest["spec"]["estimators"]["one"]["kind"] = "./mine.py:Mine"
    (found,) = surprises(made)
    assert found.startswith("one, in 4 of 4 cells, at worst: biased by 2.")
    assert "RMSE" not in found
    assert found.endswith(")")
