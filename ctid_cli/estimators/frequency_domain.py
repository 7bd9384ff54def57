"""Least-squares estimation of a transfer function from a measured frequency response."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Prepared, Start, places_of
from ctid_cli.estimation.measured_lines import MeasuredLines
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.parameter_layout import Degrees, SumDegrees
from ctid_cli.estimators.additive_output_error import GROWN, AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.measured_fit import MeasuredFit, fitted, samples_at
from ctid_cli.estimators.measured_submodels import SubmodelsFit
from ctid_cli.inference.covariance import Dispersion, robust_dispersion, sandwich, undefined, unit_inverse
from ctid_cli.inference.residual_tests import all_white, chi_square_tail, normal_tail
from ctid_cli.inference.sensitivities import Structure, SumStructure
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress, Uncertainty
from ctid_cli.models.additive import AdditiveModel, names_of
from ctid_cli.signals.frequency_data import FrequencyData
from ctid_cli.signals.treatment import InitialState, InputBefore, LossKind, Offset, OutputHold

#: p-value below which residuals count as larger than the given standard errors.
MISFIT = 0.01
#: Share of the squared weighted values below which residuals are rounding.
ROUNDING = 1e-14


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyDomainFit(MeasuredFit):
    """Fit to a measured frequency response.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`; a sample is a weighted real or imaginary part,
        and means are not subtracted in ``fit_percent`` and ``r2``.
    history, theta, initial_states, offsets, input_offsets, residuals, sensitivities, used, starts
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`; ``used`` refers to the real parts of all lines,
        then the imaginary parts.
    law, in_ignored_loop, poles_at_infinity, box, weighting, held_poles, tangent, known, noise, bounds_met
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    equivalents, undetermined, intervals, other_minima, rounding, change, assumed_hold
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    data : FrequencyData
        Frequency response.
    """

    data: FrequencyData = field(kw_only=True)

    def uncertainty(
        self, kind: Covariance = "auto", draws: int = DRAWS, progress: Progress | None = None
    ) -> Uncertainty:
        """Return standard errors and intervals.

        Parameters
        ----------
        kind : {"auto", "white", "robust"}, default "auto"
            ``white`` assumes independent errors of lines, from the standard errors of the data, or from the residuals
            of each line if these are larger or the standard errors are estimates; ``robust`` assumes correlated errors
            of neighbouring lines, as does ``auto`` if the data are marked so or the residuals are correlated.
        draws, progress
            Unused: there is no bootstrap.

        Returns
        -------
        Uncertainty
            Covariance, and quantiles of the intervals.
        """
        psi, e = self.sensitivities[0] @ self.tangent, self.residuals[0]
        if kind == "robust" or (kind == "auto" and self.correlated):
            lines = self.data.frequencies.size
            found = robust_dispersion(np.split(psi, [lines]), np.split(e, [lines]))
            return Uncertainty.of("robust", self.tangent, found)
        spare = e.size - psi.shape[1]
        inverse = unit_inverse(psi.T @ psi) if spare > 0 else None
        if inverse is None:
            return Uncertainty.of("white", self.tangent, undefined(psi.shape[1]))
        if self.errors_known:
            known = Dispersion.scaled(inverse[0] * np.outer(inverse[1], inverse[1]), np.inf)
            return Uncertainty.of("white", self.tangent, known)
        # Squared residuals over their expectation allow any variance over frequency (HC2, MacKinnon and White, 1985).
        scaled = psi * inverse[1]
        leverage = np.einsum("ki,ij,kj->k", scaled, inverse[0], scaled)
        weighed = scaled * (e / np.sqrt(np.maximum(1.0 - leverage, 1e-12)))[:, None]
        return Uncertainty.of("white", self.tangent, Dispersion.scaled(sandwich(*inverse, weighed.T @ weighed), spare))

    def _change(self) -> None:
        """Return None: a frequency response has no halves in time."""

    @property
    def correlated(self) -> bool:
        """Whether errors of neighbouring lines are correlated, according to the data or the residuals."""
        return self.data.correlated or not self.white

    @property
    def white(self) -> bool:
        """Whether residuals over frequency pass as uncorrelated, or are rounding errors of exact values."""
        return self.r2 > 1.0 - ROUNDING or all_white(np.split(self.residuals[0], [self.data.frequencies.size]))

    @property
    def errors_known(self) -> bool:
        """Whether the data have known, not estimated, standard errors that agree with the residuals."""
        return self.misfit_p_value >= MISFIT and self.data.freedom == np.inf

    @property
    def excess(self) -> float:
        """Variance of the residuals relative to the standard errors of the data [-]."""
        return float(self.cost * self.count / max(self.count - self.tangent.shape[1], 1))

    @property
    def misfit_p_value(self) -> float:
        """p-value of the residuals under the standard errors of the data [-]; NaN if unknown.

        Divided by an estimated variance with d degrees of freedom, the squared error of a line has the F-distribution
        with 2 and 2 d degrees of freedom.
        """
        spare, d = max(self.count - self.tangent.shape[1], 1), self.data.freedom
        if self.data.standard_error is None or d <= 2.0:
            return float("nan")
        if d == np.inf:
            return chi_square_tail(spare, self.cost * self.count)
        variance = d**3 / ((d - 1.0) ** 2 * (d - 2.0)) / (0.5 * spare)
        return float(normal_tail((self.excess - d / (d - 1.0)) / np.sqrt(variance)))

    def leave_out(self, fill: Callable[[], Mapping[str, Any]]) -> None:
        """Delete the values of single lines, which can be recomputed from the data."""
        measured = _laid_out(self, self.data)
        super().leave_out(lambda: samples_at(measured, self.model, self.theta, None)._asdict())

    def responses_at(self, frequencies: Array) -> ComplexArray:
        """Return the response of the model in the form of the data: ``G(jw)``, or that of samples.

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
        ones = FrequencyData(frequencies, np.ones(count, dtype=complex), interval=self.data.interval)
        measured, parts = _laid_out(self, ones), np.zeros(2 * count)
        parts[measured.lines.use] = measured.outputs[0] - measured.errors_of(self.parametrised).residuals[0]
        return np.asarray(parts[:count] + 1j * parts[count:])


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyDomainSumFit(FrequencyDomainFit, SubmodelsFit):
    """Fit of a sum of submodels to a measured frequency response.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number, data
        As in :class:`FrequencyDomainFit`; ``model`` is the sum as one transfer function.
    history, theta, initial_states, offsets, input_offsets, residuals, sensitivities, used, starts
        As in :class:`FrequencyDomainFit`.
    law, in_ignored_loop, poles_at_infinity, box, weighting, held_poles, tangent, known, noise, bounds_met
        As in :class:`FrequencyDomainFit`.
    equivalents, undetermined, intervals, other_minima, rounding, change, assumed_hold
        As in :class:`FrequencyDomainFit`.
    additive, start_method, loop_radius, in_loop, consistency, sampling, two_stage
        As in :class:`~ctid_cli.estimators.measured_submodels.SubmodelsFit`; only the first two apply.
    """


