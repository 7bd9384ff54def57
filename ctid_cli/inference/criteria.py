"""Criteria for choosing between models fitted to the same samples."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array


@dataclass(frozen=True)
class InformationCriteria:
    """Criteria of one fit; smaller is better, and only differences between fits to the same samples mean anything."""

    #: Akaike's, the small-sample corrected, and the Bayesian criterion [-].
    aic: float
    aicc: float
    bic: float
    #: Final prediction error [output unit^2].
    fpe: float
    count: int
    parameters: int


def information_criteria(squared_error: float, count: int, parameters: int) -> InformationCriteria:
    r"""AIC, AICc, BIC and FPE of an output-error model with white Gaussian noise.

    With ``V = squared_error / N``:

    .. math::
        AIC &= N \ln V + 2 p, \\
        AICc &= AIC + \frac{2 (p + 1)(p + 2)}{N - p - 2}, \\
        BIC &= N \ln V + p \ln N, \\
        FPE &= V \frac{N + p}{N - p}.

    Constants common to all models are left out: ``N (ln 2 pi + 1)``, and what counting the noise variance as one more
    parameter would add. The correction of AICc does count it, because it is derived for an unknown variance. MATLAB's
    ``aic`` adds ``N (ln 2 pi + 1)`` and corrects with p in the place of ``p + 1``.

    The criteria take residuals as independent: with coloured residuals all of them favour too many parameters.
    """
    undefined = float("nan")
    variance = squared_error / count
    fit = count * float(np.log(variance)) if variance > 0 else float("-inf")
    aic = fit + 2 * parameters
    spare = count - parameters - 2
    aicc = aic + 2 * (parameters + 1) * (parameters + 2) / spare if spare > 0 else undefined
    bic = fit + parameters * float(np.log(count))
    fpe = variance * (count + parameters) / (count - parameters) if count > parameters else undefined
    return InformationCriteria(aic, aicc, bic, fpe, count, parameters)


def r_t_squared(residuals: Array, output: Array) -> float:
    """``R_T^2 = 1 - s_e^2 / s_y^2``, the coefficient of determination of the simulated output by variances.

    Both variances are taken about the means, as in CONTSID and CAPTAIN: unlike :func:`r_squared`, it does not see a
    constant error.
    """
    output_variance = float(np.var(output))
    return 1.0 - float(np.var(residuals)) / output_variance if output_variance > 0 else float("nan")


def young_information_criterion(residuals: Array, output: Array, estimates: Array, covariance: Array) -> float:
    r"""Young's criterion: fit and relative parameter errors in one number; the more negative the better.

    .. math:: YIC = \ln \frac{s_e^2}{s_y^2} + \ln NEVN, \qquad NEVN = \frac{1}{p} \sum_i \frac{s^2 p_{ii}}{\theta_i^2},

    natural logarithms, variances about the means. A delay is one of the parameters if it is estimated.
    """
    output_variance, variances = float(np.var(output)), np.diag(covariance)
    if not output_variance > 0 or not np.isfinite(variances).all():
        return float("nan")
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = np.mean(variances / estimates**2)
        return float(np.log(np.var(residuals) / output_variance) + np.log(normalised))
