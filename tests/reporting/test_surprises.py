"""What results show that theory does not expect: how often that is said of nothing, and with which reason."""

import numpy as np
import pytest

from ctid_cli.reporting.expected_accuracy import expected_accuracy
from ctid_cli.reporting.results import Group
from ctid_cli.reporting.surprises import Finding, _sentence, surprises
from ctid_cli.reporting.tables import build_tables
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
    """Results with the variances of theory, of errors ``change(errors)`` and standard errors wider by a factor."""

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


def test_nothing_is_said_of_what_is_as_expected(results):
    # At a level of 5 %, three or more of twenty have a probability of 8 %.
    assert sum(bool(surprises(results(seed=seed))) for seed in range(20)) <= 2


def test_a_bias_is_said_with_the_input_that_makes_it(results):
    sampled = SPEC.replace("kind: uniform_intervals", "kind: uniform_intervals, input_record: sampled")
    (found,) = surprises(results(sampled, change=biased))
    assert found.startswith("one, in 4 of 4 cells: biased by up to 2.")
    assert "standard errors (delay, samples " in found
    late, start = found.split(": ", 2)[2].split("; ")
    assert late == "the input is known only at its samples (sampling.input_record: sampled)"
    assert start == "the search for the delay can end at another minimum of the cost (starts.initial_delay)"
    # An input that is known has nothing to do with it.
    (found,) = surprises(results(change=lambda e, s: e + [0.0, 2.0, 0.0] * s))
    assert "(b0, samples " in found
    assert "the input" not in found
    assert "the search" not in found


def test_standard_errors_for_white_noise_are_said_to_be_that(results):
    coloured = SPEC.replace("kind: white", "kind: arma, numerator: [1], denominator: [1, -0.8]").replace(
        "variance", "innovation_variance"
    )
    (one, other) = surprises(results(coloured, width=0.5))
    assert one.startswith("one, in 4 of 4 cells: standard errors up to 2.")
    assert one.endswith("the noise is coloured (noise.kind: arma), and these standard errors are for white noise")
    assert "RMSE" not in one + other  # the theory of the estimates knows the noise
    assert [text.split(":")[1].split(",")[0][:16] for text in surprises(results(width=1.6))] == [" standard errors"] * 2


def test_a_wrong_model_is_the_reason_itself(results):
    wrong = SPEC.replace("delay_bounds: [0, 4]", "delay_bounds: [2, 4]").replace("delay: 0.5", "delay: 2.5")
    (found,) = surprises(results(wrong, change=biased))
    assert found.endswith("the delay is sought from 2 to 4 s and the true one is 1.5 s")


def test_without_the_code_that_a_specification_names_there_is_no_reason_but_what_is_seen(results):
    made = results(change=biased)
    made.manifest["spec"]["estimators"]["one"]["kind"] = "./mine.py:Mine"
    (found,) = surprises(made)
    assert found.startswith("one, in 4 of 4 cells: biased by up to 2.")
    assert "RMSE" not in found
    assert found.endswith(")")


def test_the_table_says_it(results, monkeypatch):
    made = results(change=biased)
    monkeypatch.setattr("ctid_cli.reporting.tables.find_results", lambda out, name: made)
    (report,) = build_tables(["study"], made.folder)
    assert report.notes[-1] == surprises(made)[0]
    few = results(SPEC.replace("runs: 60", "runs: 40"), change=biased)
    assert surprises(few) == []


@pytest.mark.parametrize(
    ("kind", "sizes", "worst"),
    [
        ("bias", [0.02, -1.4, 1.0], "biased by up to 1.4 standard errors (p1)"),
        ("width", [0.9, 0.5, 0.8], "standard errors up to 2 times too small (p1)"),
        ("width", [1.3, 1.9, 1.5], "standard errors up to 1.9 times too large (p1)"),
        ("coverage", [91.0, 60.0, 85.0], "coverage down to 60 % of 95 % (p1)"),
        ("rmse", [1.3, 4.0, 2.0], "RMSE up to 4 times theory (p1)"),
    ],
)
def test_the_worst_cell_is_that_of_its_kind(kind, sizes, worst):
    group = Group("cell", "one", (), "none")
    found = [Finding(group, {}, f"p{k}", kind, size, 0.0) for k, size in enumerate(sizes)]
    assert _sentence("one", [], found, {group}, []) == f"one: {worst}"
