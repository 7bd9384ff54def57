"""Use of an estimated model: responses with confidence bands, poles, and export to other tools."""

from __future__ import annotations

import keyword
import re
from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.model_responses import Bands, Estimated, FrequencyBand, PoleBand, ResponseBand, instants
from ctid_cli.signals.held import HeldSignal

#: Unit step at time zero.
STEP = HeldSignal(np.zeros(1), np.ones(1))
#: MATLAB's names of units of time, by the labels in files.
MATLAB_UNITS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), "seconds"),
    **dict.fromkeys(("ms", "millisecond", "milliseconds"), "milliseconds"),
    **dict.fromkeys(("us", "µs", "μs", "microsecond", "microseconds"), "microseconds"),
    **dict.fromkeys(("ns", "nanosecond", "nanoseconds"), "nanoseconds"),
    **dict.fromkeys(("min", "minute", "minutes"), "minutes"),
    **dict.fromkeys(("h", "hr", "hour", "hours"), "hours"),
    **dict.fromkeys(("d", "day", "days"), "days"),
}
#: Name of the delay property of each kind of object.
DELAYS = {"idtf": "IODelay", "tf": "InputDelay"}
#: Module of each library, and its alias.
LIBRARIES: dict[str, tuple[str, str | None]] = {"control": ("control", None), "scipy": ("scipy.signal", "signal")}


class SystemWithDelay(NamedTuple):
    """A model as an object of another library."""

    system: Any
    #: Delay that is not part of the object [s].
    delay: float


