"""``ctid accuracy``: the numbers of theory, the formula that they come from, and where there are none."""

import json
import re

import numpy as np
import pytest

from ctid_cli.inference.bounds import cramer_rao_bound, limiting_accuracy
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec

# The simulation examples of Gonzalez, Classens, Rojas, Welsh and Oomen, sections 6.1 and 6.2.
OPEN = """\
experiment: open
system:
  additive:
    - {numerator: [0.2], denominator: [0.0300105, 0.01020353, 1]}
    - {numerator: [3], denominator: [0.50135365, 0.25067683, 1]}
    - {numerator: [0.4], denominator: [0.09991907, 0.02997572, 1]}
    - {numerator: [0.05], denominator: [0.00999499, 0.00999499, 1]}
excitation:  {kind: gaussian}
sampling:    {kind: regular, interval: 0.05, samples: [2000, 7368, 100000]}
noise:       {kind: arma, numerator: [1, 0.5], denominator: [1, -0.85], innovation_variance: 0.02}
estimators:
  sum:       {kind: additive_srivc, terms: [TERM, TERM, TERM, TERM]}
  srivc:     {kind: srivc, poles: 8, zeros: 6}
monte_carlo: {runs: 2, seed: 1}
""".replace("TERM", "{poles: 2, zeros: 0}")
CLOSED = """\
experiment: closed
system:
  additive:
    - {numerator: [3], denominator: [0.25, 0.25, 1]}
    - {numerator: [1], denominator: [0.025, 0.01, 1]}
loop:        {controller: {pid: {kp: 0.0115, ki: 0.00725, kd: 0.00454}}, reference: {kind: gaussian}}
sampling:    {kind: regular, interval: 0.05, samples: [500, 19650]}
noise:       {kind: white, variance: 0.01}
estimators:
  sum:       {kind: additive_srivc, instruments: closed_loop, terms: [TERM, TERM]}
  direct:    {kind: srivc, poles: 4, zeros: 2}
  clsrivc:   {kind: srivc, poles: 4, zeros: 2, instruments: closed_loop}
monte_carlo: {runs: 2, seed: 1}
""".replace("TERM", "{poles: 2, zeros: 0}")
# One mode, small enough for all that is tried below.
ONE = """\
experiment: one
system:      {numerator: [2], denominator: [0.25, 0.7, 1], delay: 0.35}
excitation:  {kind: gaussian}
sampling:    {kind: regular, interval: 0.1, samples: 6000}
noise:       {kind: white, snr_db: 10}
estimators:
  known:     {kind: srivc, poles: 2, zeros: 0, delay: 0.35}
monte_carlo: {runs: 2, seed: 1}
"""
KNOWN = "{kind: srivc, poles: 2, zeros: 0, delay: 0.35}"
TWO_TERMS = "[{poles: 2, zeros: 0}, {poles: 2, zeros: 0}]"
TERM = "{poles: 2, zeros: 0}"
INTEGRATOR = ("terms: [{poles: 2, zeros: 0}", "terms: [{poles: 1, zeros: 0, integrators: 1}")

