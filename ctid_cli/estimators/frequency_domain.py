"""One transfer function by least squares from a measured frequency response."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Estimator, Fixed, Prepared, Start, places_of
from ctid_cli.estimation.measured_lines import MeasuredLines
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimators.delay_profile import MeasuredFit, check_structure, fitted, samples_at
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.covariance import robust_covariance, sandwich, unit_inverse
from ctid_cli.inference.residual_tests import all_white, chi_square_tail, normal_tail
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress, Uncertainty
from ctid_cli.signals.frequency_data import FrequencyData
from ctid_cli.signals.treatment import InitialState, LossKind, Offset, Weight

#: Residuals that exceed the given standard errors by chance less often than this count as larger.
MISFIT = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyDomainFit(MeasuredFit):
    """A fit to a measured frequency response.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number
        As in :class:`~ctid_cli.estimators.delay_profile.MeasuredFit`; a sample is a weighted real or imaginary part,
        and means are not subtracted in ``fit_percent`` and ``r2``.
    history, theta, initial_states, offsets, input_offsets, profile, residuals, sensitivities, used, starts
        As in :class:`~ctid_cli.estimators.delay_profile.MeasuredFit`; ``used`` has the real parts of all lines, then
        the imaginary ones.
    law, in_ignored_loop, poles_at_infinity, box, weighting, held_poles, tangent, regular, known, noise
        As in :class:`~ctid_cli.estimators.delay_profile.MeasuredFit`.
    data : FrequencyData
        The frequency response.
    weight : {"inverse", "inverse-sqrt", "none"}
        What lines weigh by where they have no standard errors.
    """

    data: FrequencyData = field(kw_only=True)
    weight: Weight = "none"

    def uncertainty(
        self, kind: Covariance = "auto", draws: int = DRAWS, progress: Progress | None = None
    ) -> Uncertainty:
        """Standard errors and intervals.

        Parameters
        ----------
        kind : {"auto", "white", "robust"}, default "auto"
            ``white`` takes the errors of lines as independent: by the standard errors of the data, or by the residuals
            of each line where these are larger or the standard errors estimates themselves; ``robust`` takes those of
            neighbouring lines as correlated, which ``auto`` does where the data say so or the residuals are.
        draws, progress
            Not used: there is no bootstrap.

        Returns
        -------
        Uncertainty
            Covariance, and how many standard errors intervals reach.
        """
        psi, e = self.sensitivities[0] @ self.tangent, self.residuals[0]
        if kind == "robust" or (kind == "auto" and self.correlated):
            lines = self.data.frequencies.size
            found, noise = robust_covariance(np.split(psi, [lines]), np.split(e, [lines]), regular=True)
            return Uncertainty("robust", self.tangent, found, noise.effective_count(e.size))
        inverse = unit_inverse(psi.T @ psi) if e.size > psi.shape[1] else None
        if inverse is None:
            return Uncertainty("white", self.tangent, np.full((psi.shape[1],) * 2, np.nan), e.size)
        if self.errors_known:
            return Uncertainty("white", self.tangent, inverse[0] * np.outer(inverse[1], inverse[1]), np.inf)
        # With the squared residual of each part over its expectation any variance over frequency is allowed (HC2 of
        # MacKinnon and White, 1985).
        scaled = psi * inverse[1]
        leverage = np.einsum("ki,ij,kj->k", scaled, inverse[0], scaled)
        weighed = scaled * (e / np.sqrt(np.maximum(1.0 - leverage, 1e-12)))[:, None]
        return Uncertainty("white", self.tangent, sandwich(*inverse, weighed.T @ weighed), e.size)

    @property
    def correlated(self) -> bool:
        """Whether errors of neighbouring lines are correlated, by what the data say or by the residuals."""
        return self.data.correlated or not self.white

    @property
    def white(self) -> bool:
        """Whether residuals over frequency pass as uncorrelated."""
        return all_white(np.split(self.residuals[0], [self.data.frequencies.size]))

    @property
    def errors_known(self) -> bool:
        """Whether the data have standard errors that the residuals agree with and that are no estimates."""
        return self.misfit_p_value >= MISFIT and self.data.freedom == np.inf

    @property
    def excess(self) -> float:
        """Variance of the residuals over that of the data's standard errors [-]."""
        return self.cost * self.count / max(self.count - self.tangent.shape[1], 1)

    @property
    def misfit_p_value(self) -> float:
        """Probability of residuals as large as these by the data's standard errors; NaN where it is not known [-].

        Over an estimated variance of d degrees of freedom the squared error of a line has the F-distribution of 2 and
        2 d of them.
        """
        spare, d = max(self.count - self.tangent.shape[1], 1), self.data.freedom
        if self.data.standard_error is None or d <= 2.0:
            return float("nan")
        if d == np.inf:
            return chi_square_tail(spare, self.cost * self.count)
        variance = d**3 / ((d - 1.0) ** 2 * (d - 2.0)) / (0.5 * spare)
        return normal_tail((self.excess - d / (d - 1.0)) / np.sqrt(variance))

    def leave_out(self, fill: Callable[[], Mapping[str, Any]]) -> None:
        """Forget what belongs to single lines; it is computed from the data, which are kept."""
        measured = _laid_out(self, lines_of(self.data, self.weight))
        super().leave_out(lambda: samples_at(measured, self.model, self.theta, None)._asdict())

    def answers(self, frequencies: Array) -> ComplexArray:
        """Values of the model as those of the data are: ``G(jw)``, or of samples.

        Parameters
        ----------
        frequencies : ndarray, shape (N,)
            Frequencies [rad/s].

        Returns
        -------
        ndarray of complex, shape (N,)
            Values [output unit/input unit].
        """
        if not self.data.interval:
            return self.model.frequency_response(frequencies)
        count = frequencies.size
        lines = FrequencyLines(frequencies, np.zeros(count, dtype=complex), np.ones(count), self.data.interval)
        parts = np.zeros(2 * count)
        parts[lines.use] = -_laid_out(self, lines).errors_of(self.model).residuals[0]
        return np.asarray(parts[:count] + 1j * parts[count:])


