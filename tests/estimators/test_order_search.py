"""Which structure is recommended, and that fits of nested structures are nested."""

import numpy as np
import pytest

from ctid_cli import DelayProfile, HeldSignal, Record, TransferFunction, search_orders, simulate
from ctid_cli.errors import OptionError
from ctid_cli.inference.criteria import cross_validated_errors, shared_noise, squared_innovations

INTERVAL, SAMPLES = 0.1, 600


def record_of(model, seed=0, colour=0.0, deviation=0.05):
    rng = np.random.default_rng(seed)
    t = INTERVAL * np.arange(SAMPLES)
    signal = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 5), 5))
    noise = deviation * rng.standard_normal(SAMPLES)
    for k in range(1, SAMPLES):
        noise[k] += colour * noise[k - 1]
    return Record(t, noise + (0 if model is None else simulate(model, signal, t)), signal)


SECOND = TransferFunction([2.0], [1.0, 1.2, 4.0], 0.23)


@pytest.fixture(scope="module")
def found():
    return search_orders(record_of(SECOND), (1, 4), (0, 2), (0, 1), validation=record_of(SECOND, 1))


def test_the_order_that_made_the_data_is_recommended(found):
    assert found.recommended.name == "2/0"
    assert found.recommended.fit.model.delay == pytest.approx(0.23, abs=0.05)
    assert "BIC is" in found.reason
    assert "fewer poles (1/0)" in found.reason


def test_the_squared_error_never_rises(found):
    for each in found.orders:
        n, m = each.options.poles, each.options.zeros
        for larger in (found.of(n + 1, m), found.of(n, m + 1), found.of(n + 1, m + 1)):
            assert larger is None or larger.fit.cost <= each.fit.cost * (1 + 1e-8)


def test_the_search_ends_where_a_full_one_does(found):
    full = DelayProfile(2, 0, (0, 1), nested=True).fit(record_of(SECOND))
    assert found.of(2, 0).fit.cost == pytest.approx(full.cost, rel=1e-7)


def test_every_structure_is_judged(found):
    assert [each.criteria.bic for each in found.orders] == sorted(each.criteria.bic for each in found.orders)
    best = found.recommended
    assert best.white
    assert best.independent
    assert best.fit.fit_percent - 2 < best.cross_validated_percent < best.fit.fit_percent
    # Also of models with zeros, which another structure could not hold.
    assert all(
        abs(each.validation_percent - each.fit.fit_percent) < 8 for each in found.orders if each.options.poles > 1
    )
    one = found.of(1, 0)
    assert not one.white or not one.independent


def test_coloured_noise_is_made_white_first():
    found = search_orders(record_of(SECOND, 3, colour=0.9), (1, 3), (0, 1), (0, 1))
    assert found.noise.order > 0
    assert found.recommended.name == "2/0"


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_noise_is_told_as_such(colour):
    found = search_orders(record_of(None, 5, colour), (1, 2), (0, 1), (0, 1))
    assert found.recommended is None
    assert found.reason.startswith("There is no model here")


def test_ranges_are_refused():
    with pytest.raises(OptionError, match="least number first"):
        search_orders(record_of(SECOND), (3, 2))
    with pytest.raises(OptionError, match="no structure has at least 4 zeros"):
        search_orders(record_of(SECOND), (1, 2), (4, 5))


def test_cross_validation_of_linear_least_squares_is_that_of_fits_without_each_block():
    rng = np.random.default_rng(1)
    psi, y = rng.standard_normal((50, 3)), rng.standard_normal(50)
    e = y - psi @ np.linalg.lstsq(psi, y, rcond=None)[0]
    (left,) = cross_validated_errors([e], [psi])
    rest = np.arange(50) >= 5
    without = np.linalg.lstsq(psi[rest], y[rest], rcond=None)[0]
    np.testing.assert_allclose(left[:5], y[:5] - psi[:5] @ without)


def test_innovations_of_white_residuals_are_themselves():
    e = np.random.default_rng(2).standard_normal(500)
    noise = shared_noise([e])
    assert noise.order == 0
    assert squared_innovations([e], [np.zeros((500, 0))], noise) == pytest.approx(e @ e)
