"""Derived quantities of submodels: derivatives against central differences and against the unfactored model."""

import numpy as np
import pytest

from ctid_cli.inference.derived import derived_parameters
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored, unfactored_jacobian

TWO_MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
MIXED = AdditiveModel(
    [
        Submodel([2.0, 1.0], [0.5, 1.0], integrators=1),
        Submodel([0.3, 2.0], np.poly([-0.2, -1.0, -8.0, -3 + 4j, -3 - 4j]).real),
        Submodel([0.5], [0.025, 0.01, 1.0]),
        Submodel([1.0], [0.1, 0.8, 1.0]),
        Submodel([0.2], [1.0]),
    ]
)


def by_name(model, covariance, **options):
    return {row.name: row for row in derived_parameters(model, covariance, **options)}


def random_covariance(model, relative=1e-4):
    size = model.theta.size
    root = np.random.default_rng(1).standard_normal((size, size)) * relative * np.abs(model.theta)[:, None]
    return root @ root.T


def test_names_and_units_say_what_is_what():
    covariance = random_covariance(MIXED)
    rows = by_name(MIXED, covariance)
    pair = ["pole_real", "pole_imag", "natural_frequency", "natural_frequency_hz", "damping"]
    real = [f"{kind}_{k}" for k in (1, 2) for kind in ("pole", "time_constant")]
    # Of two real poles and of a pair alike there is a natural frequency; the second submodel has five poles.
    assert [name for name in rows if name[1] != "2"] == [
        *("g1_pole", "g1_time_constant", "g1_static_gain"),
        *(f"g3_{name}" for name in (*pair, "static_gain")),
        *(f"g4_{name}" for name in (*real, *pair[2:], "static_gain")),
        "g5_static_gain",
    ]
    assert {"g2_pole_2_imag", "g2_natural_frequency_2_hz", "g2_damping_2", "g2_time_constant_4"} < set(rows)
    units = [rows[f"g3_{name}"].unit for name in ("pole_real", "natural_frequency", "natural_frequency_hz", "damping")]
    assert units == ["rad/s", "rad/s", "Hz", "-"]
    assert (rows["g1_time_constant"].unit, rows["g4_static_gain"].unit) == ("s", "output unit/input unit")


@pytest.mark.parametrize("model", [TWO_MODES, MIXED])
def test_every_standard_error_is_that_of_central_differences(model):
    theta, covariance = model.theta, random_covariance(model, 1e-6)
    rows = by_name(model, covariance)
    finite = [name for name, row in rows.items() if not row.reason]

    def values(parameters):
        moved = by_name(AdditiveModel.from_theta(parameters, model.terms), covariance)
        return np.array([moved[name].estimate for name in finite])

    gradients = []
    for step in np.diag(1e-5 * np.abs(theta)):
        gradients.append((values(theta + step) - values(theta - step)) / (2 * step.sum()))
    gradients = np.array(gradients).T
    expected = np.sqrt(np.einsum("ij,jk,ik->i", gradients, covariance, gradients))
    np.testing.assert_allclose([rows[name].standard_error for name in finite], expected, rtol=1e-5)
    assert set(rows) - set(finite) == ({"g1_static_gain"} if model is MIXED else set())


def test_known_second_order_quantities_in_closed_form():
    rows = by_name(TWO_MODES, np.diag([0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4]) ** 2)
    # w = a2^(-1/2), zeta = a1 a2^(-1/2) / 2
    assert rows["g1_natural_frequency"].estimate == pytest.approx(2.0)
    assert rows["g1_natural_frequency"].standard_error == pytest.approx(0.5 * 0.25**-1.5 * 0.02)
    assert rows["g1_damping"].estimate == pytest.approx(0.25)
    assert rows["g1_damping"].standard_error == pytest.approx(np.hypot(0.01, 0.5 * 0.25 / 0.25 * 0.02))
    assert rows["g2_natural_frequency_hz"].estimate == pytest.approx(np.sqrt(40) / (2 * np.pi))
    assert rows["g2_damping"].estimate == pytest.approx(0.01 * np.sqrt(40) / 2)
    gain = rows["g2_static_gain"]
    assert (gain.estimate, gain.standard_error) == pytest.approx((1.0, 3e-4))
    assert gain.high - gain.low == pytest.approx(2 * 1.959964 * 3e-4, rel=1e-6)
    covariance = np.diag([0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4]) ** 2
    narrow = by_name(TWO_MODES, covariance, quantile=lambda _: normal_quantile(0.5))["g2_static_gain"]
    assert narrow.high - narrow.low == pytest.approx(2 * 0.674490 * 3e-4, rel=1e-6)


def test_frequency_and_damping_do_not_change_where_two_poles_meet_on_the_real_axis():
    covariance = 1e-4 * np.eye(3)
    rows = [
        by_name(AdditiveModel([Submodel([1.0], [0.25, 1.0 + change, 1.0])]), covariance)
        for change in (-1e-9, 0.0, 1e-9)
    ]
    for name in ("g1_natural_frequency", "g1_natural_frequency_hz", "g1_damping"):
        estimates, errors = zip(*((r[name].estimate, r[name].standard_error) for r in rows), strict=True)
        np.testing.assert_allclose(estimates, estimates[1], rtol=1e-7)
        np.testing.assert_allclose(errors, errors[1], rtol=1e-4)
    assert "so close to another" in rows[1]["g1_pole_1"].reason


def test_accuracy_is_that_of_the_unfactored_model():
    # The same estimate in other coordinates: poles of a fraction, poles of its factors.
    covariance = random_covariance(TWO_MODES)
    forth = unfactored_jacobian(TWO_MODES)
    whole = {row.name: row for row in derived_parameters(unfactored(TWO_MODES), forth @ covariance @ forth.T)}
    rows = by_name(TWO_MODES, covariance)
    for name in ("pole_{}_real", "pole_{}_imag", "natural_frequency_{}", "damping_{}"):
        for submodel, number in ((1, 2), (2, 1)):
            expected = whole[name.format(number)]
            row = rows[f"g{submodel}_{name.replace('_{}', '')}"]
            assert (row.estimate, row.standard_error) == pytest.approx(
                (expected.estimate, expected.standard_error), rel=1e-9
            )


def test_integrators_and_undefined_covariances_are_said():
    rows = by_name(MIXED, random_covariance(MIXED))
    assert rows["g1_static_gain"].estimate == np.inf
    assert "integrates and has no static gain" in rows["g1_static_gain"].reason
    assert np.isnan(rows["g1_static_gain"].standard_error)
    assert rows["g1_time_constant"].standard_error > 0
    rows = by_name(TWO_MODES, np.full((6, 6), np.nan))
    assert all("not defined" in row.reason and np.isnan(row.standard_error) for row in rows.values())