def _laid_out(fit: FrequencyDomainFit, data: FrequencyData) -> MeasuredLines:
    """Return the lines prepared for the structure of a fit."""
    free, bounds = "delay" in fit.parameter_names, (fit.model.delay,) * 2
    if isinstance(fit, SubmodelsFit) and fit.additive is not None:
        return MeasuredLines(data, SumDegrees(SumStructure(fit.additive.terms, free)), bounds)
    integrators = int(np.count_nonzero(np.cumsum(fit.model.denominator[::-1]) == 0.0))
    zeros = sum(name.startswith("b") for name in fit.parameter_names) - 1
    return MeasuredLines(data, Degrees.of(Structure(fit.model.order, zeros, free), integrators), bounds)


@dataclass(frozen=True)
class _OfLines:
    """Options of records in time, with their defaults: a frequency response has none of them."""

    initial_state: InitialState = field(init=False, default="rest")
    offset: Offset = field(init=False, default="none")
    loss: LossKind = field(init=False, default="squares")
    covariance: Covariance = field(init=False, default="auto")
    bootstrap_draws: int = field(init=False, default=DRAWS)
    input_before: InputBefore = field(init=False, default=None)
    noise_model: str = field(init=False, default="white")


@dataclass(frozen=True)
class FrequencyDomain(_OfLines, DelayProfile):
    r"""Least squares over frequency, by the search of :class:`~ctid_cli.estimators.delay_profile.DelayProfile`.

    Parameters
    ----------
    poles, zeros, fixed, integrators, bounds
        As in :class:`~ctid_cli.estimators.delay_profile.DelayProfile`.
    delay_bounds : tuple of float, default (0.0, 0.0)
        Least and greatest delay [s]; equal values fix the delay.
    inputs : None
        For records in time only.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    The cost is ``sum |W_k (G_k - B/A exp(-j w_k tau))|^2``, with W the reciprocal of the standard error or the weight
    of the data, and with the sampled response of the model instead of ``B/A`` for sampled responses. Poles are searched
    from 1e-4 of the least to 1e2 times the greatest frequency; for sampled responses at most ten over the interval.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import FrequencyData
    >>> w = np.geomspace(0.1, 10.0, 50)
    >>> fit = FrequencyDomain(1, 0, (0.0, 1.0)).fit(FrequencyData(w, 2.0 / (1j * w + 1.0) * np.exp(-0.3j * w)))
    >>> {name: round(value, 6) for name, value in fit.parameters.items()}
    {'a1': 1.0, 'b0': 2.0, 'delay': 0.3}
    """

    delay_bounds: tuple[float, float] = (0.0, 0.0)
    # This too is for records in time only.
    hold_output: OutputHold = field(init=False, default="foh")

    def prepare(self, record: Any) -> Prepared[MeasuredRecords, MeasuredFit]:
        """Check and prepare a frequency response; a DataError states why estimation is impossible.

        A record is prepared for applying a model to it.
        """
        if not isinstance(record, FrequencyData):
            return super().prepare(record)
        if self.inputs is not None:
            raise OptionError("inputs", "inputs are for records in time; a frequency response has one input")
        low, high = self.delay_bounds
        known = places_of(self.fixed, Structure(self.poles, self.zeros).names)
        coefficients = KnownCoefficients.of(self.poles, self.zeros, known) if known else NOTHING
        degrees = Degrees.of(Structure(self.order, self.zeros, delay=low < high), self.integrators)
        measured = MeasuredLines(record, degrees, self.delay_bounds, coefficients)
        measured.check()
        return Prepared(self, measured)

    def _minimum(self, measured: MeasuredRecords, start: Start | None) -> MeasuredFit:
        own = _lines(measured)
        if not self.bounds:
            return fit_of_lines(own, own.best(), own.source)
        return FrequencyDomainFit(**_values(self._within_bounds(own)), data=own.source)


