"""Known parameters, against fits of the reduced problem by SciPy on exact simulation."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ctid_cli.estimation.common import Fixed
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.filtering.simulate import simulate, simulate_additive
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([1.0, 3.0], [1.0, 1.2, 4.0], 0.73)


def record_of(n=400, noise=0.1, seed=0, offset=0.0):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 4), 4)
    y = simulate(SYSTEM, HeldSignal(t, u), t) + offset + noise * rng.standard_normal(n)
    return Record.from_arrays(t, u, y)


def reduced(record, fixed, start, offset=False):
    """Fit the parameters that are not fixed: b0, b1, a1, a2, delay and the offset."""
    names = ["b0", "b1", "a1", "a2", "delay"] + ["offset"] * offset
    free = [name for name in names if name not in fixed]

    def residual(values):
        p = {**dict(zip(free, values, strict=True)), **fixed}
        model = TransferFunction([p["b0"], p["b1"]], [1.0, p["a1"], p["a2"]], max(p["delay"], 0.0))
        return simulate(model, record.input, record.t) + p.get("offset", 0.0) - record.y

    found = least_squares(residual, [start[name] for name in free], xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    return dict(zip(free, found.x, strict=True)), 2 * found.cost / record.n_samples


TRUTH = {"b0": 1.0, "b1": 3.0, "a1": 1.2, "a2": 4.0, "delay": 0.73, "offset": 0.4}


@pytest.mark.parametrize(
    ("fixed", "delay"), [({"a1": 1.2}, (0.73, 0.73)), ({"a1": 2.0, "b0": 0.5}, (0.0, 2.0)), ({"b1": 3.3}, (0.0, 2.0))]
)
def test_a_known_coefficient_leaves_the_least_of_the_reduced_problem(fixed, delay):
    record = record_of()
    known = dict(fixed) if delay[0] < delay[1] else {**fixed, "delay": 0.73}
    expected, cost = reduced(record, known, TRUTH)
    fit = DelayProfile(2, 1, delay, fixed=tuple(Fixed(*pair) for pair in fixed.items())).fit(record)
    assert fit.status.succeeded
    assert fit.cost == pytest.approx(cost, rel=1e-8)
    assert {name: fit.parameters[name] for name in expected} == pytest.approx(expected, rel=1e-4)
    for name, value in fixed.items():
        assert fit.parameters[name] == value
        assert np.isnan(fit.standard_errors[name])
    assert all(np.isfinite(fit.standard_errors[name]) for name in expected)


SUM = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])


@pytest.mark.parametrize(
    "fixed", [{"g1_b0": 3.0}, {"g1_a2": 0.026, "g2_b0": 2.9}, {"g1_a1": 0.01, "g1_a2": 0.025, "g1_b0": 1.0}]
)
def test_known_parameters_of_submodels(fixed):
    """A name refers to the submodel that matches its value; all parameters of a submodel may be known."""
    rng = np.random.default_rng(2)
    t = 0.05 * np.arange(600)
    u = HeldSignal(t, rng.standard_normal(600))
    record = Record(t, simulate_additive(SUM, u, t) + 0.1 * rng.standard_normal(600), u)
    terms = (Term(2, 0), Term(2, 0))
    fit = AdditiveSrivc(terms, covariance="white", fixed=tuple(Fixed(*pair) for pair in fixed.items())).fit(record)
    names, theta = list(fit.additive.names), fit.additive.theta
    free = [k for k, name in enumerate(names) if name not in fixed]

    def residual(values):
        trial = theta.copy()
        trial[free] = values
        return simulate_additive(AdditiveModel.from_theta(trial, terms), u, t) - record.y

    best = least_squares(residual, 1.001 * theta[free], x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert fit.status.succeeded
    assert fit.cost == pytest.approx(2 * best.cost / 600, rel=1e-8)
    assert theta[free] == pytest.approx(best.x, rel=1e-5)
    assert {name: fit.parameters[name] for name in fixed} == fixed
    information = best.jac.T @ best.jac / (2 * best.cost / (600 - len(free)))
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    assert [fit.standard_errors[names[k]] for k in free] == pytest.approx(errors, rel=1e-3)


@pytest.mark.parametrize(
    ("fixed", "said"),
    [
        ((Fixed("a3", 1.0),), "there is no parameter 'a3'"),
        ((Fixed("a1", 1.0), Fixed("a1", 2.0)), "fixed twice"),
        ((Fixed("delay", 1.0),), "a known delay is given as such"),
        ((Fixed("a1", 1.0), Fixed("a2", 1.0), Fixed("b0", 1.0)), "nothing to estimate"),
        ((Fixed("a2", 0.0),), "fixed a2 must be above zero"),
    ],
)
def test_what_cannot_be_fixed_is_refused(fixed, said):
    with pytest.raises(ValueError, match=said):
        DelayProfile(2, 0, (0.0, 1.0), fixed=fixed)
