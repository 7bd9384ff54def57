r"""The noise model that is estimated with a plant, and Hausman's test of the plant against its output-error estimate.

Both estimates of the plant are consistent if the models of plant and noise are correct; otherwise their asymptotic
biases differ. Since the joint estimate is efficient, their difference has the covariance ``C_oe - C_joint`` [1]_.

References
----------
.. [1] J. A. Hausman, "Specification tests in econometrics", *Econometrica* 46 (1978) 1251-1271. doi:10.2307/1913827
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import OptionError
from ctid_cli.inference.innovations import MOST_GIVEN, NoiseFit, Orders, coefficient_slopes, sampled, steps_of
from ctid_cli.inference.residual_tests import orthonormal
from ctid_cli.signals.noise import ArmaNoise

#: Significance level of Hausman's test.
LEVEL = 0.01
#: Directions in which the output-error variance exceeds the joint one by at most this share are not tested.
NO_GAIN = 0.05
#: Directions of the noise coefficients below this share of the greatest one cannot be distinguished.
RANK = 1e-6
#: Eigenvalues of a correlation matrix below this share of the greatest one are rounding errors.
ROUNDING = 1e-10


def orders_of(noise_model: str) -> Orders | None:
    """Return the orders of D and C of an option, (0, 0) for white noise; None for automatic choice."""
    if noise_model in ("white", "auto"):
        return None if noise_model == "auto" else (0, 0)
    found = re.fullmatch(r"arma:(\d{1,2}),(\d{1,2})", noise_model) if isinstance(noise_model, str) else None
    if found is None or max(orders := (int(found[1]), int(found[2]))) > MOST_GIVEN:
        allowed = f"white, auto or arma:P,Q with P poles and Q zeros, 0 to {MOST_GIVEN}, for example arma:2,1"
        raise OptionError("noise_model", f"noise_model must be {allowed}; got {noise_model!r}")
    return orders


class Hausman(NamedTuple):
    """F test of the difference of two estimates of the plant."""

    statistic: float
    freedom: int
    #: Probability of a larger statistic if both models are correct; NaN if they have the same accuracy.
    p_value: float


#: No test.
UNTESTED = Hausman(0.0, 0, np.nan)


def hausman(difference: Array, robust: Array, efficient: Array, degrees_of_freedom: float) -> Hausman:
    """Test a difference of estimates in the directions in which one is more accurate than the other.

    The degrees of freedom of the less accurate covariance are those of Student's t of intervals. Measured at the level
    of 1 %, 600 samples of a noise with two poles at .99: 5 % false alarms by the chi-square distribution, none by F;
    58 % of models with a pole too few are detected by either.
    """
    from scipy.special import fdtrc  # slow to import

    if not (np.isfinite(robust).all() and np.isfinite(efficient).all() and difference.size):
        return UNTESTED
    # In units of the efficient standard errors, independent of parameter units.
    scale = 1.0 / np.sqrt(np.diag(efficient))
    lengths, axes = np.linalg.eigh(efficient * np.outer(scale, scale))
    kept = lengths > ROUNDING * lengths[-1]
    basis = scale[:, None] * axes[:, kept] / np.sqrt(lengths[kept])
    values, vectors = np.linalg.eigh(basis.T @ robust @ basis)
    gained = values > 1.0 + NO_GAIN
    along = vectors.T @ basis.T @ difference
    freedom = int(gained.sum())
    if not freedom:
        return UNTESTED
    statistic = float(np.mean(along[gained] ** 2 / (values[gained] - 1.0)))
    return Hausman(statistic, freedom, float(fdtrc(freedom, degrees_of_freedom, statistic)))


def noise_covariance(fit: NoiseFit, errors: Sequence[Array], used: Sequence[BoolArray]) -> Array:
    """Return the covariance of the coefficients ``d_1 ... d_P, c_1 ... c_Q``; it is large for a common factor."""
    slopes = coefficient_slopes(fit.noise, errors, [steps_of(use) for use in used])
    return np.asarray(np.exp(fit.deviance / fit.samples) * np.linalg.pinv(slopes.T @ slopes, hermitian=True))


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """Noise of a joint fit, and the output-error fit for comparison."""

    #: ``v = C(q)/D(q) e``, with the variance of e [output unit^2].
    noise: ArmaNoise
    #: Covariance of the coefficients ``d_1 ... d_P, c_1 ... c_Q``, shape (P + Q, P + Q).
    covariance: Array = field(repr=False)
    #: ``-2 ln L`` of the joint fit up to a constant: N times the logarithm of the variance of e.
    deviance: float
    #: Whether the orders were chosen by BIC.
    chosen: bool
    #: Parameters of the output-error fit, and their standard errors for coloured noise, shape (p,).
    output_error: Array = field(repr=False)
    output_error_errors: Array = field(repr=False)
    #: Fit of its simulated output [%].
    output_error_fit: float
    #: Of the difference of the coefficients and the delay.
    test: Hausman = UNTESTED

    @property
    def orders(self) -> Orders:
        """Numbers of coefficients of D and C."""
        return len(self.noise.denominator) - 1, len(self.noise.numerator) - 1

    @property
    def formula(self) -> str:
        """The noise model, each coefficient with its standard error in brackets."""
        errors, (p, _) = np.sqrt(np.diag(self.covariance)), self.orders
        d, c = _polynomial(self.noise.denominator, errors[:p]), _polynomial(self.noise.numerator, errors[p:])
        return f"v = C/D e, D = {d}, C = {c}"

    @property
    def differs(self) -> bool:
        """Whether the estimates of the plant differ significantly."""
        return self.test.p_value < LEVEL

    def prediction_errors(self, errors: Sequence[Array], used: Sequence[BoolArray], ahead: int) -> list[Array]:
        """Return the ``ahead``-step prediction errors from output errors."""
        each = zip(sampled(self.noise, used), errors, strict=True)
        return [e - noise.predicted(e, ahead) for noise, e in each]

    def whitened(
        self, psi: Sequence[Array], errors: Sequence[Array], used: Sequence[BoolArray]
    ) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return whitened sensitivities, projected off those of the noise coefficients, and innovations."""
        noises = sampled(self.noise, used)
        innovations = tuple(noise.whitened(e) for noise, e in zip(noises, errors, strict=True))
        columns = np.concatenate([noise.whitened(block) for noise, block in zip(noises, psi, strict=True)])
        of_noise = coefficient_slopes(self.noise, errors, [noise.steps for noise in noises])
        if of_noise.shape[1]:
            basis = of_noise @ orthonormal(of_noise, RANK)
            columns = columns - basis @ (basis.T @ columns)
        return tuple(np.split(columns, np.cumsum([e.size for e in errors])[:-1])), innovations


def _polynomial(coefficients: Sequence[float], errors: Array) -> str:
    """Return a polynomial in q^-1 with the standard errors of its coefficients."""
    each = zip(coefficients[1:], errors.tolist(), strict=True)
    terms = (f" {'-' if c < 0 else '+'} {abs(c):.4g}({e:.1g}) q^-{k}" for k, (c, e) in enumerate(each, start=1))
    return "1" + "".join(terms)