class FittedModel(ABC):
    r"""Responses, poles and exports of an estimated model.

    Bands are pointwise. ``linearised``, the default, has the standard errors of

    .. math:: \operatorname{var} g = \frac{\partial g}{\partial\theta} C \frac{\partial g}{\partial\theta}^{\!\top}

    with the joint covariance C of all reported parameters, including the delay, for white or coloured noise, and exact
    derivatives; half-widths in standard errors are those of the parameters. ``sampled`` draws 1000 sets of parameters
    with that covariance and takes quantiles of the responses: slower, but correct for quantities that are not linear
    over a standard error, such as a step response with an uncertain delay. Parameters that were given or lie at a bound
    count as known. Without a covariance all bands are NaN.

    Times are in the unit of time of the record, frequencies in radians per that unit.
    """

    def marks(self, time_unit: str = "s") -> list[str]:
        """Return what the records do not determine in sentences; none unless a fit states any.

        Parameters
        ----------
        time_unit : str, default "s"
            Unit of time of the records.

        Returns
        -------
        list of str
            One sentence for each.
        """
        return []

    @abstractmethod
    def _estimated(self) -> Estimated:
        """Return the model and the joint distribution of its parameters."""

    def simulate(
        self,
        input: HeldSignal,
        times: ArrayLike | None = None,
        *,
        level: float = 0.95,
        bands: Bands = "linearised",
    ) -> ResponseBand:
        """Return the output for another input, from rest.

        Parameters
        ----------
        input : HeldSignal
            The input; zero before its first break.
        times : array_like, shape (N,), optional
            Instants [s], strictly increasing; those of the input if none are given.
        level : float, default 0.95
            Confidence level of the band [-].
        bands : {"linearised", "sampled"}, default "linearised"
            How the band is made.

        Returns
        -------
        ResponseBand
            The noise-free output. Estimated initial states and offsets belong to their record and are not included.

        Raises
        ------
        DataError
            If the instants do not increase strictly.
        UsageError
            If an option is out of range.

        Notes
        -----
        The derivatives are exactly filtered signals, as in the estimation:
        ``dx/da_i = -p^(n-i)/A x``, ``dx/db_j = p^(m-j)/A u(t - tau)``, ``dx/dtau = -p x``.
        """
        found = self._estimated()
        return found.over_time(found.parametric, input, instants(input.t if times is None else times), level, bands)

    def step_response(
        self, times: ArrayLike | None = None, *, level: float = 0.95, bands: Bands = "linearised"
    ) -> ResponseBand:
        """Return the output for a unit step at time zero, from rest.

        Parameters
        ----------
        times : array_like, shape (N,), optional
            Instants [s], strictly increasing; by default until the slowest mode has settled.
        level : float, default 0.95
            Confidence level of the band [-].
        bands : {"linearised", "sampled"}, default "linearised"
            How the band is made.

        Returns
        -------
        ResponseBand
            The response.

        Raises
        ------
        DataError
            If the instants do not increase strictly.
        UsageError
            If an option is out of range.
        """
        found = self._estimated()
        return found.over_time(found.parametric, STEP, found.response_times(times), level, bands)

    def impulse_response(
        self, times: ArrayLike | None = None, *, level: float = 0.95, bands: Bands = "linearised"
    ) -> ResponseBand:
        """Return the derivative of the step response.

        Parameters
        ----------
        times : array_like, shape (N,), optional
            Instants [s], strictly increasing; by default until the slowest mode has settled.
        level : float, default 0.95
            Confidence level of the band [-].
        bands : {"linearised", "sampled"}, default "linearised"
            How the band is made.

        Returns
        -------
        ResponseBand
            The response [output unit/(input unit s)].

        Raises
        ------
        DataError
            If the instants do not increase strictly, or the model has as many zeros as poles.
        UsageError
            If an option is out of range.
        """
        found = self._estimated()
        return found.over_time(found.parametric.derivative, STEP, found.response_times(times), level, bands)

    def frequency_response(
        self, frequencies: ArrayLike | None = None, *, level: float = 0.95, bands: Bands = "linearised"
    ) -> FrequencyBand:
        r"""Return gain and phase over frequency, delay included.

        Parameters
        ----------
        frequencies : array_like, shape (N,), optional
            Angular frequencies [rad/s]; by default from below the slowest to above the fastest pole or zero.
        level : float, default 0.95
            Confidence level of the bands [-].
        bands : {"linearised", "sampled"}, default "linearised"
            How the bands are made.

        Returns
        -------
        FrequencyBand
            The response.

        Raises
        ------
        DataError
            If a frequency is negative or not finite.
        UsageError
            If an option is out of range.

        Notes
        -----
        The logarithm is linearised, ``d ln G = dG/G``: its real part is the relative change of the gain, whose band
        ``|G| exp(-+ z s)`` stays above zero, and its imaginary part that of the phase.
        """
        return self._estimated().over_frequency(frequencies, level, bands)

    def poles(self, *, level: float = 0.95) -> PoleBand:
        """Return the poles with their uncertainty.

        Parameters
        ----------
        level : float, default 0.95
            Confidence level [-].

        Returns
        -------
        PoleBand
            Poles with the covariance of their real and imaginary parts, by the delta method; NaN if the interval of a
            pole reaches another. The poles of a sum are in the order of the submodels.

        Raises
        ------
        UsageError
            If the level is out of range.
        """
        return self._estimated().poles(level)

    def to_control(self, pade: int | None = None) -> SystemWithDelay:
        """Return the model for python-control.

        Parameters
        ----------
        pade : int, optional
            Order of a Padé approximation of the delay, which then is part of the system; by default the delay is
            separate, because python-control has no delays in continuous time.

        Returns
        -------
        SystemWithDelay
            ``system``, a ``control.TransferFunction``, and the separate ``delay`` [s].

        Raises
        ------
        UsageError
            If python-control is not installed, or the order is not positive.
        """
        try:
            import control
        except ImportError:
            raise UsageError("python-control is not installed: pip install 'ctid[control]'") from None
        _check_pade(pade)
        model = self._estimated().parametric.fraction
        system = control.TransferFunction(model.numerator.tolist(), model.denominator.tolist())
        if pade is None or not model.delay:
            return SystemWithDelay(system, model.delay)
        return SystemWithDelay(system * control.TransferFunction(*control.pade(model.delay, pade)), 0.0)

    def to_scipy(self) -> SystemWithDelay:
        """Return the model for SciPy.

        Returns
        -------
        SystemWithDelay
            ``system``, a ``scipy.signal.TransferFunction``, and the separate ``delay`` [s].
        """
        from scipy.signal import TransferFunction as ScipyTransferFunction  # slow to import

        model = self._estimated().parametric.fraction
        return SystemWithDelay(ScipyTransferFunction(model.numerator, model.denominator), model.delay)

    def to_matlab(self, name: str = "G", kind: Literal["idtf", "tf"] = "idtf", time_unit: str = "s") -> str:
        """Return MATLAB code that builds the model.

        Parameters
        ----------
        name : str, default "G"
            Name of the variable.
        kind : {"idtf", "tf"}, default "idtf"
            For the System Identification Toolbox, with the delay as ``IODelay``, or for the Control System Toolbox,
            with the delay as ``InputDelay``.
        time_unit : str, default "s"
            Unit of time of the record and of the model.

        Returns
        -------
        str
            Lines of code with all digits. The covariance of the parameters follows as a comment.

        Raises
        ------
        UsageError
            If the name, the kind or the unit of time is not valid in MATLAB.
        """
        if not re.fullmatch(r"[A-Za-z]\w{0,62}", name, re.ASCII):
            raise UsageError(f"a MATLAB variable must be a letter, then letters, digits and underscores; got {name!r}")
        if kind not in DELAYS:
            raise UsageError(f"the kind of a MATLAB model must be {' or '.join(DELAYS)}; got {kind!r}")
        unit = MATLAB_UNITS.get(time_unit)
        if unit is None:
            raise UsageError(
                f"MATLAB has no unit of time {time_unit!r}; it has {', '.join(dict.fromkeys(MATLAB_UNITS.values()))}"
            )
        found = self._estimated()
        model = found.parametric.fraction
        lines = [
            f"% {name}(s) = B(s)/A(s) exp(-delay s), coefficients in descending powers of s",
            f"numerator = {_row(model.numerator)};",
            f"denominator = {_row(model.denominator)};",
            f"delay = {model.delay!r};",
            f"{name} = {kind}(numerator, denominator, '{DELAYS[kind]}', delay, 'TimeUnit', '{unit}');",
            f"% covariance of the estimates of {', '.join(found.parametric.names)}:",
            *(f"%   {_row(row)}" for row in found.law.covariance),
            *(f"% {mark}" for mark in self.marks(time_unit)),
        ]
        return "\n".join(lines) + "\n"

    def to_python(
        self, name: str = "G", library: Literal["control", "scipy"] = "control", pade: int | None = None
    ) -> str:
        """Return Python code that builds the model without ctid.

        Parameters
        ----------
        name : str, default "G"
            Name of the variable.
        library : {"control", "scipy"}, default "control"
            Library of the model object.
        pade : int, optional
            Order of a Padé approximation of the delay, for python-control only; by default the delay is separate.

        Returns
        -------
        str
            Lines of code with all digits; the covariance of the parameters follows as a comment.

        Raises
        ------
        UsageError
            If the name is not a valid identifier, or the order is not positive.
        """
        if not name.isidentifier() or keyword.iskeyword(name):
            raise UsageError(f"a Python variable must be a letter, then letters, digits and underscores; got {name!r}")
        _check_pade(pade)
        found = self._estimated()
        model = found.parametric.fraction
        module, alias = LIBRARIES[library]
        lines = [
            f"# {name}(s) = B(s)/A(s) exp(-delay s), coefficients in descending powers of s",
            f"import {module}" if alias is None else f"from {module.rpartition('.')[0]} import {alias}",
            "",
            f"numerator = {model.numerator.tolist()!r}",
            f"denominator = {model.denominator.tolist()!r}",
            f"delay = {model.delay!r}  # not part of {name}",
            f"{name} = {alias or module}.TransferFunction(numerator, denominator)",
        ]
        if pade is not None:
            lines[-2] = f"delay = {model.delay!r}"
            lines.append(
                f"{name} *= control.TransferFunction(*control.pade(delay, {pade}))  # the delay, approximately"
            )
        lines.append(f"# covariance of the estimates of {', '.join(found.parametric.names)}:")
        lines += [f"#   {_row(row)}" for row in found.law.covariance]
        return "\n".join([*lines, *(f"# {mark}" for mark in self.marks())]) + "\n"


def _check_pade(order: int | None) -> None:
    if order is not None and order < 1:
        raise UsageError(f"the order of a Padé approximation must be at least 1; got {order}")


def _row(values: Array) -> str:
    """Return numbers with all digits."""
    return f"[{' '.join('NaN' if np.isnan(value) else repr(value) for value in values.tolist())}]"
