"""Standard errors and intervals of an estimate, for white or coloured noise."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.inference.covariance import (
    Dispersion,
    Rounding,
    determined_directions,
    robust_dispersion,
    undefined,
    white_noise_dispersion,
)
from ctid_cli.inference.innovations import SampledNoise
from ctid_cli.inference.intervals import student_quantiles
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.residual_tests import all_white
from ctid_cli.inference.sensitivities import Parametric
from ctid_cli.progress import report, reported
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record
from ctid_cli.text import span

Number = TypeVar("Number", np.float64, np.complex128)
#: Fixed seed of the noise, for reproducible results.
SEED = 20140801
#: Reported step of a bootstrap; and a function that is called with the number of finished draws and their total.
DRAW = "bootstrap draw"
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class BootstrapT:
    """Errors of estimates from simulated noise, each with the covariance estimated from its residuals."""

    #: Shape (draws, p).
    errors: Array
    #: Shape (draws, p, p).
    covariances: Array

    def quantile(self, gradient: Array, level: float) -> float:
        """Return the quantile of the studentised absolute error of a quantity, from its gradient."""
        variances = np.einsum("i,kij,j->k", gradient, self.covariances, gradient)
        defined = variances > 0
        if not defined.any():
            return float("nan")
        ratios = np.abs(self.errors[defined] @ gradient) / np.sqrt(variances[defined])
        return float(np.quantile(ratios, level))


def bootstrap_t(
    psi: Sequence[Array],
    noise: NoiseModel,
    draws: int,
    *,
    loop: SensitivityFunction | None = None,
) -> BootstrapT:
    """Draw noise, and estimate from each draw the parameters, to first order, and their covariance.

    To first order ``theta + M^-1 sum psi v`` is the estimate and ``v - psi M^-1 sum psi v`` are the residuals, with v
    filtered by the sensitivity function of a loop.
    """
    source = ArmaNoise((1.0,), tuple(noise.coefficients.tolist()), innovation_variance=noise.innovation_variance)
    rng = np.random.default_rng(SEED)
    orthonormal, triangle = np.linalg.qr(np.concatenate(psi))
    solve = np.linalg.solve(triangle, orthonormal.T)
    size = psi[0].shape[1]
    errors, covariances = np.empty((draws, size)), np.empty((draws, size, size))
    for k in range(draws):
        drawn = [source.generate(np.empty(len(block)), rng) for block in psi]
        drawn = drawn if loop is None else [loop.filtered(v) for v in drawn]
        errors[k] = solve @ np.concatenate(drawn)
        left = [v - block @ errors[k] for v, block in zip(drawn, psi, strict=True)]
        covariances[k] = robust_dispersion(psi, left, loop).covariance
        report(DRAW, k + 1, draws)
    return BootstrapT(errors, covariances)


#: Assumption on the noise for standard errors; ``auto`` is ``robust``, and ``white`` if that finds white noise;
#: ``sandwich`` is an earlier name of ``robust``.
Covariance = Literal["auto", "white", "robust", "bootstrap", "sandwich"]
#: The formula used; with ``biased`` there is no standard error (`BIASED`).
Formula = Literal["white", "robust", "bootstrap", "biased"]
#: Default number of bootstrap draws.
DRAWS = 500
#: Share of a change of a quantity along undetermined directions that is rounding.
NEGLIGIBLE = 1e-5
#: Student's t with fewer degrees of freedom has no variance.
LEAST_FREEDOM = 2.0
#: Least degrees of freedom for a reliable noise model.
ENOUGH_FREEDOM = 5.0


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of the parameters, and quantiles of their intervals."""

    #: Field in files of earlier versions.
    former: ClassVar[tuple[str, ...]] = ("effective_count",)

    kind: Formula
    #: Directions in which the parameters are free, shape (p, f), and the covariance along them, shape (f, f).
    tangent: Array
    free_covariance: Array
    #: Changes of that covariance by one standard deviation of the parameters of the noise, shape (k, f, f).
    variation: Array = field(repr=False, default_factory=lambda: np.zeros((0, 0, 0)))
    bootstrap: BootstrapT | None = None
    #: Whether the errors allow for coloured noise, for a changing variance, and for the rounding of the output.
    coloured: bool = False
    changing: bool = False
    rounded: bool = False
    #: Whether the residuals pass as white.
    passed: bool = True
    #: Directions that the data do not determine, of the length of those along the tangent, shape (p, k).
    null: Array | None = field(repr=False, default=None)

    @classmethod
    def of(cls, kind: Formula, tangent: Array, found: Dispersion) -> "Uncertainty":
        """Return the distribution for a covariance along the tangent."""
        return cls(
            kind,
            tangent,
            found.covariance,
            found.variation,
            coloured=found.noise is not None and found.noise.order > 0,
            changing=found.changing,
            rounded=found.rounded,
        )

    @classmethod
    def known(cls, covariance: Array) -> "Uncertainty":
        """Return the distribution of normal estimates with a known covariance, NaN for fixed parameters."""
        free = np.flatnonzero(np.isfinite(np.diag(covariance)))
        if not free.size:
            return cls("white", np.eye(len(covariance)), covariance)
        return cls("white", np.eye(len(covariance))[:, free], covariance[np.ix_(free, free)])

    def of_former(self, values: Mapping[str, Any]) -> "Uncertainty":
        """Return the uncertainty with the degrees of freedom that a file of an earlier version gives as samples."""
        freedom = max(LEAST_FREEDOM, float(values["effective_count"]) - len(self.free_covariance))
        return replace(self, variation=Dispersion.scaled(self.free_covariance, freedom).variation)

    @property
    def defined(self) -> bool:
        """Whether there are standard errors."""
        return bool(np.isfinite(self.free_covariance).all())

    @property
    def singular(self) -> bool:
        """Whether there is a direction without a standard error."""
        return self.null is not None or not self.defined

    @property
    def covariance(self) -> Array:
        """Covariance of all parameters, NaN for fixed ones, shape (p, p)."""
        covariance = self.tangent @ self.free_covariance @ self.tangent.T
        held = ~self.tangent.any(axis=1)
        held |= ~self.determined(np.eye(len(self.tangent)))
        covariance[held] = covariance[:, held] = np.nan
        return np.asarray(covariance)

    def determined(self, gradients: Array) -> BoolArray:
        """Return whether the data determine quantities with these gradients by the leading parameters, shape (N,)."""
        if self.null is None:
            return np.ones(len(gradients), dtype=bool)
        lost = np.linalg.norm(gradients @ self.null[: gradients.shape[1]], axis=1)
        return np.asarray(lost <= NEGLIGIBLE * np.linalg.norm(self.along(gradients), axis=1))

    def along(self, gradients: NDArray[Number]) -> NDArray[Number]:
        """Return derivatives of quantities by the free directions, from those by the leading parameters."""
        return np.asarray(gradients @ self.tangent[: gradients.shape[-1]])

    def errors(self, gradients: Array) -> Array:
        """Return the standard errors of quantities with these gradients by the leading parameters, shape (N,)."""
        own = self.along(gradients)
        with np.errstate(invalid="ignore"):
            found = np.asarray(np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", own, self.free_covariance, own), 0.0)))
        found[~self.determined(gradients)] = np.nan
        return found

    def error(self, gradient: Array) -> float:
        """Return the standard error of a quantity with this gradient by the leading parameters."""
        return float(self.errors(gradient[None])[0])

    def freedom(self, own: Array) -> Array:
        """Return Student's degrees of freedom of quantities from derivatives by the free directions, shape (N,)."""
        if not self.variation.size:
            return np.full(len(own), np.inf)
        # Near a unit root changes may be as large as numbers can be.
        with np.errstate(all="ignore"):
            variances = np.einsum("ni,ij,nj->n", own, self.free_covariance, own)
            changes = np.einsum("ni,kij,nj->kn", own, self.variation, own, optimize=True) / variances
            found = 2.0 / np.sum(changes**2, axis=0)
        found[np.isnan(found)] = LEAST_FREEDOM
        return np.asarray(np.where(variances > 0.0, np.maximum(found, LEAST_FREEDOM), np.inf))

    @property
    def degrees_of_freedom(self) -> float:
        """Least degrees of freedom of Student's t of a parameter [-]."""
        return float(self.freedom(self.tangent[self.tangent.any(axis=1)]).min(initial=np.inf))

    def spans(self) -> tuple[str, str]:
        """Return the least to largest half-width of parameters in standard errors, and degrees of freedom, in words."""
        given = np.isfinite(self.errors(np.eye(len(self.tangent)))) & self.tangent.any(axis=1)
        freedom = self.freedom(self.tangent[given])
        return span(student_quantiles(freedom).tolist(), 3), span(freedom.tolist(), 4)

    @property
    def effective_count(self) -> float:
        """Number of samples of white noise with these degrees of freedom [-]."""
        return self.degrees_of_freedom + len(self.free_covariance)

    @property
    def short(self) -> bool:
        """Whether the record is too short for its noise model."""
        return self.kind in ("robust", "bootstrap") and self.degrees_of_freedom < ENOUGH_FREEDOM

    def quantile(self, gradient: Array, level: float = 0.95) -> float:
        """Return the half-width in standard errors of a quantity with this gradient by the leading parameters."""
        return float(self.reach(gradient[None], level)[0])

    def quantiles(self, level: float = 0.95) -> Array:
        """Return the half-widths in standard errors of every parameter, shape (p,)."""
        return self.reach(np.eye(len(self.tangent)), level)

    def reach(self, gradients: Array, level: float = 0.95) -> Array:
        """Return the half-widths in standard errors of quantities with these gradients, shape (N,)."""
        own = self.along(gradients)
        if self.bootstrap is None:
            return student_quantiles(self.freedom(own), level)
        return np.array([self.bootstrap.quantile(row, level) for row in own])

    def transformed(self, jacobian: Array) -> "Uncertainty":
        """Return the uncertainty of parameters with these derivatives by the present ones, shape (q, p)."""
        null = None if self.null is None else jacobian @ self.null
        return replace(self, tangent=jacobian @ self.tangent, null=null)

    @property
    def in_ignored_loop(self) -> "Uncertainty":
        """Uncertainty if the fit ignores the loop of its record: undefined, unless the residuals are white."""
        if self.passed or not self.defined:
            return self
        return replace(self.undefined, kind="biased", bootstrap=None)

    @property
    def undefined(self) -> "Uncertainty":
        """The uncertainty without standard errors."""
        return replace(self, free_covariance=np.full_like(self.free_covariance, np.nan))


@reported("standard errors")
def estimate_uncertainty(
    psi: Sequence[Array],
    residuals: Sequence[Array],
    kind: Covariance,
    draws: int = DRAWS,
    *,
    tangent: Array | None = None,
    loop: SensitivityFunction | None = None,
    rounding: Sequence[Rounding | None] = (),
) -> Uncertainty:
    """Return the uncertainty of an output-error estimate from sensitivities and residuals of each experiment.

    With a tangent, shape (p, f), the parameters were free along its columns only, for example at a bound. The output
    error of a simulated loop is noise filtered by its sensitivity function.
    """
    basis = np.eye(psi[0].shape[1]) if tangent is None else tangent
    free = psi if tangent is None else [block @ tangent for block in psi]
    if not basis.shape[1]:
        return Uncertainty.of("white", basis, undefined(0))
    hessian = np.sum([block.T @ block for block in free], axis=0)
    directions = determined_directions(hessian)
    if directions is not None and directions[0].size:
        within, null = (basis @ each for each in directions)
        law = estimate_uncertainty(psi, residuals, kind, draws, tangent=within, loop=loop, rounding=rounding)
        return replace(law, null=null)
    if kind == "white":
        count = sum(block.size for block in residuals)
        found = white_noise_dispersion(hessian, sum(float(e @ e) for e in residuals), count)
        return Uncertainty.of("white", basis, found)
    found = robust_dispersion(free, residuals, loop, rounding)
    law = Uncertainty.of("robust", basis, found)
    if kind == "auto":
        white = not (law.coloured or law.changing or law.rounded)
        return replace(law, kind="white" if white else "robust", passed=all_white(residuals))
    if kind == "bootstrap" and law.defined and found.noise is not None:
        return replace(law, kind="bootstrap", bootstrap=bootstrap_t(free, found.noise, draws, loop=loop))
    return law


#: Largest shift of the ends of a reliable interval, in half-widths. Measured medians, records of 600 samples after a
#: step: .05 to .2 for intervals that cover 97 %, .35 at 98 %, 1.2 at 90 %, 1e5 at 74 %.
UNSAFE = 0.5


@reported("intervals")
def shifts_of_ends(
    model: Parametric,
    law: Uncertainty,
    records: Sequence[Record],
    used: Sequence[BoolArray],
    psi: Sequence[Array],
    noises: Sequence[SampledNoise] = (),
) -> Array:
    r"""Return the largest shift of the interval ends of each parameter due to nonlinearity, in half-widths, shape (p,).

    NaN for fixed parameters; infinite if a model at an end has no finite output.

    The half-width of an interval is q standard errors. At its end the most likely parameters are ``theta + d``,
    ``d = q C e_k / s_k``, and the output is ``x(theta + d)``. The estimate would change by the projection of the
    linearisation error ``x(theta + d) - x(theta) - Psi d``,

    .. math:: M^{-1} \sum_t \psi_t \left( x_t(\theta + d) - x_t(\theta) - \psi_t' d \right),

    which shifts the end of the interval of parameter k; in half-widths it is a curvature in the sense of [1]_.

    References
    ----------
    .. [1] D. M. Bates and D. G. Watts, *Nonlinear Regression Analysis and Its Applications*, Wiley, 1988, chapter 7.
    """
    covariance, reach = law.covariance, law.quantiles()
    found, errors = np.full(len(covariance), np.nan), law.errors(np.eye(len(covariance)))
    mine = model.free[0]
    free = np.concatenate([slopes @ law.tangent for slopes in psi])
    here = [
        (model.simulated(r.input, r.t)[use], model.output_slopes(r.input, r.t)[use])
        for r, use in zip(records, used, strict=True)
    ]
    joint = np.nan_to_num(covariance)
    for k in mine[errors[mine] > 0]:
        change = reach[k] / errors[k] * joint[:, k]
        ends = []
        for step in (_within(model, change), _within(model, -change)):
            try:
                moved = model.at(step[mine])
                with np.errstate(all="ignore"):
                    left = [
                        moved.simulated(r.input, r.t)[use] - x - slopes @ step
                        for r, use, (x, slopes) in zip(records, used, here, strict=True)
                    ]
                    left = [noise.whitened(e) for noise, e in zip(noises, left, strict=True)] if noises else left
                    taken = law.tangent @ np.linalg.lstsq(free, np.concatenate(left))[0]
                ends.append(abs(float(taken[k])) / (reach[k] * errors[k]))
            except (DataError, np.linalg.LinAlgError):
                ends.append(np.inf)
        found[k] = np.nan_to_num(max(ends), nan=np.inf)
    return found


def _within(model: Parametric, step: Array) -> Array:
    """Return the step, shortened to keep the delay at zero or above."""
    if "delay" not in model.names:
        return step
    last, delay = step[model.names.index("delay")], float(model.theta[-1])
    return step if delay + last >= 0.0 else step * (delay / -last)
