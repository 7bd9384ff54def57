"""Covariance of output-error estimates in white, coloured, rounded and changing noise, and ill-conditioning."""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.inference.noise_model import STEP, NoiseModel, fit_residual_noise, row_blocks
from ctid_cli.inference.residual_tests import orthonormal
from ctid_cli.text import listed

#: Beyond this condition number the inverse has no correct digit and is replaced by NaN.
LARGEST_CONDITION = 1e14
#: Significance level at which a changing variance of the innovations is allowed for. Measured, 200 samples, deviation
#: proportional to the output: coverage of the gain 90, 93 and 96 % at .01, .05 and 1.
CHANGING = 0.05
#: Fewest samples for each parameter in the test of a changing variance, and fewest on which a tested column depends.
SAMPLES_PER_PARAMETER, FEWEST = 5, 10
#: Least share of the expected power of the residuals for which a noise is not scaled down. Measured: .4 to 2 for noise
#: of the order of the model, 1e-6 to .02 for smooth disturbances of a building, where errors were 5 to 500 times too
#: large.
LEAST_POWER = 0.3
#: Largest number of harmonics of a rounding error.
HARMONICS = 50


class Rounding(NamedTuple):
    """Step of a rounded output [output unit], and the fitted output at the used samples [output unit]."""

    step: float
    output: Array


class Dispersion(NamedTuple):
    r"""Covariance of an estimate, and the uncertainty of this covariance.

    A quantity with the gradient g has the variance ``V = g'Cg``. With W_k the changes of C by one standard deviation of
    the independent parameters of the noise, V has the variance ``sum_k (g'W_k g)^2``, and the quantity over its
    standard error Student's t distribution with about

    .. math:: \nu = \frac{2 V^2}{\sum_k (g' W_k g)^2}

    degrees of freedom [1]_, which are N - p in white noise.

    References
    ----------
    .. [1] F. E. Satterthwaite, "An approximate distribution of estimates of variance components", *Biometrics
       Bulletin* 2 (1946) 110-114. doi:10.2307/3002019
    """

    #: Shape (p, p).
    covariance: Array
    #: W, shape (k, p, p); empty if C is known.
    variation: Array
    noise: NoiseModel | None = None
    #: Whether it allows for a changing variance, and for the error of rounding the output.
    changing: bool = False
    rounded: bool = False

    @classmethod
    def scaled(cls, covariance: Array, freedom: float) -> "Dispersion":
        """Return that of a covariance known up to a factor, estimated with given degrees of freedom."""
        if not np.isfinite(freedom):
            return cls(covariance, np.zeros((0, *covariance.shape)))
        return cls(covariance, np.sqrt(2.0 / max(freedom, 1.0)) * covariance[None])


def undefined(size: int) -> Dispersion:
    """Return an undefined dispersion."""
    return Dispersion.scaled(np.full((size, size), np.nan), np.inf)


def white_noise_dispersion(hessian: Array, squared_error: float, count: int) -> Dispersion:
    r"""Return the covariance ``s^2 (sum psi psi')^-1`` with ``s^2 = sum eps^2 / (N - p)``.

    Valid for a converged estimate of a model that contains the system, and white output noise. Refined instrumental
    variables are then asymptotically efficient, so this is also the Cramér-Rao bound with the estimated variance.
    """
    size = hessian.shape[0]
    found = unit_inverse(hessian) if count > size else None
    if found is None:
        return undefined(size)
    inverse, scale = found
    covariance: Array = inverse * np.outer(scale, scale) * squared_error / (count - size)
    return Dispersion.scaled(0.5 * (covariance + covariance.T), count - size)


def sandwich(inverse: Array, scale: Array, middle: Array, left: float = 1.0) -> Array:
    """Return ``M^-1 Sigma M^-1`` over a divisor, from the result of `unit_inverse` for M and from scaled Sigma."""
    covariance: Array = inverse @ middle @ inverse * np.outer(scale, scale) / left
    return 0.5 * (covariance + covariance.T)


def unit_inverse(hessian: Array) -> tuple[Array, Array] | None:
    """Return the inverse of ``sum psi psi'`` scaled to unit diagonal, and the scales of psi; None if singular."""
    if not condition_number(hessian) <= LARGEST_CONDITION:
        return None
    scale = 1.0 / np.sqrt(np.diag(hessian))
    return np.asarray(np.linalg.inv(hessian * np.outer(scale, scale))), scale


