r"""Frequencies by dynamic regressor extension and mixing (DREM) of the delay regression.

The regression is stacked at n instants, d apart, and multiplied by the adjugate of the regressor matrix:
``Psi_k = Delta theta_k`` with one determinant Delta for all k, a scalar regression for each parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.frequency.delay_kernels import JUDGED_SPANS, Mixed, Mixing, mixed_estimates
from ctid_cli.frequency.delay_regression import DelayRegression, Online, Tail, theta_of, whole_delay
from ctid_cli.signals.checks import require_integer, require_positive


@dataclass(frozen=True, kw_only=True)
class MixingOptions(DelayRegression):
    """Options of an estimator on the mixed regressions."""

    _kept: ClassVar[tuple[str, ...]] = ("d",)

    d: float
    first_row: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("d", self.d, "s")
        require_integer("first_row", self.first_row, 0, 1000)

    @property
    def _stacked_over(self) -> float:
        return (self.first_row + self.tones - 1) * self.d


@dataclass(frozen=True, kw_only=True)
class DremGradient(MixingOptions):
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
    recursion is that of :class:`DremFiniteTime`, which gives the same estimate
    without the part of the initial value.

    References
    ----------
    S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter estimators via dynamic
    regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550. doi:10.1109/TAC.2016.2614889
    """

    kind: ClassVar[str] = "drem_gradient"
    finite_time: ClassVar[bool] = False

    epsilon: float = 1.0
    gamma: float | tuple[float, ...] = 1.0
    initial_frequencies: tuple[float, ...] | None = None
    power: int | Literal["literal"] = 1
    gated: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("epsilon", self.epsilon, "-")
        if isinstance(self.gamma, Sequence):
            self.keep_one_for_each("gamma", "-")
        else:
            require_positive("gamma", self.gamma, "-")
        self.keep_one_for_each("initial_frequencies", "rad/s")
        if self.power != "literal":
            require_integer("power", self.power, 1)

    def start(self, interval: float) -> Online:
        """Begin an estimation before its first sample, with the sampling interval [s]."""
        n, clock = self.tones, self.clock(interval)
        initial = self.initial_frequencies
        if initial is None:
            lowest, highest = np.arccos((clock.top, clock.bottom)) / clock.delay
            initial = lowest + (highest - lowest) * np.arange(1, n + 1) / (n + 1)
        gains = np.full(n, interval) * np.asarray(self.gamma, dtype=float)
        scale = float(self.epsilon) ** (n if self.power == "literal" else int(self.power))
        descent = scale, gains, theta_of(initial, clock.delay), self.finite_time
        return OnlineMixing(self, interval, JUDGED_SPANS * n * clock.lag, descent, past=np.nan if self.gated else 0.0)


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

    An estimate is valid if the regressions of the last ``4 n h`` bear it out: their residuals bound the error of each
    frequency that they can show; and if the frequencies explain the signal at a second delay. A row that contradicts
    the estimate invalidates it until all these rows are newer.

    References
    ----------
    A. Vediakova, A. Vedyakov, A. Pyrkin, A. Bobtsov and V. Gromov, "Frequency estimation of multi-sinusoidal signals in
    finite-time", 2020. S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter
    estimators via dynamic regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550.
    doi:10.1109/TAC.2016.2614889

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.frequency.drem import DremFiniteTime
    >>> t = 0.01 * np.arange(400)
    >>> track = DremFiniteTime(tones=2, h=0.6, d=0.4).track(np.sin(2 * t) + np.cos(3 * t), 0.01)
    >>> bool(track.valid[300]), bool(track.valid[-1]), track.frequencies[-1].round(9)
    (False, True, array([2., 3.]))
    """

    kind: ClassVar[str] = "drem_finite_time"
    finite_time: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class DremWindow(MixingOptions):
    r"""Frequencies by least squares on each mixed regression over a sliding window.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals.
    d : float
        Distance of the stacked rows [s]; rounded to whole sampling intervals.
    memory : float
        Length of the window [s]; rounded to whole sampling intervals.
    first_row : int, default 1
        Number of the first stacked row; 1 as published, 0 is exact one d earlier.
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
    ``theta_k(t) = sum Delta Psi_k / sum Delta^2`` over the last ``memory`` seconds. It is the limit for small gains of
    ``(theta_k(t) - theta_k(t - T) W)/(1 - W)``, ``W = exp(-gamma int_(t-T)^t Delta^2)``, the finite-time estimate that
    starts anew at every instant; there is no gain to choose. Exact, without noise, from
    ``2 n h + (first_row + n - 1) d`` on, and again that much and one ``memory`` after a change. The sums are those of
    the samples in the window alone: a block of old samples is summed backwards once, and the newer ones forwards, so no
    rounding error accumulates.

    References
    ----------
    R. Ortega, S. Aranovskiy, A. Pyrkin, A. Astolfi and A. Bobtsov, "New results on parameter estimation via dynamic
    regressor extension and mixing: continuous and discrete-time cases", *IEEE Trans. Automatic Control* 66 (2021)
    2265-2272. doi:10.1109/TAC.2020.3003651
    """

    kind: ClassVar[str] = "drem_window"
    _kept: ClassVar[tuple[str, ...]] = ("d", "memory")

    memory: float

    def start(self, interval: float) -> Online:
        """Begin an estimation before its first sample, with the sampling interval [s]."""
        window = whole_delay("memory", self.memory, interval)
        self.require_samples(self.memory, window, interval)
        return OnlineMixing(self, interval, window)


#: Factor of Delta and Psi, gamma times the sampling interval, parameters to begin with, and whether in finite time.
Descent = tuple[float, Array, Array, bool]
#: Least squares over the window in place of the gradient.
NO_DESCENT: Descent = (1.0, np.empty(0), np.empty(0), False)


class OnlineMixing(Online):
    """An estimation from mixed regressions, sample by sample."""

    def __init__(
        self,
        options: MixingOptions,
        interval: float,
        window: int,
        descent: Descent = NO_DESCENT,
        past: float = np.nan,
    ) -> None:
        super().__init__(options, interval, past=past)
        n, filled = options.tones, 2 * options.tones * self.clock.lag
        self._scale, *own = descent
        self._ages = (options.first_row + np.arange(n)) * whole_delay("d", options.d, interval)
        self._mixed_rows = Tail(np.full((self._ages[-1], n + 1), past))
        enough = min(options.rows_before_valid(self.clock), window)
        self._settings = Mixing(filled + int(self._ages[-1]) + 1, filled + window, enough, *own)
        width = n + 3 + 2 * (n + 1) ** 2
        counters = np.array([0, 0, 0, 0, 1 << 50, 1 << 50])
        sums, estimates = np.zeros((window + 2, width)), np.full((3, n), np.nan)
        self._state = Mixed(sums[2:], *sums[:2], np.zeros((2, n)), *estimates, np.zeros(3), counters)

    def advance(self, samples: Array, omega: Array, flags: NDArray[np.uint16]) -> None:
        """Take samples, and write the frequencies and the flags at their instants."""
        rows = self.rows(samples)
        history, count = self._mixed_rows.extended(rows[0]), samples.size
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            mixed = self._scale * mix([history[len(history) - count - age : len(history) - age] for age in self._ages])
        mixed_estimates(rows, mixed, self.clock, self._settings, self._state, omega, flags)


def mix(rows: Sequence[Array]) -> Array:
    """Return ``[adj(Phi) Psi, det Phi]`` of n stacked rows ``[phi psi]``, each of shape (N, n + 1).

    Laplace expansion along the last row: every minor of the first rows is computed once, and finite though singular.
    """
    n = len(rows)
    minors: dict[tuple[int, ...], Array] = {(): np.ones(len(rows[0]))}
    for size, row in enumerate(rows, start=1):
        columns = np.ascontiguousarray(row.T)
        minors = {
            chosen: sum(
                (-1) ** (size - 1 - place) * columns[column] * minors[chosen[:place] + chosen[place + 1 :]]
                for place, column in enumerate(chosen)
            )
            for chosen in combinations(range(n + 1), size)
        }
    everything = range(n + 1)
    # Column psi moves from the last place to place k: n - 1 - k exchanges.
    mixed = [(-1) ** (n - 1 - k) * minors[tuple(c for c in everything if c != k)] for k in range(n)]
    return np.column_stack([*mixed, minors[tuple(range(n))]])
