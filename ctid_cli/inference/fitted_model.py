"""What every estimated model can be asked: responses with confidence bands, and the model for other tools."""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from ctid_cli.inference import exported, responses
    from ctid_cli.inference.bands import FrequencyBand, PoleBand, ResponseBand, SystemWithDelay
    from ctid_cli.inference.responses import Bands, Estimated
    from ctid_cli.signals.held import HeldSignal
else:

    class _Later:
        """A module by its name: no estimate is made of what is asked of it, so that its identity stays the same."""

        def __init__(self, name: str) -> None:
            self.name = name

        def __getattr__(self, attribute: str) -> Any:
            return getattr(import_module(self.name), attribute)

    exported, responses = _Later("ctid_cli.inference.exported"), _Later("ctid_cli.inference.responses")

__all__ = ["FittedModel", "responses"]


class FittedModel(ABC):
    r"""An estimated model as a model that one can use.

    Bands are pointwise. ``linearised``, the default, has the standard errors of

    .. math:: \operatorname{var} g = \frac{\partial g}{\partial\theta} C \frac{\partial g}{\partial\theta}^{\!\top}

    with the joint covariance C of all parameters that the fit reports, the delay's among them, for white or coloured
    noise, and exact derivatives; intervals reach as many standard errors as those of the parameters do. ``sampled``
    draws 1000 sets of parameters with that covariance and takes quantiles of what these models answer: slower, and
    right where a quantity is not linear over a standard error, as a step response is not about an uncertain delay.
    Parameters that were given or lie at a bound are taken as known. Without a covariance all bands are NaN.

    Times are in the unit of time of the record that the model is from, frequencies in radians over it.
    """

    @abstractmethod
    def _estimated(self) -> Estimated:
        """The model and the joint law of its parameters."""

    def simulate(
        self,
        input: HeldSignal,
        times: ArrayLike | None = None,
        *,
        level: float = 0.95,
        bands: Bands = "linearised",
    ) -> ResponseBand:
        """Output for another input, from rest.

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
            The noise-free output; a measured one lies around it by its noise. Initial states and offsets that were
            estimated belong to their own record and are not part of it.

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
        return responses.simulated(self._estimated(), input, times, level, bands)

    def step_response(
        self, times: ArrayLike | None = None, *, level: float = 0.95, bands: Bands = "linearised"
    ) -> ResponseBand:
        """Output for a step of size one at time zero, from rest.

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
        return responses.step_response(self._estimated(), times, level, bands)

    def impulse_response(
        self, times: ArrayLike | None = None, *, level: float = 0.95, bands: Bands = "linearised"
    ) -> ResponseBand:
        """Derivative of the step response.

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
        return responses.impulse_response(self._estimated(), times, level, bands)

    def frequency_response(
        self, frequencies: ArrayLike | None = None, *, level: float = 0.95, bands: Bands = "linearised"
    ) -> FrequencyBand:
        r"""Gain and phase over frequency, delay included.

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
        return responses.frequency_response(self._estimated(), frequencies, level, bands)

    def poles(self, *, level: float = 0.95) -> PoleBand:
        """Poles with their uncertainty.

        Parameters
        ----------
        level : float, default 0.95
            Confidence level [-].

        Returns
        -------
        PoleBand
            Poles with the covariance of their real and imaginary parts, by the delta method; NaN where the interval of
            one reaches another. Of a sum of submodels in the order of the submodels.

        Raises
        ------
        UsageError
            If the level is out of range.
        """
        return responses.poles(self._estimated(), level)

    def to_control(self, pade: int | None = None) -> SystemWithDelay:
        """The model for python-control.

        Parameters
        ----------
        pade : int, optional
            Order of a Padé approximation of the delay, which then is part of the system; by default it is kept apart,
            because python-control knows no delays in continuous time.

        Returns
        -------
        SystemWithDelay
            ``system``, a ``control.TransferFunction``, and the ``delay`` that it does not have [s].

        Raises
        ------
        UsageError
            If python-control is not installed, or the order is not positive.
        """
        return exported.to_control(self._estimated().parametric.fraction, pade)

    def to_scipy(self) -> SystemWithDelay:
        """The model for SciPy.

        Returns
        -------
        SystemWithDelay
            ``system``, a ``scipy.signal.TransferFunction``, and the ``delay`` that it does not have [s].
        """
        return exported.to_scipy(self._estimated().parametric.fraction)

    def to_matlab(self, name: str = "G", kind: Literal["idtf", "tf"] = "idtf", time_unit: str = "s") -> str:
        """MATLAB code that builds the model.

        Parameters
        ----------
        name : str, default "G"
            Variable that gets the model.
        kind : {"idtf", "tf"}, default "idtf"
            For the System Identification Toolbox, with the delay as ``IODelay``, or for the Control System Toolbox,
            with the delay as ``InputDelay``.
        time_unit : str, default "s"
            Unit of time of the record: the model's rates and delay are in it.

        Returns
        -------
        str
            Lines of code. All digits are there: the numbers read back are the same. The covariance of the parameters
            follows as a comment.

        Raises
        ------
        UsageError
            If the name is none that MATLAB takes, the kind is neither, or MATLAB has no such unit of time.
        """
        return exported.to_matlab(self._estimated(), name, kind, time_unit)

    def to_python(
        self, name: str = "G", library: Literal["control", "scipy"] = "control", pade: int | None = None
    ) -> str:
        """Python code that builds the model without ctid.

        Parameters
        ----------
        name : str, default "G"
            Variable that gets the model.
        library : {"control", "scipy"}, default "control"
            Library that it is built with.
        pade : int, optional
            Order of a Padé approximation of the delay, for python-control only; by default the delay is kept apart.

        Returns
        -------
        str
            Lines of code with all digits; the covariance of the parameters follows as a comment.

        Raises
        ------
        UsageError
            If the name is no variable's, or the order is not positive.
        """
        return exported.to_python(self._estimated(), name, library, pade)
