"""Tests of residuals against the input: their level without any dependence, and what they find."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.residual_tests import input_dependence
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

N = 600


def looked_at(rng, *, colour=0.0, pole=0.0, feedback=0.0):
    """The tests of the errors of a first-order model, as if it were known."""
    e = lfilter([1.0], [1.0, -colour], rng.standard_normal(N))
    r = np.repeat(rng.choice([-3.0, 3.0], N // 4), 4)
    u = r - feedback * e
    x = lfilter([0.0, 0.3], [1.0, -0.7], u)
    e = e + pole * lfilter([0.0, 0.1], [1.0, -0.9], x)
    record = Record.from_arrays(np.arange(N), u, x + e)
    return input_dependence(e, x, x[:, None], record.t, record, 0.0)


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_false_alarms_are_as_rare_as_said(colour):
    rng = np.random.default_rng(7)
    found = [looked_at(rng, colour=colour) for _ in range(150)]
    # Both levels are approximate: no more than twice the nominal one, with a confidence of 99.9 %.
    most = binom.ppf(0.999, len(found), 0.1)
    assert sum(one.pole_p_value < 0.05 for one in found) <= most
    assert sum(one.feedback_p_value < 0.05 for one in found) <= most


def test_an_irregular_clock_with_holes_and_a_delay_gives_no_more_false_alarms():
    rng, system = np.random.default_rng(11), TransferFunction([0.3], [1.0, 0.3], 3.3)
    found = []
    for _ in range(100):
        t = np.cumsum(rng.uniform(0.1, 1.9, N))
        u, e = np.repeat(rng.choice([-3.0, 3.0], N // 4), 4), rng.standard_normal(N)
        x, use = simulate(system, HeldSignal(t, u), t), rng.random(N) > 0.15
        record = Record(t, np.where(use, x + e, np.nan), HeldSignal(t, u))
        found.append(input_dependence(e[use], x[use], x[use, None], t[use], record, 3.3))
    most = binom.ppf(0.999, len(found), 0.1)
    assert sum(one.pole_p_value < 0.05 for one in found) <= most
    assert sum(one.feedback_p_value < 0.05 for one in found) <= most


def test_dynamics_that_are_missed_and_feedback_are_told_apart():
    rng = np.random.default_rng(8)
    poor, looped = looked_at(rng, pole=1.0), looked_at(rng, feedback=0.3)
    assert poor.pole_p_value < 1e-6 < 1e-2 < poor.feedback_p_value
    assert poor.pole_share > 0.1
    assert looped.feedback_p_value < 1e-6 < 1e-2 < looped.pole_p_value


def test_a_short_record_is_not_tested():
    record = Record.from_arrays(np.arange(50), np.ones(50), np.ones(50))
    assert input_dependence(np.ones(50), np.ones(50), np.ones((50, 1)), record.t, record, 0.0) is None