@dataclass(frozen=True)
class FrequencyDomainSum(_OfLines, AdditiveOutputError):  # noqa: N818 - not an exception
    """Least squares over frequency for a sum of submodels.

    Parameters
    ----------
    terms, delay_bounds, fixed
        As in :class:`~ctid_cli.estimators.additive_output_error.AdditiveOutputError`.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Cost, admissible poles and standard errors are those of :class:`FrequencyDomain`; the search is that of
    :class:`~ctid_cli.estimators.additive_output_error.AdditiveOutputError`.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import FrequencyData, Term
    >>> s = 1j * np.geomspace(0.1, 10.0, 50)
    >>> values = 2.0 / (s**2 + 0.2 * s + 1.0) + 1.0 / (0.1 * s**2 + 0.1 * s + 1.0)
    >>> fit = FrequencyDomainSum((Term(2, 0), Term(2, 0))).fit(FrequencyData(s.imag, values))
    >>> {name: round(value, 6) for name, value in fit.parameters.items() if name.startswith("g2")}
    {'g2_a1': 0.1, 'g2_a2': 0.1, 'g2_b0': 1.0}
    """

    def prepare(self, record: Any) -> Prepared[MeasuredRecords, MeasuredFit]:
        """Check and prepare a frequency response; a record is prepared for applying a model to it."""
        if not isinstance(record, FrequencyData):
            return super().prepare(record)
        low, high = self.delay_bounds
        known = places_of(self.fixed, names_of(self.terms))
        coefficients = KnownCoefficients.of_sum(self.terms, known) if known else NOTHING
        degrees = SumDegrees(SumStructure(self.terms, delay=low < high))
        measured = MeasuredLines(record, degrees, self.delay_bounds, coefficients)
        measured.check()
        return Prepared(self, measured)

    def _minimum(self, measured: MeasuredRecords, start: Start | None) -> SubmodelsFit:
        own = _lines(measured)
        found = fitted(own, own.best(), None)
        size = sum(term.size for term in self.terms)
        additive = AdditiveModel.from_theta(found.theta[:size], self.terms, found.model.delay)
        return FrequencyDomainSumFit(**_values(found), data=own.source, additive=additive, start_method=GROWN)


def fit_of_lines(measured: MeasuredRecords, found: Optimum, data: FrequencyData) -> FrequencyDomainFit:
    """Return an optimum for a frequency response, without standard errors."""
    return FrequencyDomainFit(**_values(fitted(measured, found, None)), data=data)


def _lines(measured: MeasuredRecords) -> MeasuredLines:
    """Return a prepared frequency response; raise a DataError for a record."""
    if not isinstance(measured, MeasuredLines):
        raise DataError("this fit takes a frequency response (FrequencyData); DelayProfile takes records in time")
    return measured


def _values(fit: MeasuredFit) -> dict[str, Any]:
    """Return the fields of a fit."""
    return {each.name: getattr(fit, each.name) for each in fields(fit)}
