"""Gradient estimation of frequencies after dynamic regressor extension and mixing (DREM)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from ctid_cli.frequency.frequency_kernels import Gains, Gradient
from ctid_cli.frequency.mixing import MixingOptions
from ctid_cli.frequency.regression import theta_of
from ctid_cli.frequency.tracking import Recursion
from ctid_cli.signals.checks import require_integer, require_positive

#: The residuals that show how far an estimate can be trusted are remembered over so many times n h.
RECENT_SPANS = 2


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
    recursion is that of :class:`~ctid_cli.frequency.drem_finite_time.DremFiniteTime`, which gives the same estimate
    without the part of the initial value.

    References
    ----------
    S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter estimators via dynamic
    regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550. doi:10.1109/TAC.2016.2614889
    """

    kind: ClassVar[str] = "drem_gradient"
    _finite_time: ClassVar[bool] = False

    epsilon: float = 1.0
    gamma: float | tuple[float, ...] = 1.0
    initial_frequencies: tuple[float, ...] | None = None
    power: int | Literal["literal"] = 1
    gated: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("epsilon", self.epsilon, "-")
        if isinstance(self.gamma, Sequence):
            self._keep_one_for_each("gamma", "-")
        else:
            require_positive("gamma", self.gamma, "-")
        self._keep_one_for_each("initial_frequencies", "rad/s")
        if self.power != "literal":
            require_integer("power", self.power, 1)

    def _recursion(self, interval: float) -> Recursion:
        n, clock = self.tones, self._clock(interval)
        initial = self.initial_frequencies
        if initial is None:
            lowest, highest = np.arccos((clock.top, clock.bottom)) / clock.delay
            initial = lowest + (highest - lowest) * np.arange(1, n + 1) / (n + 1)
        theta = theta_of(initial, clock.delay)
        gains = np.full(n, 1.0) * np.asarray(self.gamma, dtype=float) * interval
        keep = 1.0 - 1.0 / (RECENT_SPANS * n * clock.lag)
        return self._mixed(
            clock,
            Gradient(np.zeros((2, n)), np.zeros(n + 3)),
            theta,
            gains=Gains(gains, theta, self._finite_time, int(np.argmax(gains)), keep),
            normalisation=float(self.epsilon) ** (n if self.power == "literal" else int(self.power)),
            past=np.nan if self.gated else 0.0,
        )
