"""Frequencies by least squares on the delay regression, restarted when the signal changes: the recommended tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.frequency.delay_regression import ROWS_PER_TONE, DelayRegression, Online
from ctid_cli.signals.checks import require_positive

Solution = Literal["least_squares", "total_least_squares"]

#: Time before the first possible alarm, in units of h and in lengths of the prefilter.
ARMING_SPAN = 1.43
ARMING_PREFILTERS = 2
#: Time before the first comparison of the halves of the data, in lengths of the prefilter.
MIXED_PREFILTERS = 8
#: Default memory, in units of h.
DEFAULT_MEMORY = 100.0


@dataclass(frozen=True, kw_only=True)
class RestartingLeastSquares(DelayRegression):
    r"""Frequencies by least squares over all data since the last change of the signal.

    Further options are those of :class:`DelayRegression`.

    Parameters
    ----------
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals. The
        optimum is 0.7 to 0.8 times pi over the highest frequency.
    memory : float, optional
        Data older than this are forgotten exponentially [s]; by default 100 h. A slow drift, or a step too small
        to be detected in the noise, is tracked with a lag of this size and without an alarm.
    solution : {"least_squares", "total_least_squares"}, default "least_squares"
        Total least squares allows for white noise in the regressors too: no bias without a prefilter.
    prefilter : float, default 0.0
        Length of a Hann low-pass filter of the signal [s]; 0 for none. Without it, noise biases least squares; about
        1.5 h is a good length.

    Notes
    -----
    ``G = sum [phi psi]' [phi psi]`` and ``theta = G_phiphi^-1 G_phipsi``: without noise exact as soon as the regressors
    are independent, 2 n h and the length L of the prefilter after the start. The squared residual
    ``psi - phi' theta`` of new samples, averaged over h/14, is compared with that of the fit; a ratio of 30 is an
    alarm. The estimate is then held, marked invalid, for ``L + 2 n h``, until the delays contain no samples from before
    the change, and is restarted, so that it converges in finite time after every change. Data mixed by a second change
    during this time are detected by fits to the newer part only, at doubling intervals.

    Total least squares minimises ``v' G v / v' C v``, ``v = (-theta, 1)``, where C is the covariance of the rows of
    filtered white noise.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
    >>> t = 0.01 * np.arange(3000)
    >>> w = np.where(t < 15, 1.8, 2.0)
    >>> y = np.sin(w * t) + np.cos(3 * t) + 0.1 * np.random.default_rng(0).standard_normal(3000)
    >>> track = RestartingLeastSquares(tones=2, h=0.7, prefilter=1.0).track(y, 0.01)
    >>> track.frequencies[[1400, 2900]].round(2), track.valid[[1400, 1700, 2900]]
    (array([[1.8, 3. ],
           [2. , 3. ]]), array([ True, False,  True]))
    """

    kind: ClassVar[str] = "restarting_least_squares"
    raises_alarms: ClassVar[bool] = True

    memory: Annotated[float, require_positive, "s"] | None = None
    solution: Solution = "least_squares"

    def start(self, interval: float) -> Online:
        """Start an online estimation with the sampling interval [s]."""
        return OnlineRestarting(self, interval)


class OnlineRestarting(Online):
    """Online estimation with restarts."""

    def __init__(self, options: RestartingLeastSquares, interval: float) -> None:
        from ctid_cli.frequency.delay_kernels import Fit, Restarting  # numba is slow to import

        super().__init__(options, interval)
        n, lag, length = options.tones, self.clock.lag, self.weights.size - 1
        memory = DEFAULT_MEMORY * self.clock.delay if options.memory is None else options.memory
        options.require_samples(memory, memory / interval, interval)
        enough = options.rows_before_valid(self.clock)
        arming = max(round(ARMING_SPAN * lag), 2 * ROWS_PER_TONE * n, enough)
        whitener = np.empty((0, 0))
        if options.solution == "total_least_squares":
            covariance = noise_covariance(self.table, self.weights, lag)
            whitener = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        self._settings = Restarting(
            armed=max(arming, ARMING_PREFILTERS * length),
            compared=max(arming, MIXED_PREFILTERS * length),
            enough=enough,
            flush=length + 2 * n * lag + 1,
            memory=memory / interval,
            whitener=whitener,
        )
        theta, omega = np.full((2, n), np.nan)
        self._fit = Fit(np.zeros((3, n + 1, n + 1)), theta, omega, np.zeros(4), np.zeros(4, np.int64))

    def advance(self, samples: Array, omega: Array, flags: NDArray[np.uint16]) -> None:
        """Process samples, and write the frequencies and the flags at their instants."""
        from ctid_cli.frequency.delay_kernels import restarting_fits  # numba is slow to import

        restarting_fits(self.rows(samples), self.clock, self._settings, self._fit, omega, flags)


def noise_covariance(table: Array, weights: Array, lag: int) -> Array:
    """Return the covariance of the regression rows of filtered white noise."""
    places = np.arange(table.shape[1])
    correlation = np.array([weights[j * lag :] @ weights[: max(weights.size - j * lag, 0)] for j in places])
    R = correlation[np.abs(places[:, None] - places)] / correlation[0]
    return np.ascontiguousarray(table @ R @ table.T)
