"""Responses of estimated models: exact derivatives, bands that cover, and models for other tools."""

import re

import control
import numpy as np
import pytest

from ctid_cli import AdditiveModel, HeldSignal, Submodel, TransferFunction
from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimators.additive_srivc import AdditiveFit
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.inference.sensitivities import Parametric

NUMBERS = (Status.CONVERGED, 0.1, 90.0, 0.99, 100, 3, 12.0)
T = np.linspace(0.0, 10.0, 101)
IRREGULAR = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.18, 100))
W = np.geomspace(0.1, 20.0, 30)
SIGNAL = HeldSignal(np.arange(0.0, 10.0, 0.37), np.random.default_rng(0).standard_normal(28))
FOH = HeldSignal(SIGNAL.t, SIGNAL.values, "foh")
SECOND = TransferFunction([2.0, 1.0], [1.0, 0.8, 2.0], 0.333)
SUM = AdditiveModel([Submodel([3.0, 1.0], [0.25, 0.25, 1.0]), Submodel([0.3], [1.0], 2)], 0.333)
BODY = AdditiveModel([Submodel([0.2, 0.4], [0.3, 1.0], 1), Submodel([2.0], [1.0])], 0.02)
MODELS = {
    "fraction": (SECOND, ("a1", "a2", "b0", "b1", "delay")),
    "leading zero": (TransferFunction([1.0], [1.0, 0.8, 2.0], 0.333), ("a1", "a2", "b0", "b1", "delay")),
    "integrator, held": (TransferFunction([2.0, 1.0], [1.0, 0.8, 0.0], 0.333), ("a1", "b0", "b1", "delay", "x1")),
    "biproper": (TransferFunction([0.5, 2.0, 1.0], [1.0, 0.8, 2.0], 0.333), ("a1", "a2", "b0", "b1", "b2")),
    "gain": (TransferFunction([2.0], [1.0], 0.5), ("b0",)),
    "sum": (SUM, (*SUM.names, "delay")),
    "sum, gain": (BODY, BODY.names),
    "sum, held": (SUM, ("g1_a1", "g1_b1", "g2_b0")),
}


def central(parametric, answer, step=1e-6):
    """Return derivatives by central differences, zero for parameters outside the model."""
    mine, places = parametric.free
    found = np.zeros((answer(parametric).size, len(parametric.names)), dtype=answer(parametric).dtype)
    for k, place in zip(mine, places, strict=True):
        change = np.zeros(mine.size)
        size = step * max(abs(parametric.theta[place]), 1e-2)
        change[list(mine).index(k)] = size
        found[:, k] = (answer(parametric.at(change)) - answer(parametric.at(-change))) / (2 * size)
    return found


def same(one, other):
    return np.abs(one - other).max() <= 1e-7 * np.abs(other).max()


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_are_exact(name):
    parametric = Parametric(*MODELS[name])
    assert same(parametric.frequency_slopes(W), central(parametric, lambda one: one.model.frequency_response(W)))
    for signal, t in ((SIGNAL, T), (FOH, T), (SIGNAL, IRREGULAR), (FOH, IRREGULAR)):
        slopes = parametric.output_slopes(signal, t)
        assert same(slopes, central(parametric, lambda one, s=signal, t=t: one.simulated(s, t)))
    if name not in ("biproper", "gain", "sum, gain"):
        behind, step = parametric.derivative, HeldSignal([0.0], [1.0])
        assert same(behind.output_slopes(step, T), central(behind, lambda one: one.simulated(step, T)))
        h = 1e-5
        slope = (parametric.simulated(step, T + h) - parametric.simulated(step, T - h)) / (2 * h)
        away = np.abs(T - 0.333) > 0.05
        np.testing.assert_allclose(behind.simulated(step, T)[away], slope[away], atol=1e-7)


@pytest.mark.parametrize("name", ["fraction", "sum"])
def test_derivatives_of_poles_are_exact(name):
    parametric = Parametric(*MODELS[name])
    poles, slopes = parametric.poles()
    np.testing.assert_allclose(slopes, central(parametric, lambda one: one.poles()[0]), rtol=1e-7, atol=1e-9)
    assert poles.size == parametric.model.order


def fitted(model=SECOND, names=("a1", "a2", "b0", "b1", "delay"), deviation=0.01, covariance=None):
    rng = np.random.default_rng(3)
    if covariance is None:
        half = deviation * rng.standard_normal((len(names), 2 * len(names)))
        covariance = half @ half.T / (2 * len(names))
    if isinstance(model, AdditiveModel):
        own = {"additive": model, "start": model, "start_method": "", "loop_radius": np.nan}
        return AdditiveFit(Parametric(model, names).fraction, names, covariance, *NUMBERS, **own)
    return Fit(model, names, covariance, *NUMBERS)


def test_linear_and_sampled_bands_agree_where_the_model_is_nearly_linear():
    fit = fitted(deviation=1e-3)
    for ask in ("step_response", "impulse_response"):
        t = np.array([1.0, 2.0, 5.0])
        one, other = getattr(fit, ask)(t), getattr(fit, ask)(t, bands="sampled")
        np.testing.assert_allclose(other.upper - other.lower, one.upper - one.lower, rtol=0.15)
        np.testing.assert_array_equal(one.value, other.value)
    one, other = fit.frequency_response(W), fit.frequency_response(W, bands="sampled")
    np.testing.assert_allclose(other.gain_upper - other.gain_lower, one.gain_upper - one.gain_lower, rtol=0.15)
    np.testing.assert_allclose(other.phase_upper - other.phase_lower, one.phase_upper - one.phase_lower, rtol=0.15)
    one, other = fit.simulate(SIGNAL, level=0.5), fit.simulate(SIGNAL, level=0.5, bands="sampled")
    wide = one.upper - one.lower
    np.testing.assert_allclose(other.upper - other.lower, wide, atol=0.15 * wide.max())
    assert fit.step_response([2.0], level=0.5).upper < fit.step_response([2.0]).upper