def determined_directions(hessian: Array) -> tuple[Array, Array] | None:
    """Return the directions that data determine, and those that they do not; None if they determine all.

    Each changes the output by one, or by none, in the sum of squares; shapes (p, r) and (p, p - r).
    """
    diagonal = np.diag(hessian)
    if condition_number(hessian) <= LARGEST_CONDITION or not np.isfinite(hessian).all():
        return None
    scale = np.divide(1.0, np.sqrt(diagonal), out=np.ones(diagonal.size), where=diagonal > 0)
    values, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    kept = values * LARGEST_CONDITION > values[-1] if values[-1] > 0.0 else np.zeros(values.size, dtype=bool)
    return scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]), scale[:, None] * vectors[:, ~kept]


def condition_number(hessian: Array) -> float:
    """Return the condition number of ``sum psi psi'`` scaled to unit diagonal, independent of parameter units."""
    diagonal = np.diag(hessian)
    if not hessian.size:
        return 1.0
    if not np.isfinite(hessian).all() or (diagonal <= 0).any():
        return float("inf")
    scale = 1.0 / np.sqrt(diagonal)
    values = np.linalg.eigvalsh(hessian * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 0 else float("inf")


def robust_dispersion(
    psi: Sequence[Array],
    residuals: Sequence[Array],
    loop: SensitivityFunction | None = None,
    rounding: Sequence[Rounding | None] = (),
) -> Dispersion:
    r"""Return the covariance ``M^-1 Sigma M^-1`` of an unweighted output-error estimate in coloured noise.

    With noise v independent of the input (open loop) and ``M = sum psi psi'``,

    .. math:: \Sigma = \operatorname{cov} \sum_t \psi_t v_t
              = \sum_\tau R_v(\tau) \sum_t \psi_{t+\tau} \psi_t'.

    The noise is an autoregression by restricted maximum likelihood (:func:`fit_residual_noise`), common to all
    experiments, and ``R_v`` its autocovariance. White residuals give ``s^2 M^-1``.

    Lags count samples, on irregular clocks and with missing samples too: noise in continuous time that is sampled at
    random instants, independent of it, is stationary from sample to sample. Measured for such clocks, first- to
    third-order systems, noise of up to 50 samples' time constant: .89 to 1.04 of the true deviation. Where intervals of
    .02 and .2 s come in bursts of 100 samples it is .69 to 1.15.

    With feedback from the output to the input the noise is not independent of psi, and the formula is not valid. It is
    valid for the output error of a simulated loop, whose input is the reference. With its sensitivity function S, that
    error is S v, the autoregression is that of v, and ``sum psi S v = sum (S' psi) v``.

    A variance of the innovations that changes with the sensitivities, by Koenker's test, is replaced by their squares
    (:func:`_changing`), and the error of a coarsely rounded output is added (:func:`_of_rounding`).
    """
    size, count = psi[0].shape[1], sum(block.size for block in residuals)
    hessian = sum((block.T @ block for block in psi), np.zeros((size, size)))
    found = unit_inverse(hessian) if 0 < size < count else None
    if found is None:
        return undefined(size)
    inverse, scale = found
    scaled, errors = [block * scale for block in psi], list(residuals)
    rows = [block @ inverse for block in scaled]
    if loop is not None:
        errors = [loop.removed(e) for e in residuals]
        scaled, rows = [loop.removed(block) for block in scaled], [loop.transposed(block) for block in rows]
    noise = fit_residual_noise(scaled, errors)

    def covariance(noise: NoiseModel) -> Array:
        return np.asarray(np.sum([noise.covariance_of(block) for block in rows], axis=0))

    share = min(1.0, _share_of_expected(scaled, errors, noise) / LEAST_POWER)
    middle = share * covariance(noise)
    with np.errstate(invalid="ignore"):  # near a unit root
        along = [share * (covariance(high) - covariance(low)) / (2 * STEP) for low, high in noise.displaced]
    changing = _changing(rows, scaled, errors, middle, noise) if share == 1.0 else None
    if changing is None:
        variation = [*along, middle * np.sqrt(2.0 / noise.freedom)]
    else:
        middle, variation = middle + changing[0], [*along, *changing[1]]
    added = [_of_rounding(block, one, noise) for block, one in zip(rows, rounding, strict=False) if one is not None]
    rounded = any(np.trace(each) > 0.01 * np.trace(middle) for each in added)
    units = np.outer(scale, scale)
    whole = np.sum([middle, *added], axis=0) * units
    return Dispersion(0.5 * (whole + whole.T), np.array(variation) * units, noise, changing is not None, rounded)


def _share_of_expected(columns: Sequence[Array], errors: Sequence[Array], noise: NoiseModel) -> float:
    r"""Return the power of the residuals over that expected for a noise, ``e'e / tr P V P`` with ``P = 1 - Psi Psi^+``.

    The likelihood of a smooth noise mostly depends on high frequencies; an autoregression of another noise may have far
    more power at the low ones, on which the estimate depends, than the residuals have there.
    """
    if not noise.order:
        return 1.0
    weights = orthonormal(np.concatenate(columns))
    removed = sum(float(np.trace(noise.covariance_of(block @ weights))) for block in columns)
    expected = sum(e.size for e in errors) * float(noise.first_autocovariances[0]) - removed
    return sum(float(e @ e) for e in errors) / expected if expected > 0.0 else 1.0


def _changing(
    rows: Sequence[Array], columns: Sequence[Array], errors: Sequence[Array], covariance: Array, noise: NoiseModel
) -> tuple[Array, list[Array]] | None:
    r"""Return what a changing variance of the innovations adds to a covariance, and its variation; None without change.

    The estimate is ``sum_t a_t v_t = sum_s g_s e_s`` with the innovations e and the rows g of
    :meth:`NoiseModel.weights_of`. Koenker's test regresses ``e^2`` on squares of columns of g [1]_: other changes of
    the variance do not matter. The columns are orthonormal, along the principal axes of their fourth moments, which do
    not depend on the parametrisation. The innovations of the residuals are ``e_s - w_s' sum g e``, with those w of
    the sensitivities, and have the variance ``s^2 (1 - 2 w'g) + w'Cw``. Squared innovations of the estimate without
    each sample (HC3 [2]_) then replace their variance; that of a square of a normal variable is 2/3 of its square.

    References
    ----------
    .. [1] R. Koenker, "A note on studentizing a test for heteroscedasticity", *Journal of Econometrics* 17 (1981)
       107-112. doi:10.1016/0304-4076(81)90062-2
    .. [2] J. G. MacKinnon and H. White, "Some heteroskedasticity-consistent covariance matrix estimators with improved
       finite sample properties", *Journal of Econometrics* 29 (1985) 305-325. doi:10.1016/0304-4076(85)90158-7
    """
    from scipy.special import chdtrc  # slow to import

    size, order, variance = rows[0].shape[1], noise.order, noise.innovation_variance
    g = np.concatenate([noise.weights_of(block)[order:] for block in rows])
    squares = np.concatenate([noise.innovations(e)[order:] for e in errors]) ** 2
    if squares.size < SAMPLES_PER_PARAMETER * size or not variance > 0.0:
        return None
    basis = np.linalg.qr(g)[0]
    leverage = np.sum(basis**2, axis=1)
    axes = np.linalg.eigh((basis * leverage[:, None]).T @ basis)[1]
    slopes = np.concatenate([np.column_stack([noise.innovations(x)[order:] for x in block.T]) for block in columns])
    expected = 1.0 + np.sum(slopes * (slopes @ covariance / variance - 2.0 * g), axis=1)
    squares = squares / np.maximum(expected, 0.1)
    tested = (basis @ axes) ** 2
    tested = tested[:, np.sum(tested**2, axis=0) * FEWEST < 1.0]
    regressors = np.column_stack((np.ones(squares.size), squares.size * tested))
    weights, _, rank, _ = np.linalg.lstsq(regressors, squares, rcond=1e-8)
    spread = float(np.sum((squares - squares.mean()) ** 2))
    explained = spread - float(np.sum((squares - regressors @ weights) ** 2))
    if not (spread > 0.0 and rank > 1 and chdtrc(rank - 1, squares.size * explained / spread) < CHANGING):
        return None
    without = squares / np.maximum(1.0 - leverage, 0.1)
    i, j = np.triu_indices(size)
    products = np.zeros((i.size, i.size))
    for block in row_blocks(len(g)):
        own = g[block][:, i] * g[block][:, j] * without[block, None]
        products += own.T @ own
    values, vectors = np.linalg.eigh(2.0 / 3.0 * products)
    variation = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > 1e-8 * values[-1]:
            change = np.zeros((size, size))
            change[i, j] = change[j, i] = np.sqrt(value) * vector
            variation.append(change)
    return (g * (without - variance)[:, None]).T @ g, variation


def _of_rounding(rows: Array, rounding: Rounding, noise: NoiseModel) -> Array:
    r"""Return what the error of rounding the output adds to a covariance.

    The error is a function of the output x before rounding. With step q and an unknown position of the levels, errors
    at two samples have the covariance

    .. math:: \frac{q^2}{2 \pi^2} \sum_{k \ge 1} \frac{1}{k^2} \cos\Big(2 \pi k \frac{x_t - x_s}{q}\Big)
              \exp\Big(-4 \pi^2 k^2 \frac{\sigma^2}{q^2}\Big)

    where sigma is the standard deviation of the noise before rounding, which makes the error independent of x; without
    noise the sum is ``(q^2/2) B_2(\{|x_t - x_s|/q\})`` with Bernoulli's polynomial ``z^2 - z + 1/6`` [1]_.

    References
    ----------
    .. [1] B. Widrow and I. Kollár, *Quantization Noise*, Cambridge University Press, 2008.
    """
    step, found = rounding.step, np.zeros((rows.shape[1],) * 2)
    # The residuals contain both errors.
    before = max(float(noise.first_autocovariances[0]) - step**2 / 12.0, 0.0)
    for k in range(1, HARMONICS + 1):
        damping = np.exp(-((2.0 * np.pi * k) ** 2) * before / step**2)
        if damping < 1e-3:
            break
        turned = np.exp(2j * np.pi * k / step * rounding.output) @ rows
        found += damping / k**2 * np.outer(turned, turned.conj()).real
    return step**2 / (2.0 * np.pi**2) * found


#: A coefficient or delay whose standard error exceeds its magnitude by this factor is called undetermined.
LARGE_STANDARD_ERROR = 10.0
#: Beyond this (multiple) correlation, estimates are reported as hardly distinguishable.
CLOSE_TO_ONE = 0.999
#: Beyond this condition number of the scaled matrix ``sum psi psi'`` half the digits are lost: nearly singular.
NEARLY_SINGULAR = 1e8


def describe_conditioning(covariance: Array, names: Sequence[str], hessian: Array) -> list[str]:
    """Return warnings about parameters that the data do not determine.

    Names and ``sum psi psi'`` are those of the free directions. Two rules. A standard error is not defined, or the
    condition number exceeds 1e8: the directions with more than a tenth of the singular one (unit diagonal) are named.
    Two estimates have a correlation beyond 0.999, or one has such a multiple correlation with several others.
    """
    condition = condition_number(hessian)
    defined = bool(
        covariance.shape == hessian.shape and np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()
    )
    if not condition <= NEARLY_SINGULAR or not defined:
        group = list(dict.fromkeys(names[i] for i in _singular_direction(hessian)))
        what = listed(group) if 0 < len(group) < len(set(names)) else "the parameters"
        number = f"condition number {condition:.1e}" if np.isfinite(condition) else "singular equations"
        start = f"These data do not determine {what} separately ({number})"
        if len(group) == 1:
            start = f"{what} has no detectable effect in these data ({number})"
        end = "their standard errors are not reliable" if defined else "no standard errors can be given"
        return [f"{start}; {end}."]
    errors = np.sqrt(np.diag(covariance))
    return list(_correlated(covariance / np.outer(errors, errors), names))


def _correlated(correlation: Array, names: Sequence[str]) -> Iterator[str]:
    """Yield which directions are nearly parallel."""

    def warning(group: Sequence[int], how: str, combinations: str) -> str:
        several = list(dict.fromkeys(names[i] for i in group))
        start = f"These data can hardly distinguish {listed(several)} ({how}): only"
        return f"{start} {combinations} well determined.{_of_delay(several)}"

    size = len(names)
    pairs = [(j, i) for i in range(size) for j in range(i) if abs(correlation[i, j]) > CLOSE_TO_ONE]
    for correlated in _connected(pairs):
        if len(correlated) == 2:
            yield warning(correlated, f"correlation {correlation[tuple(correlated)]:.5f}", "a combination of them is")
        else:
            yield warning(correlated, f"correlations above {CLOSE_TO_ONE}", "combinations of them are")
    with np.errstate(invalid="ignore", divide="ignore"):
        multiple = np.sqrt(1.0 - 1.0 / np.diag(np.linalg.inv(correlation)))
    paired = {index for pair in pairs for index in pair}
    group = [i for i in range(size) if multiple[i] > CLOSE_TO_ONE and i not in paired]
    if len(group) > 1:
        yield warning(group, f"multiple correlations above {CLOSE_TO_ONE}", "combinations of them are")


def _connected(pairs: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Return the groups of numbers that are connected by pairs."""
    groups: list[set[int]] = []
    for pair in pairs:
        joined = set(pair).union(*(group for group in groups if group.intersection(pair)))
        groups = [group for group in groups if not group & joined] + [joined]
    return [sorted(group) for group in groups]


def _singular_direction(hessian: Array) -> list[int]:
    """Return the parameters with more than a tenth of the singular direction; none if unknown."""
    diagonal = np.diag(hessian)
    if not np.isfinite(hessian).all():
        return []
    if (diagonal <= 0).any():
        return np.flatnonzero(diagonal <= 0).tolist()
    scale = 1.0 / np.sqrt(diagonal)
    direction = np.linalg.eigh(hessian * np.outer(scale, scale))[1][:, 0]
    return np.flatnonzero(np.abs(direction) > 0.1).tolist()


def _of_delay(group: Sequence[str]) -> str:
    """Return why a delay can hardly be distinguished from coefficients."""
    if "delay" not in group or not any(re.fullmatch(r"b\d+", name) for name in group):
        return ""
    return " The input hardly shows when the response begins."
