r"""Frequencies by dynamic regressor extension and mixing (DREM) of the delay regression.

The regression is stacked at n instants with the spacing d, and multiplied by the adjugate of the regressor matrix:
``Psi_k = Delta theta_k`` with one determinant Delta for all k, a scalar regression for each parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.frequency.delay_regression import DelayRegression, Online, Tail, theta_of, whole_delay
from ctid_cli.frequency.flags import Flag
from ctid_cli.signals.checks import require_integer, require_positive


@dataclass(frozen=True, kw_only=True)
class MixingOptions(DelayRegression):
    """Common options of the estimators on the mixed regressions.

    Parameters
    ----------
    d : float
        Spacing of the stacked rows [s]; rounded to whole sampling intervals.
    first_row : int, default 1
        Number of the first stacked row; 1 as published; 0 gives exact estimates one d earlier.
    """

    _kept: ClassVar[tuple[str, ...]] = ("d",)

    d: Annotated[float, require_positive, "s"]
    first_row: Annotated[int, require_integer, 0, 1000] = 1

    @property
    def _stacked_over(self) -> float:
        return (self.first_row + self.tones - 1) * self.d


@dataclass(frozen=True, kw_only=True)
class DremGradient(MixingOptions):
    r"""Frequencies by gradient descent on each mixed regression: exponential convergence from the initial frequencies.

    Further options are those of :class:`MixingOptions` and :class:`DelayRegression`.

    Parameters
    ----------
    epsilon : float, default 1.0
        Normalisation of the mixed regression [-].
    gamma : float or tuple of float, default 1.0
        Adaptation gain, common or separate for each parameter.
    initial_frequencies : tuple of float, optional
        Initial frequencies [rad/s]; by default spread over zero to pi/h. Higher ones alias, which only changes the
        start.
    power : int or "literal", default 1
        Power of ``epsilon`` in the mixed regression; "literal" for the number of tones.
    gated : bool, default True
        Whether estimation waits until the delays are filled; False fills them with zeros, which affect the estimate.

    Notes
    -----
    ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)``, solved exactly over each sampling interval with constant Delta
    and Psi_k, so that no gain is too large. The rate of convergence is ``gamma_k`` times the mean of ``Delta^2``. The
    recursion is that of :class:`DremFiniteTime`, whose estimate excludes the part of the initial value.

    References
    ----------
    S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter estimators via dynamic
    regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550. doi:10.1109/TAC.2016.2614889
    """

    kind: ClassVar[str] = "drem_gradient"
    finite_time: ClassVar[bool] = False

    epsilon: Annotated[float, require_positive, "-"] = 1.0
    gamma: float | tuple[float, ...] = 1.0
    initial_frequencies: tuple[float, ...] | None = None
    power: int | Literal["literal"] = 1
    gated: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.gamma, Sequence):
            self.keep_one_for_each("gamma", "-")
        else:
            require_positive("gamma", self.gamma, "-")
        self.keep_one_for_each("initial_frequencies", "rad/s")
        if self.power != "literal":
            require_integer("power", self.power, 1)

    def start(self, interval: float) -> Online:
        """Start an online estimation with the sampling interval [s]."""
        return OnlineGradient(self, interval)


@dataclass(frozen=True, kw_only=True)
class DremFiniteTime(DremGradient):
    r"""Frequencies in finite time: the gradient estimate of each mixed regression, without its initial value.

    The options are those of :class:`DremGradient`.

    Parameters
    ----------
    initial_frequencies : tuple of float, optional
        Frequencies before the first estimate [rad/s]; by default spread over zero to pi/h. Higher ones alias.

    Notes
    -----
    With ``Delta = eps^p det Phi`` and ``Psi = eps^p adj(Phi) Psi_f`` constant over each interval Ts, the estimate
    ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)`` is ``theta_k(t) = z_k + (1 - q_k) theta_k(0)`` with
    ``z_k += m_k (Psi_k/Delta - z_k)``, ``q_k += m_k (1 - q_k)``, ``m_k = 1 - exp(-gamma_k Delta^2 Ts)``. The
    finite-time estimate ``z_k/q_k`` is the published ``(theta_k - theta_k(0) W_k)/(1 - W_k)`` with ``W_k = 1 - q_k``,
    without the cancellation in its numerator. Without noise it is exact from ``t = 2 n h + (first_row + n - 1) d`` on;
    after a change of the signal it forgets the past only as fast as the gradient estimate. Noise biases it, since the
    regressors contain the noisy signal: a prefilter reduces the bias, a smaller gain does not.

    An estimate is valid if the residuals of the regressions of the last ``4 n h`` sufficiently bound the error of each
    frequency, and if the frequencies explain the signal at a second delay. A row that contradicts the estimate
    invalidates it until all these rows are newer.

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

    Further options are those of :class:`MixingOptions` and :class:`DelayRegression`.

    Parameters
    ----------
    memory : float
        Length of the window [s]; rounded to whole sampling intervals.

    Notes
    -----
    ``theta_k(t) = sum Delta Psi_k / sum Delta^2`` over the last ``memory`` seconds. It is the limit for small gains of
    ``(theta_k(t) - theta_k(t - T) W)/(1 - W)``, ``W = exp(-gamma int_(t-T)^t Delta^2)``, the finite-time estimate with
    a restart at every instant; there is no gain. Without noise it is exact from ``2 n h + (first_row + n - 1) d`` on,
    and after a change from that time plus one ``memory`` on. The sums contain only the samples in the window: a block
    of old samples is summed backwards once, and the newer ones forwards, so that no rounding error accumulates.

    References
    ----------
    R. Ortega, S. Aranovskiy, A. Pyrkin, A. Astolfi and A. Bobtsov, "New results on parameter estimation via dynamic
    regressor extension and mixing: continuous and discrete-time cases", *IEEE Trans. Automatic Control* 66 (2021)
    2265-2272. doi:10.1109/TAC.2020.3003651
    """

    kind: ClassVar[str] = "drem_window"
    _kept: ClassVar[tuple[str, ...]] = ("d", "memory")

    memory: Annotated[float, require_positive, "s"]

    def start(self, interval: float) -> Online:
        """Start an online estimation with the sampling interval [s]."""
        window = whole_delay("memory", self.memory, interval)
        self.require_samples(self.memory, window, interval)
        return OnlineMixing(self, interval, window)


class OnlineMixing(Online):
    """Estimation from mixed regressions by least squares over a window, with checks by the rows of the window.

    The window's sums are ``[Delta Psi, Delta^2, mixed rows, rows, second moments at h and at the second delay]``.
    """

    #: Factor ``eps^p`` of Delta and Psi.
    scale = 1.0

    def __init__(self, options: MixingOptions, interval: float, window: int, past: float = np.nan) -> None:
        from ctid_cli.frequency.delay_kernels import Checks  # numba is slow to import

        super().__init__(options, interval, past=past)
        n, filled = options.tones, 2 * options.tones * self.clock.lag
        self._ages = (options.first_row + np.arange(n)) * whole_delay("d", options.d, interval)
        self._mixed_rows = Tail(np.full((self._ages[-1], n + 1), past))
        self._reach = filled + int(self._ages[-1]) + 1
        self._enough = min(options.rows_before_valid(self.clock), window)
        self._used = 0.0
        window_of_sums = np.zeros((window + 1, n + 3 + (n + 1) * (n + 2)))
        self._sliding = window_of_sums[1:], window_of_sums[0], np.zeros(1, np.int64)
        self._checks = Checks(filled + window, np.full(n, np.nan), np.zeros(3), np.array([0, 0, 1 << 50, 1 << 50]))

    def estimates(self, mixed: Array, sums: Array, used: Array) -> tuple[Array, Array]:
        """Return theta by least squares over the window, NaN if Delta is zero, and the mixed rows in the window."""
        n = self.options.tones
        with np.errstate(invalid="ignore"):
            return sums[:, :n] / sums[:, n : n + 1], sums[:, n + 1]

    def advance(self, samples: Array, omega: Array, flags: NDArray[np.uint16]) -> None:
        """Process samples, and write the frequencies and the flags at their instants."""
        from ctid_cli.frequency.delay_kernels import check_estimates  # numba is slow to import
        from ctid_cli.frequency.drem_kernels import slide

        rows, n = self.rows(samples), omega.shape[1]
        history, count = self._mixed_rows.extended(rows[0]), samples.size
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            mixed = self.scale * mix([history[len(history) - count - age : len(history) - age] for age in self._ages])
            squares = mixed[:, n:] * mixed
        # Regressions with an overflowing square are not used.
        found = np.asarray(np.isfinite(squares).all(axis=1))
        mixed[~found] = squares[~found] = np.nan
        one, other = np.triu_indices(n + 1)
        products = [own[:, one] * own[:, other] for own in rows]
        entries = np.hstack((squares, found[:, None], np.isfinite(rows[0, :, :1]), *products))
        sums = np.empty(entries.shape)
        slide(np.nan_to_num(entries, copy=False), *self._sliding, sums)
        used = self._used + np.cumsum(found, dtype=float)
        self._used = used[-1]
        theta, support = self.estimates(mixed, sums, used)
        excited = sums[:, n] > 0.0
        flags[support < self._enough] |= int(Flag.STARTING)
        flags[~found & (used > 0)] |= int(Flag.GAP)
        flags[~excited & (used > 0)] |= int(Flag.UNDETERMINED)
        counts = np.column_stack((excited * sums[:, n + 2], self._reach + support, self._reach + used))
        # A block of one sample needs no kernel of its own.
        grams = np.ascontiguousarray(sums[:, n + 3 :]).reshape(count, 2, -1)
        check_estimates(theta, rows[0], grams, counts, self.clock, self._checks, omega, flags)


class OnlineGradient(OnlineMixing):
    """Online gradient or finite-time estimation."""

    def __init__(self, options: DremGradient, interval: float) -> None:
        from ctid_cli.frequency.delay_kernels import CHECKED_SPANS  # numba is slow to import

        n, lag = options.tones, whole_delay("h", options.h, interval)
        super().__init__(options, interval, CHECKED_SPANS * n * lag, np.nan if options.gated else 0.0)
        self.scale = float(options.epsilon) ** (n if options.power == "literal" else int(options.power))
        spread = np.pi / self.clock.delay * np.arange(1, n + 1) / (n + 1)
        initial = spread if options.initial_frequencies is None else options.initial_frequencies
        gains = np.full(n, interval) * np.asarray(options.gamma, dtype=float)
        self._descent = gains, theta_of(initial, self.clock.delay), options.finite_time, np.zeros((2, n))

    def estimates(self, mixed: Array, sums: Array, used: Array) -> tuple[Array, Array]:
        """Return theta by gradient steps, and the mixed rows so far."""
        from ctid_cli.frequency.drem_kernels import gradient_steps  # numba is slow to import

        theta = np.empty((len(mixed), self.options.tones))
        gradient_steps(mixed, *self._descent, theta)
        return theta, used


def mix(rows: Sequence[Array]) -> Array:
    """Return ``[adj(Phi) Psi, det Phi]`` of n stacked rows ``[phi psi]``, each of shape (N, n + 1).

    Laplace expansion along the last row computes every minor of the first rows once, also for singular matrices.
    """
    n = len(rows)
    minors: dict[tuple[int, ...], Array] = {(): np.ones(len(rows[0]))}
    for size, row in enumerate(rows):
        columns = np.ascontiguousarray(row.T)
        minors = {
            chosen: sum(
                (-1) ** (size - place) * columns[column] * minors[chosen[:place] + chosen[place + 1 :]]
                for place, column in enumerate(chosen)
            )
            for chosen in combinations(range(n + 1), size + 1)
        }
    # Minors without phi_1, ..., phi_n, psi. Column psi moves from the last place to place k in n - 1 - k exchanges.
    signs = [*((-1.0) ** (n - 1 - k) for k in range(n)), 1.0]
    return np.asarray(np.column_stack(list(minors.values())[::-1]) * signs)
