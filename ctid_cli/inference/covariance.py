"""Covariance of output-error estimates in white and in coloured noise, and warnings about ill-conditioning."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model, fit_residual_noise
from ctid_cli.text import listed

#: Beyond this condition number the inverse has no correct digit and is replaced by NaN.
LARGEST_CONDITION = 1e14


def white_noise_covariance(hessian: Array, squared_error: float, count: int) -> Array:
    r"""Return the covariance ``s^2 (sum psi psi')^-1`` with ``s^2 = sum eps^2 / (N - p)``.

    Valid for a converged estimate of a model that contains the system, and white output noise. Refined instrumental
    variables are then asymptotically efficient, so this is also the Cramér-Rao bound with the estimated variance.
    """
    size = hessian.shape[0]
    found = unit_inverse(hessian) if count > size else None
    if found is None:
        return np.full((size, size), np.nan)
    inverse, scale = found
    covariance: Array = inverse * np.outer(scale, scale) * squared_error / (count - size)
    return 0.5 * (covariance + covariance.T)


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


def condition_number(hessian: Array) -> float:
    """Return the condition number of ``sum psi psi'`` scaled to unit diagonal, independent of parameter units."""
    diagonal = np.diag(hessian)
    if not np.isfinite(hessian).all() or (diagonal <= 0).any():
        return float("inf")
    scale = 1.0 / np.sqrt(diagonal)
    values = np.linalg.eigvalsh(hessian * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 0 else float("inf")


def robust_covariance(
    psi: Sequence[Array], residuals: Sequence[Array], loop: SensitivityFunction | None = None
) -> tuple[Array, NoiseModel]:
    r"""Return the covariance ``M^-1 Sigma M^-1`` of an unweighted output-error estimate, and the coloured noise.

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
    """
    size, count = psi[0].shape[1], sum(block.size for block in residuals)
    found = unit_inverse(sum((block.T @ block for block in psi), np.zeros((size, size)))) if count > size else None
    if found is None:
        return np.full((size, size), np.nan), fit_noise_model(residuals, max_order=0)
    inverse, scale = found
    scaled = [block * scale for block in psi]
    if loop is None:
        noise = fit_residual_noise(scaled, residuals)
    else:
        noise = fit_residual_noise([loop.removed(block) for block in scaled], [loop.removed(e) for e in residuals])
        scaled = [loop.transposed(block) for block in scaled]
    sigma = sum((noise.covariance_of(block) for block in scaled), np.zeros((size, size)))
    return sandwich(inverse, scale, sigma), noise


#: A coefficient or delay whose standard error exceeds its magnitude by this factor is called undetermined.
LARGE_STANDARD_ERROR = 10.0
#: Beyond this (multiple) correlation, estimates are reported as hardly distinguishable.
CLOSE_TO_ONE = 0.999
#: Beyond this condition number of the scaled matrix ``sum psi psi'`` half the digits are lost: nearly singular.
NEARLY_SINGULAR = 1e8


def describe_conditioning(
    covariance: Array, estimates: Array, names: Sequence[str], condition_number: float, hessian: Array
) -> list[str]:
    """Return warnings about parameters that the data do not determine.

    Three rules. A standard error is not defined, or the condition number exceeds 1e8: the parameters with more than a
    tenth of the singular direction (unit diagonal) are named. A standard error exceeds ten times the magnitude of a
    coefficient or of the delay; initial states and offsets may be zero and are not checked. Two estimates have a
    correlation beyond 0.999, or one has such a multiple correlation with several others.
    """
    variances = np.diag(covariance)
    defined = bool(np.isfinite(covariance).all() and (variances > 0).all())
    sentences: list[str] = []
    singular = not condition_number <= NEARLY_SINGULAR
    if singular or not defined:
        group = [names[i] for i in _singular_direction(hessian)]
        what = listed(group) if 0 < len(group) < len(names) else "the parameters"
        number = f"condition number {condition_number:.1e}" if np.isfinite(condition_number) else "singular equations"
        start = f"These data do not determine {what} separately ({number})"
        if len(group) == 1:
            start = f"{what} has no detectable effect in these data ({number})"
        end = "their standard errors are not reliable" if defined else "no standard errors can be given"
        sentences.append(f"{start}; {end}.")
    if defined:
        errors = np.sqrt(variances)
        sentences += _large_errors(estimates, errors, names)
        # For singular equations the correlations would repeat the warning.
        sentences += [] if singular else _correlated(covariance / np.outer(errors, errors), names)
    return sentences


def _large_errors(theta: Array, errors: Array, names: Sequence[str]) -> Iterator[str]:
    for name, value, error in zip(names, theta, errors, strict=True):
        if re.fullmatch(r"[ab]\d+|delay", name) and error > LARGE_STANDARD_ERROR * abs(value):
            times = f"{error / abs(value):.2g} times its value" if value else "its value being zero"
            start = f"{name} = {value:.3g} has a standard error of {error:.3g}, {times}"
            yield f"{start}: these data do not even determine its sign."


def _correlated(correlation: Array, names: Sequence[str]) -> Iterator[str]:
    def warning(group: Sequence[int], how: str, combinations: str) -> str:
        several = [names[i] for i in group]
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
