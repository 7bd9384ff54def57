"""Frequencies by least squares on the delay regression, restarted when the signal changes: the recommended tracker."""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.delay_options import ROWS_PER_TONE, DelayRegression
from ctid_cli.frequency.frequency_kernels import DETECTOR_SPAN, Fit, Restarting, advance_restarting
from ctid_cli.frequency.tracking import Recursion
from ctid_cli.signals.checks import require_choice, require_positive

Solution = Literal["least_squares", "total_least_squares"]

#: The data that the detector needs before it may raise an alarm: so many h, and so many lengths of the prefilter.
ARMING_SPAN = 1.43
ARMING_PREFILTERS = 2
MIXED_PREFILTERS = 8
#: Memory if none is given, in units of h.
DEFAULT_MEMORY = 100.0


@dataclass(frozen=True, kw_only=True)
class RestartingLeastSquares(DelayRegression):
    r"""Frequencies by least squares over all data since the last change of the signal.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals. The best
        one is 0.7 to 0.8 times pi over the highest frequency.
    memory : float, optional
        Data older than this are forgotten exponentially [s]; by default 100 h. A slow drift, or a step too small
        to be seen in the noise, is followed with a lag of this size and raises no alarm.
    solution : {"least_squares", "total_least_squares"}, default "least_squares"
        Total least squares allows for white noise in the regressors too: no bias without a prefilter.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s]; 0 for none. Least squares is biased by noise without
        one; about 1.5 h is a good length.
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
    ``G = sum [phi psi]' [phi psi]`` and ``theta = G_phiphi^-1 G_phipsi``: without noise exact as soon as the regressors
    are independent, 2 n h and the length L of the prefilter after the start. The squared residual
    ``psi - phi' theta`` of new samples, averaged over h/14, is compared with that of the fit; 30 times as much is an
    alarm. The estimate is then held, marked invalid, for ``L + 2 n h``, until no sample from before the change is left
    in the delays, and starts anew: finite time again after every change. Should the data be mixed nevertheless (a
    second change while the delays were flushed), fits to the newer part alone, compared at doubling intervals, show it.

    Total least squares minimises ``v' G v / v' C v``, ``v = (-theta, 1)``, where C is the covariance of the rows of
    filtered white noise.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
    >>> t = 0.01 * np.arange(3000)
    >>> w = np.where(t < 15, 1.8, 2.0)
    >>> y = np.sin(w * t) + np.cos(3 * t) + 0.1 * np.random.default_rng(0).standard_normal(3000)
    >>> track = RestartingLeastSquares(tones=2, h=0.7, prefilter=1.0).start(0.01).run(y)
    >>> track.omega[[1400, 2900]].round(2), track.valid[[1400, 1700, 2900]]
    (array([[1.8, 3. ],
           [2. , 3. ]]), array([ True, False,  True]))
    """

    kind: ClassVar[str] = "restarting_least_squares"
    raises_alarms: ClassVar[bool] = True

    memory: float | None = None
    solution: Solution = "least_squares"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("solution", self.solution, get_args(Solution))
        if self.memory is not None:
            require_positive("memory", self.memory, "s")

    def _recursion(self, interval: float) -> Recursion:
        n, clock, weights = self.tones, self._clock(interval), self._weights(interval)
        length = weights.size - 1
        memory = DEFAULT_MEMORY * clock.delay if self.memory is None else self.memory
        self._require_samples(memory, memory / interval, interval)
        arming = max(round(ARMING_SPAN * clock.lag), 2 * ROWS_PER_TONE * n)
        whitener = np.empty((0, 0))
        if self.solution == "total_least_squares":
            covariance = noise_covariance(clock.table, weights, clock.lag)
            whitener = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        settings = Restarting(
            max(1, round(DETECTOR_SPAN * clock.lag)),
            max(arming, ARMING_PREFILTERS * length),
            max(arming, MIXED_PREFILTERS * length),
            self._rows_before_valid(clock),
            length + 2 * n * clock.lag + 1,
            memory / interval,
            whitener,
        )
        samples, estimate = np.full(2 * n * clock.lag + 1, np.nan), np.full((3, n), np.nan)
        newer, older, check = np.zeros((3, n + 1, n + 1))
        fit = Fit(samples, newer, older, check, estimate, np.zeros(4), np.zeros(6, np.int64))
        return Recursion(advance_restarting, (clock, settings), (fit,), weights, notes=self._notes(clock))


def noise_covariance(table: Array, weights: Array, lag: int) -> Array:
    """Covariance of the regression rows of filtered white noise."""
    places = np.arange(table.shape[1])
    correlation = np.array([weights[j * lag :] @ weights[: max(weights.size - j * lag, 0)] for j in places])
    R = correlation[np.abs(places[:, None] - places)] / correlation[0]
    return np.ascontiguousarray(table @ R @ table.T)
