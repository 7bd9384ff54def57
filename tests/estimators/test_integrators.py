"""Integrating systems, with the same estimator as all others."""

import numpy as np
import pytest

from ctid_cli.errors import OptionError
from ctid_cli.estimation.common import Start
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

NOISE = 0.02


def integrating(seed, numerator, denominator, *, regular=True, free=None, noise=NOISE):
    """Return a record of a system with a delay of .73 s and, if given, a free response."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(400) if regular else np.cumsum(rng.uniform(0.02, 0.18, 400))
    u = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], 80), 5))
    y = simulate(TransferFunction(numerator, denominator, delay=0.73), u, t)
    if free is not None:
        y = y + free(t)
    return Record(t, y + noise * rng.standard_normal(t.size), u)


@pytest.mark.parametrize(
    ("numerator", "denominator", "integrators", "regular"),
    [
        ([1.5], [1, 0], 1, True),
        ([2, 3], [1, 2, 0], 1, False),
        ([1], [1, 0.4, 2, 0], 1, True),
        ([1.0], [1, 1, 0, 0], 2, False),
    ],
)
def test_parameters_delay_state_and_offset_are_found(numerator, denominator, integrators, regular):
    poles = len(denominator) - 1 - integrators

    def free(t):
        decaying = 2.0 * np.exp(-2.0 * t) if denominator == [1, 2, 0] else 0.0
        return 4.0 + decaying + (0.3 * t if integrators == 2 else 0.0)

    record = integrating(1, numerator, denominator, regular=regular, free=free)
    estimator = DelayProfile(
        *(poles, len(numerator) - 1, (0, 2)), initial_state="estimate", offset="estimate", integrators=integrators
    )
    fit = estimator.fit(record)
    true = [*denominator[1:], *numerator, 0.73]
    names = fit.parameter_names[: len(true)]
    assert fit.known == tuple(f"a{k}" for k in range(poles + 1, poles + integrators + 1))
    for name, value in zip(names, true, strict=True):
        error = fit.standard_errors[name]
        assert abs(fit.parameters[name] - value) <= (0.0 if name in fit.known else 4.5 * error), name
    assert fit.cost == pytest.approx(NOISE**2, rel=0.25)
    # The constant is part of the free response.
    assert len(fit.initial_states[0]) == poles + integrators
    assert fit.offsets == (0.0,)


@pytest.mark.parametrize("initial_state", ["rest", "estimate"])
def test_instrumental_variables_end_at_the_same_estimate(initial_state):
    record = integrating(5, [1.5], [1, 0.5, 0])
    ours = DelayProfile(1, 0, (0.73, 0.73), initial_state=initial_state, integrators=1).fit(record)
    submodel = MeasuredSubmodels((Term(1, 0, 1),), 0.73, initial_state=initial_state).fit(record)
    np.testing.assert_allclose(ours.model.numerator, submodel.model.numerator, rtol=1e-4)
    np.testing.assert_allclose(ours.model.denominator, submodel.model.denominator, rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"offset": "remove"}, "offset remove"),
        ({"initial_state": "periodic"}, "periodic"),
        ({"integrators": 4}, "integrators"),
    ],
)
def test_what_cannot_be_is_refused(options, words):
    with pytest.raises(OptionError, match=words):
        DelayProfile(1, 0, (0, 2), **{"integrators": 1, **options})


def test_no_poles_need_an_integrator():
    with pytest.raises(OptionError, match="poles"):
        DelayProfile(0, 0, (0, 2))
    assert DelayProfile(0, 0, (0, 2), integrators=1).fit(integrating(7, [1.5], [1, 0]), Start()).model.order == 1
