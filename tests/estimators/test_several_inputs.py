"""Records with several inputs: agreement of methods, exact derivatives, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli import HeldSignal, Record, TransferFunction, simulate
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Fixed
from ctid_cli.estimation.optimum.box import box_of, point_of
from ctid_cli.estimation.optimum.projection import project, slopes
from ctid_cli.estimation.output_sensitivities import sensitivities
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.models.several_inputs import delays_of

FIRST, SECOND = TransferFunction([2.0], [1.0, 1.2, 1.0], 0.73), TransferFunction([-1.5], [1.0, 0.6], 1.21)
OWN = InputModel("u1", poles=2, zeros=0), InputModel("u2", poles=1, zeros=0)
T = 0.1 * np.arange(300)


def record_of(*models: TransferFunction, noise: float = 0.1, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    inputs = {f"u{k}": np.repeat(rng.choice([-1.0, 1.0], 60), 5) for k in range(1, len(models) + 1)}
    y = sum(simulate(model, HeldSignal(T, u), T) for model, u in zip(models, inputs.values(), strict=True))
    return Record(T, y + noise * rng.standard_normal(T.size), inputs)


@pytest.mark.slow
def test_a_second_numerator_fixed_at_zero_leaves_the_fit_of_the_first_input():
    record = record_of(FIRST, SECOND)
    inputs = (InputModel("u2", zeros=0, delay_bounds=(0.5, 0.5)),)
    both = DelayProfile(2, 1, (0.0, 2.0), inputs=inputs, fixed=(Fixed("u2_b0", 0.0),)).fit(record)
    one = DelayProfile(2, 1, (0.0, 2.0)).fit(record.of_input("u1"))
    assert both.cost == pytest.approx(one.cost, rel=1e-9)
    part = both.of_input("u1").model
    np.testing.assert_allclose(part.denominator, one.model.denominator, rtol=1e-5)
    assert part.delay == pytest.approx(one.model.delay, abs=1e-5)


@pytest.mark.slow
def test_equal_denominators_are_a_common_one():
    record = record_of(FIRST, TransferFunction([-1.5], [1.0, 0.6], 1.0), noise=0.2)
    known = tuple(InputModel(name, delay_bounds=(tau, tau)) for name, tau in (("u1", 0.7), ("u2", 1.0)))
    common = DelayProfile(2, 1, (0.0, 2.0), inputs=known).fit(record)
    values = common.model.parts["u1"].denominator[1:].tolist()
    fixed = tuple(Fixed(f"{name}_a{k}", a) for name in ("u1", "u2") for k, a in enumerate(values, 1))
    own = tuple(replace(one, poles=2) for one in known)
    apart = DelayProfile(2, 1, (0.0, 2.0), inputs=own, fixed=fixed).fit(record)
    assert apart.cost == pytest.approx(common.cost, rel=1e-8)
    for name, part in common.model.parts.items():
        np.testing.assert_allclose(apart.model.parts[name].numerator, part.numerator, rtol=1e-5)


def test_the_parameters_of_both_inputs_are_found_without_noise():
    fit = DelayProfile(2, 0, (0.0, 2.0), inputs=OWN).fit(record_of(FIRST, SECOND, noise=0.0))
    for part, model in zip(fit.model.parts.values(), (FIRST, SECOND), strict=True):
        np.testing.assert_allclose(part.numerator, model.numerator, rtol=1e-6)
        np.testing.assert_allclose(part.denominator, model.denominator, rtol=1e-6)
        assert part.delay == pytest.approx(model.delay, abs=1e-6)


PROBLEMS = {
    "own": DelayProfile(2, 0, (0.0, 2.0), inputs=OWN, initial_state="estimate", offset="estimate"),
    "common": DelayProfile(3, 2, (0.0, 2.0), inputs=(InputModel("u1", zeros=1),), initial_state="estimate"),
    "integrating": DelayProfile(
        2, 0, (0.0, 2.0), inputs=(OWN[0], InputModel("u2", poles=1, integrators=1)), initial_state="estimate"
    ),
    "periodic": DelayProfile(2, 0, (0.0, 2.0), inputs=OWN, initial_state="periodic"),
}


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("name", PROBLEMS)
def test_gradients_of_the_projected_cost_are_exact(name, repeated):
    measured = PROBLEMS[name].prepare(record_of(FIRST, SECOND)).laid_out
    problem, bounds = measured.problem, measured.treatment.delay_bounds
    roots = [-0.5, -0.5 - 1e-9 if repeated else -1.7, -0.9]
    box = box_of(problem, bounds)
    point = point_of(np.array(roots, dtype=complex), [0.33, 0.87], box)
    size = point.poles.size

    def cost(step):
        speed, damping = point.shifted(step[:size])
        delays = tuple(d._replace(seconds=d.seconds + e) for d, e in zip(point.delays, step[size:], strict=True))
        return 0.5 * project(problem, speed, damping, delays).squared_error

    here = project(problem, point.speed, point.damping, point.delays)
    found = slopes(problem, point.speed, point.damping, point.delays, here, (0, 1)).gradient
    numeric = [(cost(1e-5 * e) - cost(-1e-5 * e)) / 2e-5 for e in np.eye(size + 2)]
    np.testing.assert_allclose(found, numeric, rtol=1e-5, atol=1e-6 * np.abs(found).max())


@pytest.mark.parametrize("name", ["common", pytest.param("integrating", marks=pytest.mark.slow)])
def test_sensitivities_are_the_derivatives_of_the_output(name):
    measured = PROBLEMS[name].prepare(record_of(FIRST, SECOND)).laid_out
    model = measured.model(measured.best())
    layout, rng = measured.layout_of(model), np.random.default_rng(1)
    theta = layout.theta(model)
    free = np.flatnonzero(theta != 0.0)
    theta[layout.degrees.size :] = 0.1 * rng.standard_normal(theta.size - layout.degrees.size)

    def errors(values):
        return sensitivities(measured.problem, layout, values, delays_of(model))[0][1]

    ((psi, _),) = sensitivities(measured.problem, layout, theta, delays_of(model))
    for k in (*free, *range(layout.degrees.size, theta.size)):
        step = 1e-6 * max(abs(theta[k]), 0.1) * np.eye(theta.size)[k]
        slope = (errors(theta - step) - errors(theta + step)) / (2.0 * step[k])
        np.testing.assert_allclose(psi[:, k], slope, atol=1e-4 * np.abs(slope).max())


@pytest.mark.parametrize(
    ("options", "second", "message"),
    [
        ({}, "collinear", "the inputs u1 and u2 are collinear"),
        ({}, "constant", "the input u2 is constant"),
        ({"inputs": (InputModel("u3"),)}, None, "there is no input 'u3'; the record has u1, u2"),
    ],
)
def test_records_and_inputs_that_do_not_go_together_are_refused(options, second, message):
    record = record_of(FIRST, SECOND)
    u1 = record.held["u1"].values
    changed = {"collinear": 3.0 - 2.0 * u1, "constant": np.ones(T.size)}.get(second or "")
    record = record if changed is None else replace(record, inputs={**record.held, "u2": HeldSignal(T, changed)})
    with pytest.raises((DataError, OptionError), match=message):
        DelayProfile(1, 0, (0.0, 2.0), **options).fit(record)
