"""Submodels of a record whose input is band-limited: the finer clock of its input is not that of its samples."""

import numpy as np

from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import identify
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


def test_one_submodel_is_the_fraction():
    rng = np.random.default_rng(4)
    t = 0.2 * np.arange(400)
    u = HeldSignal(t, np.convolve(rng.standard_normal(404), np.ones(5) / 5, "valid"), "band-limited")
    y = simulate(TransferFunction([4.0], [1.0, 0.8, 4.0]), u, t) + 0.02 * rng.standard_normal(t.size)
    record = Record(t, y, u)
    additive = identify(MeasuredSubmodels((Term(2, 0),)), [record])
    fraction = identify(DelayProfile(2, 0, (0.0, 0.0)), [record])
    assert additive.fit.used[0].size == t.size
    np.testing.assert_allclose(additive.fit.model.denominator, fraction.fit.model.denominator, rtol=1e-3)
    np.testing.assert_allclose(additive.fit.cost, fraction.fit.cost, rtol=1e-4)
