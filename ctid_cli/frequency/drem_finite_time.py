"""Finite-time estimation of frequencies by dynamic regressor extension and mixing (DREM)."""

from dataclasses import dataclass
from typing import ClassVar

from ctid_cli.frequency.drem_gradient import DremGradient


@dataclass(frozen=True, kw_only=True)
class DremFiniteTime(DremGradient):
    r"""Frequencies in finite time: the gradient estimate of each mixed regression, without its initial value.

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
        Frequencies shown before there is an estimate [rad/s]; by default spread over the bounds. Above pi/h they alias.
    first_row : int, default 1
        Number of the first stacked row; 1 as published, 0 is exact one d earlier.
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
    With ``Delta = eps^p det Phi`` and ``Psi = eps^p adj(Phi) Psi_f`` held over each interval Ts, the gradient estimate
    ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)`` is ``theta_k(t) = z_k + (1 - q_k) theta_k(0)`` with
    ``z_k += m_k (Psi_k/Delta - z_k)``, ``q_k += m_k (1 - q_k)``, ``m_k = 1 - exp(-gamma_k Delta^2 Ts)``. The
    finite-time estimate ``z_k/q_k`` is the published ``(theta_k - theta_k(0) W_k)/(1 - W_k)`` with ``W_k = 1 - q_k``,
    free of the cancellation in its numerator. Without noise it is exact from ``t = 2 n h + (first_row + n - 1) d`` on;
    after a change of the signal it forgets the past only as fast as the gradient estimate does. Noise biases it, since
    the regressors hold the noisy signal: a prefilter in front reduces the bias, a smaller gain does not.

    An estimate is valid if the recent mixed regressions bear it out: the mean squares of ``Psi_k - Delta theta_k``,
    theta from before the sample, over those of Delta, bound the error of theta_k that they can show; and if the
    frequencies explain the signal at a second delay.

    References
    ----------
    A. Vediakova, A. Vedyakov, A. Pyrkin, A. Bobtsov and V. Gromov, "Frequency estimation of multi-sinusoidal signals in
    finite-time", 2020. S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter
    estimators via dynamic regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550.
    doi:10.1109/TAC.2016.2614889

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.frequency.drem_finite_time import DremFiniteTime
    >>> t = 0.01 * np.arange(400)
    >>> tracker = DremFiniteTime(tones=2, h=0.6, d=0.4).start(0.01)
    >>> track = tracker.run(np.sin(2 * t) + np.cos(3 * t))
    >>> bool(track.valid[300]), bool(track.valid[-1]), track.omega[-1].round(9)
    (False, True, array([2., 3.]))
    """

    kind: ClassVar[str] = "drem_finite_time"
    _finite_time: ClassVar[bool] = True
