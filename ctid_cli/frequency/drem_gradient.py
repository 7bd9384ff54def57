"""Gradient estimation of frequencies after dynamic regressor extension and mixing (DREM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ctid_cli.frequency.scalar_regressions import DremOptions, scalar_recursion
from ctid_cli.frequency.tracking import Recursion


@dataclass(frozen=True, kw_only=True)
class DremGradient(DremOptions):
    r"""Frequencies by gradient descent on each mixed regression: exponential convergence from the initial frequencies.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals.
    d : float
        Distance of the stacked rows [s]; rounded to whole sampling intervals.
    epsilon : float, default 1.0
        Normalisation of the mixed regression [-].
    gamma : float or tuple of float, default 1.0
        Adaptation gain, one for all parameters or one for each.
    initial_frequencies : tuple of float, optional
        Frequencies to begin with [rad/s]; by default spread over the bounds. Above pi/h they alias, which only moves
        the beginning.
    first_row : int, default 1
        Number of the first stacked row; 1 as published, 0 begins one d earlier.
    power : int or "literal", default 1
        Power of ``epsilon`` in the mixed regression; "literal" for the number of tones.
    gated : bool, default True
        Whether the estimation waits until the delays are filled; False fills them with zeros, which enter the estimate.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s]; 0 for none.
    difference : float, default 0.0
        If positive, the signal this much earlier is subtracted [s], which removes a constant bias.
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s]; by default pi/h, beyond which they cannot be told apart.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)``, solved exactly over each sampling interval with Delta and
    Psi_k held, so that no gain is too large. The rate of convergence is ``gamma_k`` times the mean of ``Delta^2``. The
    recursion is that of :class:`~ctid_cli.frequency.drem_finite_time.DremFiniteTime`, which gives the same estimate
    without the part of the initial value.

    References
    ----------
    S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter estimators via dynamic
    regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550. doi:10.1109/TAC.2016.2614889
    """

    kind: ClassVar[str] = "drem_gradient"

    def recursion(self, interval: float) -> Recursion:
        """The compiled recursion for a sampling interval.

        Parameters
        ----------
        interval : float
            Sampling interval [s].

        Returns
        -------
        Recursion
            With the state before the first sample.

        Raises
        ------
        ValueError
            If the options make no sense at this sampling interval.
        """
        return scalar_recursion(self, interval, finite_time=False)
