"""The delay regression and its mixing: closed forms against products of operators, determinants against numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial

from ctid_cli.frequency.delay_regression import delay_table, theta_of, whole_delay
from ctid_cli.frequency.drem import mix
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from tests.frequency.signals import AMPLITUDES, OMEGA, regression_rows, tones

INTERVAL = 0.002
LAG, SPACING = 200, 150


def mixed(matrix):
    """Psi and Delta of one stacked regression."""
    [row] = mix([line[None, :] for line in matrix])
    return row[:-1], row[-1]


def determinant_from_tones(parts, omega, lag, spacing, interval):
    """Determinant of the stacked regressors by its closed form, of rows 0, ..., n - 1; NaN where one is missing.

    ``phi(t) = 2^n sum_i [c_i^(n-1) ... c_i 1] y_i(t - n h)``, hence
    ``det = 2^(n n) det[y_i(t - n h - j d)] prod_(i<j) (c_i - c_j)``.
    """
    count, n = parts.shape
    c = np.cos(np.asarray(omega) * lag * interval)
    vandermonde = np.prod([c[i] - c[j] for i in range(n) for j in range(i + 1, n)])
    first = 2 * n * lag + (n - 1) * spacing
    instants = np.arange(first, count)
    stacked = parts[instants[:, None] - n * lag - spacing * np.arange(n)]
    determinant = np.full(count, np.nan)
    determinant[first:] = 2.0 ** (n * n) * vandermonde * np.linalg.det(stacked)
    return determinant


@pytest.mark.parametrize("n", range(1, 9))
def test_table_holds_the_products_of_delay_operators(n):
    # psi = -(1 + Z^2)^n, phi_k = (2 Z)^k (1 + Z^2)^(n - k), multiplied out by numpy.
    table = delay_table(n)
    for k in range(n + 1):
        product = polynomial.polymul(polynomial.polypow([0.0, 2.0], k), polynomial.polypow([1.0, 0.0, 1.0], n - k))
        expected = np.zeros(2 * n + 1)
        expected[: product.size] = product
        np.testing.assert_array_equal(table[k - 1] if k else -table[n], expected)


@pytest.mark.parametrize("n", range(1, 6))
def test_regression_holds_from_2nh_on_and_not_before(n):
    y = tones(n, 6000, INTERVAL).sum(axis=1)
    psi, phi = regression_rows(y, n, LAG)
    first = 2 * n * LAG
    assert np.isnan(psi[:first]).all()
    assert np.isfinite(psi[first:]).all()
    residual = (psi - phi @ theta_of(OMEGA[n], LAG * INTERVAL))[first:]
    assert np.abs(residual).max() <= 1e-12 * 2**n * AMPLITUDES[:n].sum()


@pytest.mark.parametrize("n", range(1, 6))
def test_rows_that_are_filtered_are_those_of_the_products(n):
    y = tones(n, 2 * n * 7 + 40).sum(axis=1)
    psi, phi = regression_rows(y, n, 7)
    rows = RestartingLeastSquares(tones=n, h=0.07).start(0.01).rows(y)[0]
    np.testing.assert_allclose(rows, np.column_stack([phi, psi]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("length", "difference"), [(0.0, 0.0), (1.0, 0.0), (0.0, 0.7), (1.0, 0.7), (0.013, 0.01)])
def test_prefilter_is_a_hann_window_and_a_difference(length, difference):
    weights = RestartingLeastSquares(tones=1, h=0.4, prefilter=length, difference=difference).weights(0.01)
    order, shift = round(length / 0.01), round(difference / 0.01)
    assert weights.size == order + shift + 1
    window = np.hanning(order + 3)[1:-1]
    expected = np.convolve(window / window.sum(), [1.0, *[0.0] * (shift - 1), -1.0] if shift else [1.0])
    np.testing.assert_allclose(weights, expected, atol=1e-15)


@pytest.mark.parametrize("n", range(1, 6))
def test_determinant_has_its_closed_form(n):
    parts = tones(n, 8000, INTERVAL)
    psi, phi = regression_rows(parts.sum(axis=1), n, LAG)
    expected = determinant_from_tones(parts, OMEGA[n], LAG, SPACING, INTERVAL)
    first = 2 * n * LAG + (n - 1) * SPACING
    assert np.isnan(expected[:first]).all()
    instants = np.arange(first, 8000, 13)
    found = []
    for k in instants:
        stack = [[*phi[k - j * SPACING], psi[k - j * SPACING]] for j in range(n)]
        found.append(mixed(np.array(stack))[1])
    rms = np.sqrt(np.mean(expected[instants] ** 2))
    assert rms > 0
    assert np.abs(np.array(found) - expected[instants]).max() <= 1e-7 * rms


def test_mean_square_of_the_determinant_for_two_tones():
    # 256 (c1 - c2)^2 A1^2 A2^2 [sin^2((w1 + w2) d/2) + sin^2((w1 - w2) d/2)]/2, averaged over whole periods.
    h, d = 0.1, 0.13
    count = round(20 * 2 * np.pi / 0.001)
    t = 0.001 * np.arange(count + 330)
    det = determinant_from_tones(np.column_stack([np.sin(2 * t), np.cos(3 * t)]), [2.0, 3.0], 100, 130, 0.001)
    c = np.cos(np.array([2.0, 3.0]) * h)
    expected = 128 * (c[0] - c[1]) ** 2 * (np.sin(2.5 * d) ** 2 + np.sin(0.5 * d) ** 2)
    assert np.nanmean(det[-count + 200 :] ** 2) == pytest.approx(expected, rel=2e-3)
    assert expected == pytest.approx(0.00831, abs=5e-6)


@given(st.integers(1, 8), st.integers(0, 2**31))
def test_mixing_is_cramers_rule(n, seed):
    matrix = np.random.default_rng(seed).standard_normal((n, n + 1))
    right, delta = mixed(matrix)
    scale = np.prod(np.linalg.norm(matrix, axis=1))
    assert delta == pytest.approx(np.linalg.det(matrix[:, :n]), rel=1e-9, abs=1e-12 * scale)
    np.testing.assert_allclose(matrix[:, :n] @ right, delta * matrix[:, n], atol=1e-11 * scale)


def test_mixing_of_a_singular_matrix_is_finite():
    # Two equal rows of the regressors, different right-hand sides: no theta at all, but finite numbers.
    right, delta = mixed(np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 5.0]]))
    assert delta == 0.0
    np.testing.assert_array_equal(right, [-4.0, 2.0])


def test_parameters_are_coefficients_of_the_cosines():
    assert theta_of([2.0, 3.0], 0.1) == pytest.approx(
        [-(np.cos(0.2) + np.cos(0.3)), np.cos(0.2) * np.cos(0.3)], rel=1e-15
    )


def test_sign_of_the_regressand():
    # With the other sign the two tones 2 and 3 rad/s, h = 0.1 s, would decode to [11.58, 31.4].
    t = 0.001 * np.arange(3000)
    psi, phi = regression_rows(np.sin(2 * t) + np.cos(3 * t), 2, 100)
    theta = np.linalg.lstsq(phi[400:], psi[400:], rcond=None)[0]
    np.testing.assert_allclose(theta, theta_of([2.0, 3.0], 0.1), rtol=1e-9)


@pytest.mark.parametrize(("delay", "interval", "count"), [(0.1, 0.001, 100), (0.1, 0.003, 33), (0.006, 0.01, 1)])
def test_delays_are_whole_intervals(delay, interval, count):
    assert whole_delay("h", delay, interval) == count


def test_delays_below_half_an_interval_are_refused():
    with pytest.raises(ValueError, match=r"h = 0.004 s is shorter than half a sampling interval of 0.01 s"):
        whole_delay("h", 0.004, 0.01)