def test_what_is_held_is_known_and_what_is_not_defined_is_nan():
    held = np.diag([1e-6, np.nan, 1e-6, 1e-6, np.nan])
    held[1] = held[:, 1] = held[4] = held[:, 4] = np.nan
    known = fitted(names=("a1", "b0", "b1"), covariance=1e-6 * np.eye(3))
    np.testing.assert_allclose(
        fitted(covariance=held).step_response().standard_error, known.step_response().standard_error
    )
    unknown = fitted(covariance=np.full((5, 5), np.nan))
    for bands in ("linearised", "sampled"):
        assert np.isnan(unknown.step_response(bands=bands).lower).all()
        assert np.isnan(unknown.frequency_response(bands=bands).phase_upper).all()
        assert np.isfinite(unknown.simulate(SIGNAL, bands=bands).value).all()
    assert np.isnan(unknown.poles().standard_error).all()


def test_indistinguishable_poles_have_no_standard_error():
    fit = fitted(TransferFunction([1.0], [1.0, 2.001, 1.001]), ("a1", "a2", "b0"), covariance=1e-4 * np.eye(3))
    assert np.isnan(fit.poles().standard_error).all()
    single = fitted(TransferFunction([1.0], [1.0, 2.0]), ("a1", "b0"), covariance=np.eye(2)).poles()
    assert (single.lower.real[0], single.upper.real[0]) == pytest.approx((-2 - 1.96, -2 + 1.96), abs=1e-3)


def test_the_phase_is_continuous_whatever_the_order_of_the_frequencies():
    fit = fitted(TransferFunction([-1.0, 3.0], [1.0, 0.1, 4.0, 0.0], 5.0), ("b0",), covariance=np.eye(1))
    grid = np.linspace(0.01, 30.0, 20000)
    phase = fit.frequency_response(grid).phase
    assert np.abs(np.diff(phase)).max() < 0.2
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * np.angle(fit.model.frequency_response(grid))))
    np.testing.assert_array_equal(fit.frequency_response(grid[::-1]).phase, phase[::-1])


def test_bad_questions_are_refused():
    fit = fitted()
    for call, message in (
        (lambda: fit.step_response(level=95), "between 0 and 1"),
        (lambda: fit.step_response(bands="drawn"), "'linearised' or 'sampled'"),
        (lambda: fit.step_response([1.0, 0.0]), "increase"),
        (lambda: fit.frequency_response([-1.0]), "none below zero"),
        (lambda: fitted(TransferFunction([1.0, 1.0], [1.0, 2.0]), ("b0",)).impulse_response(), "as many zeros"),
        (lambda: fitted(names=("a3",)).step_response(), "no parameter 'a3'"),
        (lambda: fit.to_matlab("1G"), "a letter"),
        (lambda: fit.to_matlab(kind="ss"), "idtf or tf"),
        (lambda: fit.to_matlab(time_unit="fortnight"), "no unit of time"),
        (lambda: fit.to_control(0), "at least 1"),
    ):
        with pytest.raises((DataError, UsageError), match=message):
            call()


@pytest.mark.parametrize("name", ["fraction", "integrator, held", "sum"])
def test_models_come_back_from_other_tools(name):
    model, names = MODELS[name]
    fit = fitted(model, names)
    for system, delay in (fit.to_control(), fit.to_scipy()):
        b, a = (
            (np.ravel(part[0][0]) for part in (system.num, system.den))
            if isinstance(system, control.TransferFunction)
            else (system.num, system.den)
        )
        back = TransferFunction(b, a, delay)
        np.testing.assert_allclose(back.frequency_response(W), model.frequency_response(W), rtol=1e-12)
        np.testing.assert_allclose(back.denominator, fit.model.denominator, rtol=1e-12)


@pytest.mark.parametrize("kind", ["idtf", "tf"])
def test_matlab_code_holds_every_digit(kind):
    fit = fitted(TransferFunction([1 / 3, -2e-17], [1.0, np.pi, 1e9 / 7], 0.1 + 0.2), ("a1", "a2", "b0", "b1", "delay"))
    text = fit.to_matlab("motor", kind, "ms")
    b, a = (
        [float(part) for part in re.search(rf"^{name} = \[(.*)\];$", text, re.MULTILINE)[1].split()]
        for name in ("numerator", "denominator")
    )
    delay = float(re.search(r"^delay = (.*);$", text, re.MULTILINE)[1])
    assert (b, a, delay) == (fit.model.numerator.tolist(), fit.model.denominator.tolist(), fit.model.delay)
    word = {"idtf": "IODelay", "tf": "InputDelay"}[kind]
    assert f"motor = {kind}(numerator, denominator, '{word}', delay, 'TimeUnit', 'milliseconds');" in text
    rows = [[float(part) for part in row.split()] for row in re.findall(r"^% +\[(.*)\]$", text, re.MULTILINE)]
    np.testing.assert_array_equal(rows, fit.covariance)