#: What is changed in a specification, or replaced by --set.
CASES = {
    "open loop, coloured noise": (OPEN, []),
    "closed loop": (CLOSED, []),
    "enters at the input": (CLOSED, [("reference: {kind: gaussian}", "reference: {kind: gaussian}, enters: input")]),
    "coloured noise in a loop": (CLOSED, [("kind: white", "kind: arma, numerator: [1], denominator: [1, -0.9]")]),
    "a shared table and a biased estimator": (
        ONE,
        [
            (f"{KNOWN}\n", f"{KNOWN}\n  again: {{kind: srivc, poles: 2, zeros: 0, delay: 0.35, max_iterations: 7}}\n"),
            ("estimators:\n", "estimators:\n  svf:  {kind: svf, poles: 2, zeros: 0}\n"),
            ("snr_db: 10", "snr_db: [5, 10]"),
        ],
    ),
    "an input of levels": (ONE, [("kind: gaussian", "kind: prbs, stages: 12, clock_period: 0.1")]),
    "an estimated delay": (ONE, [("srivc, poles: 2, zeros: 0, delay: 0.35", "td_srivc, poles: 2, zeros: 0, delay_bounds: [0, 2]")]),
    "bounds that are the delay": (
        ONE,
        [("srivc, poles: 2, zeros: 0, delay: 0.35", "delay_profile, poles: 2, zeros: 0, delay_bounds: [0.35, 0.35]")],
    ),
    "irregular clock, coloured noise": (
        ONE,
        [
            ("regular, interval: 0.1, samples: 6000", "uniform_intervals, low: 0.05, high: 0.15, samples: 4000"),
            ("white, snr_db: 10", "arma, numerator: [1], denominator: [1, -0.9], variance: 0.1"),
        ],
    ),
    "an integrator": (
        OPEN,
        [
            ("{numerator: [3], denominator: [0.50135365, 0.25067683, 1]}", "{numerator: [3], denominator: [2, 1], integrators: 1}"),
            INTEGRATOR,
            ("[2000, 7368, 100000]", "6000"),
        ],
    ),
    "an integrator in a loop": (
        CLOSED,
        [
            ("{numerator: [3], denominator: [0.25, 0.25, 1]}", "{numerator: [0.3], denominator: [0.3, 1], integrators: 1}"),
            INTEGRATOR,
            ("{kp: 0.0115, ki: 0.00725, kd: 0.00454}", "{kp: 0.5, kd: 0.5}"),
        ],
    ),
    "a fraction and its submodels": (
        ONE,
        [
            ("numerator: [2], denominator: [0.25, 0.7, 1]", "numerator: [3, 5], denominator: [1, 3, 2]"),
            (KNOWN, "{kind: srivc, poles: 2, zeros: 1, delay: 0.35}\n  sum: {kind: additive_srivc, terms: [{poles: 1, zeros: 0}, {poles: 1, zeros: 0}], delay: 0.35}"),
        ],
    ),
    "too few poles": (ONE, [("poles: 2", "poles: 1")]),
    "too many poles": (ONE, [("poles: 2", "poles: 3")]),
    "another delay for some": (ONE, [("zeros: 0, delay: 0.35", "zeros: 0, delay: [0.35, 0.4]")]),
    "bounds without the delay": (ONE, [("srivc, poles: 2, zeros: 0, delay: 0.35", "td_srivc, poles: 2, zeros: 0, delay_bounds: [0.5, 2]")]),
    "as many zeros as poles": (
        ONE,
        [("srivc, poles: 2, zeros: 0, delay: 0.35", "delay_profile, poles: 2, zeros: 2, delay_bounds: [0.35, 0.35]")],
    ),
    "submodels with too little room": (
        ONE,
        [("srivc, poles: 2, zeros: 0,", "additive_srivc, terms: [{poles: 1, zeros: 0}, {poles: 1, zeros: 0}],")],
    ),
    "no noise": (ONE, [("white, snr_db: 10", "white, standard_deviation: 0")]),
    "no section noise": (ONE, [("noise:       {kind: white, snr_db: 10}\n", "")]),
    "terms of other orders": (CLOSED, [(TWO_TERMS, "[{poles: 2, zeros: 0}, {poles: 1, zeros: 0}]")]),
    "too few terms": (CLOSED, [(TWO_TERMS, f"[{TERM}]")]),
    "terms in another order": (
        CLOSED,
        [("{numerator: [1], d", "{numerator: [0.1, 1], d"), (TWO_TERMS, "[{poles: 2, zeros: 1}, {poles: 2, zeros: 0}]")],
    ),
    "many lengths": (ONE, [("samples: 6000", "samples: [600, 6000, 7000, 8000, 9000, 10000, 20000]")]),
    "many settings": (ONE, [("snr_db: 10", "snr_db: [1, 2, 3, 4, 5, 6, 7, 8]")]),
}  # fmt: skip
#: Warnings about what these experiments do on purpose.
EXPECTED = re.compile("direct: ignores the loop|: is taken as |can only come near|do not hold the delay")


