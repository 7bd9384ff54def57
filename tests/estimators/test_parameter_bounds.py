"""Bounds of parameters: estimates inside and at the bounds, and refused bounds."""

import numpy as np
import pytest
from scipy.optimize import minimize

from ctid_cli import (
    Bound,
    DelayProfile,
    FrequencyData,
    FrequencyDomain,
    HeldSignal,
    InputModel,
    Record,
    TransferFunction,
    identify,
    simulate,
)
from ctid_cli.errors import OptionError
from ctid_cli.estimation.common import Fixed
from ctid_cli.identification.fit_warnings import of_search
from ctid_cli.inference.fit import Status

T = 0.1 * np.arange(400)
SYSTEMS = {1: TransferFunction([2.0], [1.0, 0.8]), 2: TransferFunction([4.0], [1.0, 0.8, 2.0])}


def record_of(order: int, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 10)
    y = simulate(SYSTEMS[order], HeldSignal(T, u), T)
    return Record(T, y + 0.2 * rng.standard_normal(T.size), {"u": u})


def fitted(order, *bounds, record=None, **options):
    return DelayProfile(order, 0, (0.0, 0.0), bounds=bounds, **options).fit(record or record_of(order))


#: Bounded parameters, and the coefficients left free by a bound at its value.
FORMS = {
    (1, "gain"): lambda value, x: ([value * x[0]], [1.0, x[0]]),
    (1, "time_constant"): lambda value, x: ([x[0]], [1.0, 1.0 / value]),
    (2, "gain"): lambda value, x: ([value * x[1]], [1.0, x[0], x[1]]),
    (2, "damping"): lambda value, x: ([x[0]], [1.0, 2.0 * value * np.sqrt(x[1]), x[1]]),
}
BOUNDS = {"gain": (2.6, 3.0), "time_constant": (0.5, 1.0), "damping": (0.1, 0.2)}


@pytest.mark.parametrize(("order", "kind"), FORMS)
def test_the_estimate_at_a_bound_is_the_least_of_the_models_that_have_it(order, kind):
    record, (low, high) = record_of(order), BOUNDS[kind]
    fit = fitted(order, Bound(kind, low, high))
    end = low if kind == "gain" else high
    form = FORMS[order, kind]

    def cost(x):
        return np.mean((record.y - simulate(TransferFunction(*form(end, x)), record.input, T)) ** 2)

    start = {"time_constant": [2.0]}.get(kind, [0.8] if order == 1 else [4.0, 2.0] if kind == "damping" else [0.8, 2.0])
    least = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-14})
    assert fit.cost == pytest.approx(least.fun, rel=1e-8)
    assert fit.status is Status.AT_BOUND
    assert fit.bounds_met == ((kind, end),)
    np.testing.assert_allclose(
        [*fit.model.numerator, *fit.model.denominator], np.concatenate(form(end, least.x)), rtol=1e-4
    )


def test_a_bound_that_the_estimate_is_within_changes_nothing():
    free, within = fitted(2), fitted(2, Bound("damping", 0.05, 0.9), Bound("b0", 1.0, 9.0))
    assert within.theta == pytest.approx(free.theta, rel=1e-7)
    np.testing.assert_allclose(within.covariance, free.covariance, rtol=1e-6)
    assert (within.status, within.bounds_met) == (Status.CONVERGED, ())


def test_a_coefficient_at_its_bound_is_one_that_is_fixed_there():
    bounded, fixed = fitted(2, Bound("a1", 1.0, 2.0)), fitted(2, fixed=(Fixed("a1", 1.0),))
    np.testing.assert_allclose(bounded.theta, fixed.theta, rtol=1e-8)
    np.testing.assert_allclose(bounded.covariance, fixed.covariance, rtol=1e-6, atol=1e-12)
    assert (bounded.known, fixed.known) == ((), ("a1",))


@pytest.mark.slow
def test_a_parameter_at_its_bound_is_reported():
    found = identify(record_of(2), DelayProfile(2, 0, (0.0, 0.0), bounds=(Bound("a1", 1.0, 2.0),)))
    assert {item.name: item.status for item in found.estimates}["a1"] == "at bound"
    assert next(of_search(found.fit, "s")).startswith("At the given bound: a1 = 1;")


