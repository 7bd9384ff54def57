"""From parameters to frequencies and back, and how errors pass through."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.frequency_kernels import (
    cosine_sensitivities,
    flag_uncertain,
    propagate,
    real_roots,
    root_real_parts,
    still_doubtful,
)
from ctid_cli.frequency.regression import theta_of
from tests.frequency.signals import frequencies_of

FREQUENCIES = st.lists(st.floats(0.05, 3.0), min_size=1, max_size=8).map(sorted)


def roots_of(coefficients, kernel=root_real_parts):
    polynomial = np.array(coefficients, float)
    roots = np.empty(polynomial.size - 1)
    return kernel(polynomial, np.empty(polynomial.size), roots), roots


@given(FREQUENCIES, st.floats(0.1, 1.0))
def test_frequencies_survive_the_round_trip(omega, delay):
    omega = np.array(omega)
    assume(omega.size == 1 or np.diff(omega).min() > 0.2)
    found, flags = frequencies_of(theta_of(omega, delay), delay)
    # A root moves by the rounding of the coefficients over the product of its distances to the others.
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
    real, roots = roots_of(np.poly(wanted), real_roots)
    assert real
    np.testing.assert_allclose(roots, wanted, atol=1e-6)
    pair = complex(rng.uniform(-1, 1), rng.uniform(0.05, 1))
    coefficients = np.poly([*wanted[:-2], pair, pair.conjugate()]).real
    assert not roots_of(coefficients, real_roots)[0]
    real, roots = roots_of(coefficients)
    assert not real
    np.testing.assert_allclose(roots, np.sort(np.roots(coefficients).real)[::-1], atol=1e-6)


def test_double_roots_are_real_or_nearly():
    for n in (2, 3, 5):
        _, roots = roots_of(np.poly(np.full(n, 0.3)))
        np.testing.assert_allclose(roots, 0.3, atol=10 * 1e-16 ** (1 / n))


def test_complex_roots_are_flagged_and_their_real_part_is_used():
    omega, flags = frequencies_of([0.0, 0.25], 1.0)  # c = +-0.5 j
    assert flags == Flag.COMPLEX_ROOTS
    np.testing.assert_allclose(omega, np.pi / 2)


def test_roots_outside_the_bounds_are_clipped_and_flagged():
    delay = 0.5
    omega, flags = frequencies_of([-(1.5 - 0.2), 1.5 * -0.2], delay)
    assert flags == Flag.OUT_OF_BOUNDS
    np.testing.assert_allclose(omega, [0.0, np.arccos(-0.2) / delay])
    omega, flags = frequencies_of(theta_of([1.0, 4.0], delay), delay, lowest=1.5, highest=3.0)
    assert flags == Flag.OUT_OF_BOUNDS
    np.testing.assert_allclose(omega, [1.5, 3.0])
    omega, flags = frequencies_of(theta_of([1.6, 2.9], delay), delay, lowest=1.5, highest=3.0)
    assert flags == 0
    np.testing.assert_allclose(omega, [1.6, 2.9])


def test_parameters_that_are_no_numbers_give_no_numbers():
    omega, flags = frequencies_of([np.nan, 0.3], 0.5)
    assert np.isnan(omega).all()
    assert flags


@pytest.mark.parametrize("omega", [[2.0], [2.0, 3.0], [1.0, 2.0, 3.5], [0.5, 1.5, 2.5, 3.5, 4.2]])
def test_sensitivities_are_derivatives(omega):
    delay, n = 0.7, len(omega)
    theta = theta_of(omega, delay)
    out = np.empty((n, n))
    cosine_sensitivities(np.cos(np.array(omega) * delay), delay, np.empty(n), out)
    for k in range(n):
        change = 1e-7 * np.eye(n)[k]
        central = (frequencies_of(theta + change, delay)[0] - frequencies_of(theta - change, delay)[0]) / 2e-7
        np.testing.assert_allclose(out[:, k], central, rtol=1e-5, atol=1e-6)


def test_coincident_frequencies_are_infinitely_sensitive():
    out = np.empty((2, 2))
    cosine_sensitivities(np.array([0.3, 0.3]), 0.7, np.empty(2), out)
    assert np.isinf(out).all()


LONG = 1e3
NONE = np.zeros(2)


@pytest.mark.parametrize(
    ("uncertainty", "certain"),
    [
        ([0.09, 0.09], True),
        ([0.11, 0.0], False),  # a tenth of the distance to the next one
        ([0.0, 0.11], False),
        ([np.nan, 0.0], False),
        ([np.inf, 0.0], False),
    ],
)
def test_certain_means_a_tenth_of_the_distance_to_the_next(uncertainty, certain):
    assert (flag_uncertain(np.array([2.0, 3.0]), np.array(uncertainty), NONE, LONG, LONG) == 0) == certain
    # By the misfit, by rounding, or by both.
    assert (flag_uncertain(np.array([2.0, 3.0]), np.zeros(2), np.array(uncertainty), LONG, LONG) == 0) == certain
    half = 0.5 * np.array(uncertainty)
    assert (flag_uncertain(np.array([2.0, 3.0]), half.copy(), half, LONG, LONG) == 0) == certain


def test_a_frequency_near_zero_must_be_certain_too():
    assert flag_uncertain(np.array([0.5, 3.0]), np.array([0.06, 0.0]), NONE, LONG, LONG) == Flag.UNCERTAIN
    assert flag_uncertain(np.array([0.5, 3.0]), np.array([0.04, 0.0]), NONE, LONG, LONG) == 0


def test_short_data_make_a_misfit_weigh_more_but_not_rounding():
    omega = np.array([2.0, 6.0])  # a period of the first takes pi seconds
    # Either the estimate rests on less than a period, or less than two have passed.
    cases = ((4.0, LONG, 1.0), (np.pi, LONG, 1.0), (np.pi / 2, LONG, 32.0), (np.pi / 4, LONG, 1024.0))
    cases += ((np.pi, 2 * np.pi, 1.0), (np.pi, np.pi, 32.0), (np.pi / 2, 2 * np.pi, 32.0))
    for span, elapsed, factor in cases:
        uncertainty = np.array([1e-3, 0.0])
        flag_uncertain(omega, uncertainty, np.array([1e-4, 2e-4]), span, elapsed)
        np.testing.assert_allclose(uncertainty, [1e-3 * factor + 1e-4, 2e-4], rtol=1e-12)


def test_doubts_last_for_a_beat():
    for omega in ([1.0, 3.0], [4.0, 5.0], [5.0, 6.0]):
        assert still_doubtful(np.array(omega), 2 * np.pi - 1e-6)
        assert not still_doubtful(np.array(omega), 2 * np.pi + 1e-6)


def test_errors_of_parameters_add_up():
    out = np.empty(2)
    propagate(np.array([[1.0, -2.0], [0.0, 3.0]]), np.array([0.1, 0.2]), out)
    np.testing.assert_allclose(out, [0.5, 0.6])


def test_every_flag_has_a_sentence():
    everything = Flag(sum(flag for flag in Flag))
    assert len(everything.sentences) == len(Flag)
    assert all(sentence.endswith(".") and len(sentence) > 40 for sentence in everything.sentences)
    assert Flag(0).sentences == ()
    assert (Flag.GAP | Flag.CHANGED).sentences == (*Flag.GAP.sentences, *Flag.CHANGED.sentences)
