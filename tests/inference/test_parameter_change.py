"""Test of a change of parameters between halves of a record and between records."""

import numpy as np
import pytest

from ctid_cli.inference.noise_model import NoiseModel, fit_residual_noise
from ctid_cli.inference.parameter_change import Quantity, _Halves, parameter_change
from ctid_cli.signals.noise import ArmaNoise

COMMON = np.array([True, True, False])
WHITE = NoiseModel(np.ones(1), np.ones(1), 1.0)


def regression(seed, count=60, noise=None, change=0.0):
    """Return the columns and the residuals of a fit of two slow columns and a constant, the first changed half-way."""
    rng = np.random.default_rng(seed)
    columns = np.column_stack((np.cumsum(rng.standard_normal((count, 2)), axis=0), np.ones(count)))
    late = np.arange(count) >= count // 2
    y = columns[:, 0] * change * late + (rng.standard_normal(count) if noise is None else noise(rng, count))
    return columns, y - columns @ np.linalg.lstsq(columns, y)[0]


def named(count=3):
    return [Quantity(f"p{k}", 5.0, row) for k, row in enumerate(np.eye(count))]


def test_the_values_of_the_halves_are_those_of_separate_regressions():
    columns, e = regression(1, change=2.0)
    halves = _Halves.of([columns[:, :2]], [e], COMMON[:2], WHITE)
    found = halves.named("The halves of the record", 0.0, np.array([0, 1]), named(2)[:1])
    each = [np.linalg.lstsq(columns[part, :2], e[part])[0][0] for part in (slice(30), slice(30, None))]
    assert found.values == pytest.approx(5.0 + np.array(each), rel=1e-9)
    assert found.sentence.startswith("The halves of the record differ (p < 0.0001): p0 ")


def test_the_test_has_its_size_in_slow_noise_and_finds_a_change():
    def slow(rng, count):
        return ArmaNoise((1.0,), (1.0, -0.9), innovation_variance=1.0).generate(np.empty(count), rng)

    def p_value(seed, **more):
        columns, e = regression(seed, noise=slow, **more)
        noise = fit_residual_noise([columns], [e])
        return _Halves.of([columns], [e], COMMON, noise).p_value(np.array([0, 1]))

    found = np.array([p_value(seed) for seed in range(120)])
    # 99.9 % limits of the number below the level.
    assert np.count_nonzero(found < 0.1) <= 24
    assert np.count_nonzero(found < 0.01) <= 6
    assert np.median([p_value(seed, change=3.0) for seed in range(10)]) < 1e-3


def test_records_that_differ_are_named_and_equal_ones_are_not():
    each = [regression(seed, 200) for seed in range(4)]
    columns = [np.column_stack((block[:, :2], np.eye(4)[k] * np.ones((200, 4)))) for k, (block, _) in enumerate(each)]
    common = np.array([True, True, *[False] * 4])
    residuals = [e for _, e in each]
    assert parameter_change(columns, residuals, common, list) is None
    residuals[2] = residuals[2] + columns[2][:, 0]
    quantities = [Quantity("static gain", 2.0, np.eye(6)[0], True), Quantity("a1", 1.0, np.eye(6)[1])]
    found = parameter_change(columns, residuals, common, lambda: quantities)
    assert found.what == "The records"
    assert found.sentence.count(" in record ") == 2
    assert found.sentence.endswith(" in record 3")


def test_changes_of_rounding_size_are_not_named():
    columns, e = regression(1)
    e = 1e-9 * (e + columns[:, 0] * (np.arange(60) >= 30))
    assert parameter_change([columns], [e], COMMON, named) is None