def test_errors_of_the_others_hold_along_the_bound():
    fit = fitted(2, Bound("gain", 2.6, 3.0))
    a2, b0 = fit.parameters["a2"], fit.parameters["b0"]
    slope = np.array([0.0, -b0 / a2**2, 1.0 / a2])
    assert abs(slope @ fit.covariance @ slope) < 1e-12
    assert (np.diag(fit.covariance) > 0.0).all()


def test_of_several_bounds_those_that_are_needed_are_met():
    fit = fitted(2, Bound("gain", 2.6, 3.0), Bound("damping", 0.1, 0.2), Bound("b0", 0.1, 100.0))
    assert dict(fit.bounds_met) == {"gain": 2.6, "damping": 0.2}
    assert fit.model.dc_gain == pytest.approx(2.6, rel=1e-9)


def test_bounds_of_one_input_and_of_its_delay():
    rng = np.random.default_rng(3)
    u1, u2 = np.repeat(rng.choice([-1.0, 1.0], (2, 40)), 10, axis=1)
    y = simulate(SYSTEMS[1], HeldSignal(T, u1), T) + simulate(SYSTEMS[1], HeldSignal(T, u2), T)
    record = Record(T, y + 0.1 * rng.standard_normal(T.size), {"u1": u1, "u2": u2})
    inputs = InputModel("u1", delay_bounds=(0.0, 0.0)), InputModel("u2", delay_bounds=(0.0, 2.0))
    bounds = Bound("u2_gain", 1.0, 2.0), Bound("u2_delay", 0.35, 5.0)
    fit = DelayProfile(1, 0, (0.0, 0.0), inputs=inputs, bounds=bounds).fit(record)
    assert dict(fit.bounds_met) == {"u2_gain": 2.0}
    assert (fit.model.parts["u2"].dc_gain, fit.model.parts["u2"].delay) == pytest.approx((2.0, 0.35))
    assert fit.status is Status.AT_BOUND


def test_a_frequency_response_is_fitted_within_bounds():
    w = np.geomspace(0.1, 10.0, 50)
    data = FrequencyData(w, 2.0 / (1j * w + 1.0))
    fit = FrequencyDomain(1, 0, bounds=(Bound("time_constant", 1.2, 2.0),)).fit(data)
    assert fit.parameters["a1"] == pytest.approx(1.0 / 1.2)
    assert fit.bounds_met == (("time_constant", 1.2),)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"poles": 4, "bounds": (Bound("damping", 0.1, 0.5),)},
            "with 2 poles, and this model has 4",
        ),
        ({"poles": 3, "bounds": (Bound("gain", 0.1, 0.5),)}, "gain can be bounded with 1 pole or 2 poles"),
        ({"bounds": (Bound("K", 0.1, 0.5),)}, "there is no 'K' to bound; there are a1, a2, b0, gain"),
        ({"bounds": (Bound("a1", -1.0, 0.5),)}, "lower bound of a1 must be above zero"),
        ({"bounds": (Bound("a1", 1.0, 2.0),), "fixed": (Fixed("a1", 1.5),)}, "of its coefficients one is fixed"),
        ({"bounds": (Bound("a1", 1.0, 2.0),), "loss": "huber"}, "parameters are bounded with loss squares"),
        ({"bounds": (Bound("a1", 1.0, 2.0), Bound("a1", 1.0, 3.0))}, "bounded twice"),
        ({"bounds": (Bound("delay", 1.0, 2.0),)}, "no delay is within its bounds"),
        ({"bounds": (Bound("gain", 1.0, 2.0),), "integrators": 1}, "gain has no bounds with integrators"),
    ],
)
def test_what_cannot_be_bounded_is_refused(options, message):
    with pytest.raises(OptionError, match=message):
        DelayProfile(**{"poles": 2, "zeros": 0, "delay_bounds": (0.0, 0.0), **options})
