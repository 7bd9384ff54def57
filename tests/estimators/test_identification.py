"""A fit with its uncertainty and diagnostics, on measured records."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli.estimation.optimum.box import LIMITS
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import costs_about_delay
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
from ctid_cli.filtering.simulate import simulate
from ctid_cli.identification.identify import identify
from ctid_cli.inference.covariance import robust_dispersion
from ctid_cli.inference.fit import Status
from ctid_cli.inference.intervals import student_quantile
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

FIRST_ORDER = TransferFunction([1.0], [1.0, 2.0], 0.55)
OPTIONS = DelayProfile(1, 0, (0, 3))


def record_of(model=FIRST_ORDER, *, n=1000, seed=0, noise=0.05, colour=0.0, offset=0.0, past=0, every=5):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    values = np.repeat(rng.choice([-1.0, 1.0], n // every + 1), every)[:n]
    signal = HeldSignal(t, values)
    e = noise * rng.standard_normal(n)
    for k in range(1, n):
        e[k] += colour * e[k - 1]
    y = simulate(model, signal, t) + e + offset
    return Record(t[past:], y[past:], HeldSignal(t[past:], values[past:]), name=f"record {seed}")


def by_name(result):
    return {item.name: item for item in result.estimates}


def test_white_residuals_keep_the_classical_covariance():
    record = record_of()
    result = identify([record], OPTIONS)
    assert result.uncertainty.kind == "white"
    np.testing.assert_array_equal(result.uncertainty.covariance, result.fit.covariance)
    items = by_name(result)
    assert list(items) == ["b0", "a1", "delay"]
    for name, item in items.items():
        assert item.estimate == result.fit.parameters[name]
        assert item.standard_error == result.fit.standard_errors[name]
        assert item.status == "free"
        if name != "delay":
            assert item.high - item.estimate == pytest.approx(student_quantile(997) * item.standard_error)
    assert result.warnings == ()
    assert repr(result).startswith("Identification: white covariance, 0 warnings\nMeasuredFit: CONVERGED, fit ")
    assert len(repr(result).splitlines()) == 3
    assert result.criteria.aic == pytest.approx(1000 * np.log(result.fit.cost) + 6)
    gain = next(row for row in result.derived if row.name == "static_gain")
    assert abs(gain.estimate - 0.5) < 4 * gain.standard_error


def test_coloured_residuals_take_the_sandwich():
    result = identify([record_of(colour=0.9)], OPTIONS)
    assert result.uncertainty.kind == "robust"
    found = robust_dispersion(result.fit.sensitivities, result.fit.residuals)
    np.testing.assert_allclose(result.uncertainty.covariance, found.covariance, rtol=1e-9)
    b0 = by_name(result)["b0"]
    assert b0.standard_error > 1.5 * np.sqrt(np.diag(result.fit.uncertainty("white").covariance))[1]
    freedom = 2 * found.covariance[1, 1] ** 2 / np.sum(found.variation[:, 1, 1] ** 2)
    reach = student_quantile(freedom)
    assert b0.high - b0.estimate == pytest.approx(reach * b0.standard_error)
    assert not result.tests[0].white
    assert len(result.warnings) == 1
    assert result.warnings[0].startswith("The fit is 65.7 %")


def test_intervals_that_reach_beyond_the_linear_are_called_unsafe():
    t = 0.05 * np.arange(600)
    step = HeldSignal(t, (t >= 3.0).astype(float))
    x = simulate(TransferFunction([2.0], [0.4, 1.4, 1.0], 0.63), step, t)
    drawn = np.random.default_rng(5).standard_normal(600)
    options = DelayProfile(2, 0, (0, 2))
    quiet, loud = (identify([Record(t, x + level * drawn, step)], options) for level in (0.01, 0.2))
    assert not any("unsafe" in warning for warning in quiet.warnings)
    assert any("unsafe" in warning and "a1" in warning for warning in loud.warnings)


def test_a_delay_at_its_bound_has_no_standard_error():
    result = identify([record_of()], DelayProfile(1, 0, (0, 0.4)))
    assert result.fit.status is Status.DELAY_AT_BOUND
    delay = by_name(result)["delay"]
    assert (delay.estimate, delay.status) == (0.4, "at bound")
    assert np.isnan(delay.standard_error)
    assert delay.high == 0.4
    assert np.isfinite(by_name(result)["a1"].standard_error)
    assert result.warnings[0].startswith("A free choice takes 1 pole, no zero: with --delay 0:")
    assert any(warning.startswith("The delay is at the end of its range, 0.4 s") for warning in result.warnings)


def test_a_small_zero_and_a_delay_are_undetermined():
    """A small zero shifts the response like a delay: the pair is singular at b0 = 0."""
    smooth = TransferFunction([4.0], [1.0, 4.0, 4.0], 0.5)
    result = identify([record_of(smooth, noise=0.02)], DelayProfile(2, 1, (0, 3)))
    items = by_name(result)
    assert items["b0"].status == "undetermined"
    assert all(np.isnan([items["b0"].standard_error, items["b0"].low, items["b0"].high]))
    assert any("b0" in warning for warning in result.warnings)


def test_equations_without_information_leave_everything_undetermined():
    t = np.arange(60.0)
    record = Record.from_arrays(t, np.full(60, 2.0), 3.0 + np.exp(-0.2 * t))
    options = DelayProfile(1, 0, (0, 0), initial_state="estimate", offset="estimate")
    result = identify([record], options)
    statuses = {item.name: item.status for item in result.estimates}
    # A constant input and a constant offset have the same effect.
    assert statuses["b0"] == statuses["offset"] == "undetermined"
    assert statuses["delay"] == "fixed"
    derived = {item.name: item.standard_error for item in result.derived}
    assert np.isnan(derived["static_gain"])
    # The free response determines the pole.
    assert derived["time_constant_1"] < 1e-6


def test_the_delay_has_a_profile_interval_where_the_cost_is_not_quadratic():
    # A held input causes kinks in the cost, and with noise the interval extends over them.
    result = identify([record_of(n=60, noise=0.1, every=3)], OPTIONS)
    interval = result.delay_interval
    assert interval is not None
    delay = by_name(result)["delay"]
    assert (delay.low, delay.high) == (interval.low, interval.high)
    assert interval.low <= delay.estimate <= interval.high


@pytest.mark.parametrize(
    ("changes", "option", "silent"),
    [
        ({"offset": 0.5}, "--offset estimate", {"offset": "estimate"}),
        (
            {"past": 105, "every": 60, "n": 400},
            "--input-before first",
            {"input_before": "first", "offset": "estimate"},
        ),
    ],
)
def test_what_should_be_estimated_too_is_named(changes, option, silent):
    record = record_of(**changes)
    assert any(option in warning for warning in identify([record], OPTIONS).warnings)
    better = identify([record], DelayProfile(1, 0, (0, 3), **silent))
    assert not any(option in warning for warning in better.warnings)


def test_a_model_that_fails_validation_is_reported():
    other = record_of(TransferFunction([-1.0], [1.0, 2.0], 0.55), seed=1)
    result = identify([record_of()], OPTIONS, other)
    x = simulate(result.fit.model, other.input, other.t)
    assert result.validation.r2 == pytest.approx(1 - np.mean((other.y - x) ** 2) / np.var(other.y))
    assert result.validation.r2 < 0
    assert any("does not generalise" in warning for warning in result.warnings)


def test_without_a_response_the_first_warning_says_so():
    record = record_of(FIRST_ORDER, seed=3, n=300)
    noise = Record(record.t, np.random.default_rng(3).standard_normal(300), record.input)
    result = identify([noise], DelayProfile(1, 0, (0, 3), offset="estimate"))
    assert not result.answer.seen
    assert result.warnings[0].startswith("No model: no response of the output to the input is detected (p = ")
    for name in ("b0", "a1", "delay"):
        item = by_name(result)[name]
        assert (item.status, np.isnan(item.standard_error)) == ("undetermined", True)
    assert all(np.isnan(row.standard_error) for row in result.derived)
    assert "missing dynamics" not in " ".join((result.tests[0].sentence, *result.warnings))
    assert identify([record], OPTIONS).answer.p_value == 0.005


def test_a_pole_at_the_border_is_held_and_what_only_reflects_it_is_not_determined():
    """The covariance is that of the model with the free pole and the numerator, from central differences."""
    record = record_of(TransferFunction([1.0], [1.0, 2.0]), n=400, seed=3)
    result = identify([record], DelayProfile(2, 1, (0, 0)), covariance="white")
    slow, free = LIMITS["slowest"].rest / record.t[-1], float(result.fit.model.poles.real.min())
    assert result.fit.status is Status.AT_BOUND
    assert result.fit.held_poles == pytest.approx([-slow])

    def output(pole, b0, b1):
        return simulate(TransferFunction([b0, b1], np.poly([pole, -slow])), record.input, record.t)

    point = np.array([free, *result.fit.model.numerator])
    steps = 1e-5 * np.diag(np.abs(point))
    psi = np.column_stack([(output(*(point + h)) - output(*(point - h))) / (2 * h.sum()) for h in steps])
    squared = np.sum((record.y - output(*point)) ** 2)
    errors = np.sqrt(np.diag(np.linalg.inv(psi.T @ psi)) * squared / (400 - 3))
    numerator = [result.fit.parameter_names.index(name) for name in ("b0", "b1")]
    assert np.sqrt(np.diag(result.uncertainty.covariance))[numerator] == pytest.approx(errors[1:], rel=1e-4)
    rows = {row.estimate: row for row in result.derived}
    # Intervals contain those of models with a faster slow pole, which the record does not reject.
    assert rows[free].standard_error >= errors[0] * (1 - 1e-4)
    assert by_name(result)["b0"].standard_error >= errors[1] * (1 - 1e-4)
    assert by_name(result)["a2"].status == rows[result.fit.model.dc_gain].status == "undetermined"
    held = min(rows.values(), key=lambda row: abs(row.estimate + slow))
    assert np.isnan(held.standard_error)
    assert "bound" in held.reason
    assert sum("Held at the border" in warning for warning in result.warnings) == 1


def test_a_record_too_short_for_its_noise_is_reported():
    options = DelayProfile(1, 0, (0.55, 0.55), offset="drift")
    result = identify([record_of(n=60, colour=0.99, noise=0.02, seed=1)], options)
    assert any("The record is short for its noise" in warning for warning in result.warnings)


def test_one_submodel_of_a_band_limited_input_is_the_fraction():
    # The finer clock of a band-limited input differs from that of the samples.
    rng = np.random.default_rng(4)
    t = 0.2 * np.arange(400)
    u = HeldSignal(t, np.convolve(rng.standard_normal(404), np.ones(5) / 5, "valid"), "band-limited")
    y = simulate(TransferFunction([4.0], [1.0, 0.8, 4.0]), u, t) + 0.02 * rng.standard_normal(t.size)
    record = Record(t, y, u)
    additive = identify([record], MeasuredSubmodels((Term(2, 0),)))
    fraction = identify([record], DelayProfile(2, 0, (0.0, 0.0)))
    assert additive.fit.used[0].size == t.size
    np.testing.assert_allclose(additive.fit.model.denominator, fraction.fit.model.denominator, rtol=1e-3)
    np.testing.assert_allclose(additive.fit.cost, fraction.fit.cost, rtol=1e-4)


def test_the_cost_about_the_delay_is_least_at_the_estimate():
    result = identify([record_of()], OPTIONS)
    near = costs_about_delay(result)
    assert near.delays[np.argmin(near.costs)] == pytest.approx(result.fit.model.delay, abs=1e-9)
    assert near.costs.min() == pytest.approx(near.least, rel=1e-9)
    inside = near.delays[near.costs <= near.allowed]
    item = next(item for item in result.estimates if item.name == "delay")
    step = np.diff(near.delays).max()
    assert abs(inside[0] - item.low) <= 1.5 * step
    assert abs(inside[-1] - item.high) <= 1.5 * step


@pytest.mark.parametrize("noise_model", ["white", "arma:1,0"])
def test_a_sine_determines_the_response_at_its_frequency_only(noise_model):
    t, rng = 0.1 * np.arange(400), np.random.default_rng(0)
    w = 2.0 * np.pi / 4.0
    gain = 2.0 / (1j * w + 1.0)
    noise = lfilter([0.02], [1.0, -0.7], rng.standard_normal(400))
    record = Record.from_arrays(t, np.sin(w * t), abs(gain) * np.sin(w * t + np.angle(gain)) + noise, "foh")
    fit = DelayProfile(2, 0, (0.0, 0.0), initial_state="periodic", noise_model=noise_model).fit(record)
    assert not fit.status.succeeded
    assert np.isnan([*fit.standard_errors.values()]).all()
    for bands in ("linearised", "sampled"):
        found = fit.frequency_response([0.1, w, 10.0], bands=bands)
        assert np.isnan([found.gain_error, found.gain_lower, found.gain_upper])[:, [0, 2]].all()
        assert found.gain_lower[1] < abs(gain) < found.gain_upper[1]
        assert np.isnan(found.covariance[[0, 2]]).all()
    assert np.isnan(fit.poles().standard_error).all()
