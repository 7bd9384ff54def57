"""Conversion between parameters and frequencies, and propagation of errors."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ctid_cli.frequency.delay_kernels import flag_uncertain, real_roots
from ctid_cli.frequency.delay_regression import theta_of
from ctid_cli.frequency.flags import Flag
from tests.frequency.signals import clock_of, frequencies_of

FREQUENCIES = st.lists(st.floats(0.05, 3.0), min_size=1, max_size=8).map(sorted)


def roots_of(coefficients):
    roots = np.empty(len(coefficients) - 1)
    return real_roots(np.array(coefficients[1:], float), roots), np.sort(roots)[::-1]


@given(FREQUENCIES, st.floats(0.1, 1.0))
def test_frequencies_survive_the_round_trip(omega, delay):
    omega = np.array(omega)
    assume(omega.size == 1 or np.diff(omega).min() > 0.2)
    found, flags = frequencies_of(theta_of(omega, delay), delay)
    # The error of a root is the rounding of the coefficients over the product of its distances to the others.
    c = np.cos(omega * delay)
    distances = [np.prod(np.delete(c[i] - c, i)) for i in range(omega.size)]
    slack = 1e-14 * 2.0**omega.size / np.abs(distances) / (delay * np.sin(omega * delay))
    assume((slack < 0.02).all())
    assert flags == 0
    assert (np.abs(found - omega) <= slack + 1e-14).all()


@given(st.integers(2, 8), st.integers(0, 2**31))
def test_real_roots_are_found_and_complex_ones_are_not(n, seed):
    rng = np.random.default_rng(seed)
    wanted = np.sort(rng.uniform(-1, 1, n))[::-1]
    assume(np.abs(np.diff(wanted)).min() > 0.02)
    real, roots = roots_of(np.poly(wanted))
    assert real
    np.testing.assert_allclose(roots, wanted, atol=1e-6)
    pair = complex(rng.uniform(-1, 1), rng.uniform(0.05, 1))
    coefficients = np.poly([*wanted[:-2], pair, pair.conjugate()]).real
    assert not roots_of(coefficients)[0]
    # Their real parts are returned.
    omega, flags = frequencies_of(coefficients[1:], 1.0)
    assert flags == Flag.COMPLEX_ROOTS
    np.testing.assert_allclose(np.cos(omega), np.sort(np.roots(coefficients).real)[::-1], atol=1e-6)


def test_roots_that_are_no_cosines_are_clipped_and_flagged():
    for roots in ([1.5, -0.2], [0.3, -1.1]):
        omega, flags = frequencies_of(np.poly(roots)[1:], 0.5)
        assert flags == Flag.OUT_OF_BOUNDS
        np.testing.assert_allclose(omega, np.arccos(np.clip(roots, -1.0, 1.0)) / 0.5)


def test_parameters_that_are_no_numbers_give_no_numbers():
    omega, flags = frequencies_of([np.nan, 0.3], 0.5)
    assert np.isnan(omega).all()
    assert flags


LONG = 1e3


def result(omega, share, *, span=LONG, elapsed=LONG, closeness=1.0):
    """Return the result on a fit whose misfit can move a frequency by a fraction of itself, or of the distance."""
    omega, delay = np.array(omega), 0.7
    theta, n = theta_of(omega, delay), len(omega)
    phi = np.random.default_rng(n).standard_normal((200, n))
    phi[:, -1] = phi[:, -1] if n == 1 else phi[:, 0] + closeness * phi[:, -1]
    e = np.zeros(200)
    if share:
        steps = 1e-6 * np.eye(n)
        derivatives = np.array(
            [(frequencies_of(theta + d, delay)[0] - frequencies_of(theta - d, delay)[0]) / 2e-6 for d in steps]
        )
        # Residuals e move a frequency by g' G^-1 phi' e, at most by sqrt(g' G^-1 g e'e). These do not change theta.
        reach = np.sqrt(np.sum(derivatives * np.linalg.solve(phi.T @ phi, derivatives), axis=0))
        apart = np.diff(omega, append=np.inf)
        room = np.minimum(np.minimum(apart, np.roll(apart, 1)), omega)
        e = np.random.default_rng(0).standard_normal(200)
        e -= phi @ np.linalg.lstsq(phi, e, rcond=None)[0]
        e *= share / np.max(reach / room) / np.linalg.norm(e)
    rows = np.column_stack([phi, phi @ theta + e])
    return flag_uncertain(rows.T @ rows, np.inf, theta, np.cos(omega * delay), omega, clock_of(delay), span, elapsed)


@pytest.mark.parametrize(
    "omega", [[2.0], [2.0, 3.0], [0.5, 3.0], [1.0, 2.0, 3.5], [0.5, 1.5, 2.5, 3.5, 4.2], [1.0, 1.1, 4.0]]
)
def test_certain_means_a_tenth_of_the_distance_to_the_next_or_to_zero(omega):
    assert result(omega, 0.0999) == 0
    assert result(omega, 0.1001) == Flag.UNCERTAIN


def test_short_data_make_a_misfit_weigh_more():
    omega = [2.0]  # a period takes pi seconds
    # Either the estimate uses less than one period, or less than two have passed.
    cases = ((4.0, LONG, 1.0), (np.pi, LONG, 1.0), (np.pi / 2, LONG, 32.0), (np.pi / 4, LONG, 1024.0))
    cases += ((np.pi, 2 * np.pi, 1.0), (np.pi, np.pi, 32.0), (np.pi / 2, 2 * np.pi, 32.0))
    for span, elapsed, factor in cases:
        assert result(omega, 0.0999 / factor, span=span, elapsed=elapsed) == 0
        assert result(omega, 0.1001 / factor, span=span, elapsed=elapsed) == Flag.UNCERTAIN


def test_rounding_counts_where_moments_are_nearly_singular():
    assert result([2.0, 3.0], 0.0, closeness=1e-3) == 0
    assert result([2.0, 3.0], 0.0, closeness=1e-7) == Flag.UNCERTAIN
    assert result([2.0, 3.0], 0.0, closeness=1e-9) == Flag.UNDETERMINED


def test_every_flag_has_a_sentence():
    everything = Flag(sum(flag for flag in Flag))
    assert len(everything.sentences) == len(Flag)
    assert all(sentence.endswith(".") and len(sentence) > 40 for sentence in everything.sentences)
    assert Flag(0).sentences == ()
    assert (Flag.GAP | Flag.CHANGED).sentences == (*Flag.GAP.sentences, *Flag.CHANGED.sentences)