def _laid_out(fit: FrequencyDomainFit, lines: FrequencyLines) -> MeasuredLines:
    """Lay lines out for the structure of a fit."""
    integrators = int(np.count_nonzero(np.cumsum(fit.model.denominator[::-1]) == 0.0))
    zeros = sum(name.startswith("b") for name in fit.parameter_names) - 1
    structure = Structure(fit.model.order, zeros, "delay" in fit.parameter_names)
    return MeasuredLines(lines, structure, (fit.model.delay,) * 2, integrators, check=False)


@dataclass(frozen=True)
class FrequencyDomain(Estimator[MeasuredLines, FrequencyDomainFit]):
    r"""Least squares over frequency, by the search of :class:`~ctid_cli.estimators.delay_profile.DelayProfile`.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12, without integrators.
    zeros : int
        Degree of the numerator, below ``poles``; equal to ``poles`` only where the delay is known.
    delay_bounds : tuple of float, default (0.0, 0.0)
        Least and greatest delay [s]; two equal numbers are a known delay.
    integrators : int, default 0
        Poles at the origin besides.
    fixed : tuple of Fixed, optional
        Parameters that are known, by their names ``a1 ... an, b0 ... bm``.
    weight : {"inverse", "inverse-sqrt", "none"}, default "none"
        What the errors of lines without standard errors are multiplied by: the reciprocal of the measured gain, which
        makes them relative, that of its square root, or one.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Minimised is ``sum |W_k (G_k - B/A exp(-j w_k tau))|^2``, W the reciprocal of the standard error, with the sampled
    response of the model in the place of ``B/A`` for values of samples. Poles are searched from 1e-4 of the least to
    1e2 times the greatest frequency; of samples no faster than ten over the interval.

    With weights by the measured gain noise biases the estimate where it is not small beside the response.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import FrequencyData
    >>> w = np.geomspace(0.1, 10.0, 50)
    >>> fit = FrequencyDomain(1, 0, (0.0, 1.0)).fit(FrequencyData(w, 2.0 / (1j * w + 1.0) * np.exp(-0.3j * w)))
    >>> {name: round(value, 6) for name, value in fit.parameters.items()}
    {'a1': 1.0, 'b0': 2.0, 'delay': 0.3}
    """

    kind: ClassVar[str] = "frequency_domain"
    loss: ClassVar[LossKind] = "squares"
    initial_state: ClassVar[InitialState] = "rest"
    offset: ClassVar[Offset] = "none"

    poles: int
    zeros: int
    delay_bounds: tuple[float, float] = (0.0, 0.0)
    integrators: int = 0
    fixed: tuple[Fixed, ...] | None = None
    weight: Weight = "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_structure(self)

    @property
    def order(self) -> int:
        """Number of poles, integrators included."""
        return self.poles + self.integrators

    def prepare(self, record: Any) -> Prepared[MeasuredLines, FrequencyDomainFit]:
        """Check a frequency response and lay it out; a DataError says why nothing can be estimated."""
        if not isinstance(record, FrequencyData):
            raise DataError("a fit to a frequency response takes FrequencyData, and no record in time")
        return FrequencyDomainData(self, self._lay_out(record), data=record)

    def _lay_out(self, record: Any) -> MeasuredLines:
        low, high = self.delay_bounds
        known = places_of(self.fixed, Structure(self.poles, self.zeros).names)
        return MeasuredLines(
            lines_of(record, self.weight),
            Structure(self.order, self.zeros, delay=low < high),
            self.delay_bounds,
            self.integrators,
            KnownCoefficients.of(self.poles, self.zeros, known) if known else NOTHING,
            record.name,
        )


@dataclass(frozen=True, eq=False)
class FrequencyDomainData(Prepared[MeasuredLines, FrequencyDomainFit]):
    """A frequency response laid out for a fit."""

    data: FrequencyData = field(kw_only=True)

    def fit(self, start: Start | None = None) -> FrequencyDomainFit:
        """Estimate; no start is needed."""
        measured, options = self.laid_out, self.estimator
        found = fitted(measured, measured.best([], True), None, None)
        values = {each.name: getattr(found, each.name) for each in fields(found)}
        assert isinstance(options, FrequencyDomain)
        return FrequencyDomainFit(**values, data=self.data, weight=options.weight)._with_uncertainty("auto", DRAWS)


def lines_of(data: FrequencyData, weight: Weight) -> FrequencyLines:
    """Lay a frequency response out with the weights of its lines.

    With standard errors the real and the imaginary part of each error have the variance one.
    """
    unweighted = FrequencyLines(data.frequencies, data.response, np.ones(data.frequencies.size), data.interval)
    if data.standard_error is not None:
        both = unweighted.use[data.frequencies.size :]
        return FrequencyLines(
            data.frequencies, data.response, np.sqrt(1.0 + both) / data.standard_error, data.interval
        )
    if weight == "none":
        return unweighted
    gain = np.abs(data.response)
    if not gain.all():
        w = data.frequencies[int(np.argmin(gain))]
        raise DataError(f"{data.name or 'the data'}: the value at {w:g} is 0, which has no weight {weight}; use none")
    weights = 1.0 / (gain if weight == "inverse" else np.sqrt(gain))
    return FrequencyLines(data.frequencies, data.response, weights, data.interval)