@pytest.fixture
def accuracy(ctid, tmp_path):
    """What the command prints of a specification with changes."""

    def call(content, changes=(), *options):
        for old, new in changes:
            assert content.count(old) == 1
            content = content.replace(old, new)
        (tmp_path / "spec.yaml").write_text(content, encoding="utf-8")
        done = ctid("accuracy", tmp_path / "spec.yaml", *options)
        assert all(EXPECTED.search(line) for line in done.stderr.splitlines())
        return json.loads(done.stdout)["estimates"] if options else done.stdout

    return call


@pytest.mark.parametrize("case", CASES)
def test_printed(accuracy, snapshot, case):
    assert accuracy(*CASES[case]) == snapshot


def errors(estimates, estimator, k=-1):
    """Standard errors of an estimator at one of the lengths, with the number of samples."""
    entry = [entry for entry in estimates if entry["estimator"] == estimator][k]
    return np.array([p["standard_error"] for p in entry["parameters"]]), entry["samples"]


def variances(estimates, estimator, letter, k=-1):
    """N times the variances of the parameters whose name ends so."""
    found, samples = errors(estimates, estimator, k)
    names = next(entry for entry in estimates if entry["estimator"] == estimator)["parameters"]
    return [samples * e**2 for e, p in zip(found, names, strict=True) if p["name"].endswith(letter)]


def test_the_printed_variances_of_the_paper(accuracy):
    found = accuracy(OPEN, (), "--json")
    for k in (1, 2):
        np.testing.assert_allclose(variances(found, "sum", "b0", k), [35.60, 2.700, 0.4405, 0.2240], rtol=3e-4)
    np.testing.assert_allclose(variances(found, "srivc", "b0"), [36.75, 3.645, 0.5341, 0.2322], rtol=3e-4)
    # Of short records from data sets, which is another way.
    ratios = np.array(variances(found, "sum", "b0", 0)) / variances(found, "sum", "b0")
    assert 1e-3 < np.abs(ratios - 1).max() < 0.4
    found = accuracy(CLOSED, (), "--json")
    np.testing.assert_allclose(variances(found, "sum", "a2"), [0.035010, 1.52180e-5], rtol=1e-4)
    np.testing.assert_allclose(variances(found, "clsrivc", "a2"), [0.090118, 2.49911e-5], rtol=1e-4)
    direct, closed = variances(found, "direct", "b0"), variances(found, "clsrivc", "b0")
    np.testing.assert_allclose(1.01 * np.array(direct), closed, rtol=1e-6)


def test_where_the_reference_enters(accuracy):
    plant = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
    controller = DiscreteController.from_pid(0.0115, 0.00725, 0.00454)
    signals = {"standard_deviation": 1.0, "innovation_variance": 0.01, "samples": 19650, "enters": "input"}
    expected = limiting_accuracy(plant, 0.05, controller, **signals).standard_errors
    np.testing.assert_allclose(errors(accuracy(*CASES["enters at the input"], "--json"), "sum")[0], expected)


def test_different_ways_to_the_same_numbers(accuracy, tmp_path):
    """A bound averaged over data sets; white noise of another kind; as many parameters in both forms."""
    found, _ = errors(accuracy(*CASES["an estimated delay"], "--json"), "known")
    bounds = []
    plan = build_plan(load_spec(tmp_path / "spec.yaml"))
    for replicate in range(3):
        record = plan.data_cells[0].dataset(replicate).record
        level = np.sqrt(np.mean(record.noise_free**2) / 10)
        bounds.append(cramer_rao_bound(TransferFunction([2.0], [0.25, 0.7, 1.0], 0.35), record, level, 2.0))
    np.testing.assert_allclose(found, np.sqrt(np.diag(np.mean(bounds, axis=0))), rtol=1e-6)
    limit, levels = (
        errors(accuracy(*CASES[case], "--json"), "known")[0] for case in ("many lengths", "an input of levels")
    )
    np.testing.assert_allclose(limit * np.sqrt(20000 / 6000), levels, rtol=0.05)
    both = accuracy(*CASES["a fraction and its submodels"], "--json")
    np.testing.assert_allclose(errors(both, "known")[0], errors(both, "sum")[0])
