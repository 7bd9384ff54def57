"""Frequencies from a regression on filtered derivatives: a comparator, derived, not the published algorithm."""

from dataclasses import dataclass
from math import comb
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.filtering.realisation import held_step
from ctid_cli.frequency.frequency_kernels import UNDETERMINED, Chain, Filter, advance_filter
from ctid_cli.frequency.inputs import require_bounds, samples_in
from ctid_cli.frequency.tracking import OnlineEstimator, Recursion
from ctid_cli.signals.checks import require_choice, require_not_negative, require_positive

Algorithm = Literal["least_squares", "gradient"]


@dataclass(frozen=True, kw_only=True)
class FilterRegression(OnlineEstimator):
    r"""Frequencies from a linear regression on filtered derivatives; derived, not the published algorithm.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    pole : float
        Rate of the filter [rad/s], near the frequencies.
    forgetting : float, default 0.5
        Rate at which old data are forgotten [1/s].
    algorithm : {"least_squares", "gradient"}, default "least_squares"
        How the parameters are adapted.
    gains : tuple of float, optional
        Gains of the gradient algorithm, one for each parameter; 1 if not given.
    initial_frequencies : tuple of float, optional
        Frequencies to begin with [rad/s]; by default spread up to ``pole``.
    hold : float, default 1.0
        Least squares shows no estimate before this time [s].
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Derived, not the published algorithm: with one tone and the gradient it has the structure of the known first-order
    frequency observer, and the extension to several tones is our own.

    ``z = (l/(s + l))^(2n) y`` satisfies ``prod(s^2 + w_i^2) z = 0`` once the filter has settled, a linear regression of
    ``z^(2n)`` on the even derivatives below. They are combinations of the states of a chain of first-order filters,
    advanced exactly for a signal that is linear between its samples. The parameters are those of the polynomial in
    ``X = w^2`` whose roots are the squared frequencies. The gradient is normalised and implicit:
    ``a += Ts K phi e/(1 + Ts phi' K phi)``.

    References
    ----------
    For the structure with one tone: D. J. W. Belleter, R. Galeazzi and T. I. Fossen, "Experimental verification of a
    global exponential stable nonlinear wave encounter frequency estimator", *Ocean Engineering* 97 (2015) 48-56.
    doi:10.1016/j.oceaneng.2014.12.030
    """

    kind: ClassVar[str] = "filter_regression"

    pole: float
    forgetting: float = 0.5
    algorithm: Algorithm = "least_squares"
    gains: tuple[float, ...] | None = None
    initial_frequencies: tuple[float, ...] | None = None
    hold: float = 1.0
    lowest_frequency: float = 0.0
    highest_frequency: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("pole", self.pole, "rad/s")
        require_positive("forgetting", self.forgetting, "1/s")
        require_choice("algorithm", self.algorithm, get_args(Algorithm))
        require_not_negative("hold", self.hold, "s")
        require_bounds(self.lowest_frequency, self.highest_frequency)
        for name, unit in (("gains", "-"), ("initial_frequencies", "rad/s")):
            self._keep_one_for_each(name, unit)

    def _recursion(self, interval: float) -> Recursion:
        n = self.tones
        order = 2 * n
        if self.pole * interval > np.pi:
            beyond = f"pole = {self.pole:g} rad/s is beyond what samples every {interval:g} s can show"
            raise OptionError("pole", f"{beyond}; use one below {np.pi / interval:g} rad/s.")
        dynamics = self.pole * (np.eye(order, k=-1) - np.eye(order))
        gain = np.zeros(order)
        gain[0] = self.pole
        initial = np.asarray(self.initial_frequencies or self.pole * np.arange(1, n + 1) / n, dtype=float)
        coefficients = np.poly(initial**2)[1:]
        gains = interval * np.asarray(self.gains or np.ones(n)) if self.algorithm == "gradient" else np.empty(0)
        settings = Filter(
            held_step(dynamics, gain, interval),
            derivative_rows(n, self.pole),
            float(np.exp(-self.forgetting * interval)),
            gains,
            float(interval),
            # The effective length of an exponential window, and the mean delay of the filter.
            (2.0 / self.forgetting + order / self.pole) / interval,
            samples_in(self.hold, interval),
            # A gap empties the filter; it takes about twice its mean delay to fill again.
            samples_in(2 * order / self.pole, interval),
            float(self.lowest_frequency) ** 2,
            np.inf if self.highest_frequency is None else float(self.highest_frequency) ** 2,
        )
        estimate = np.array([coefficients, np.sort(initial), np.full(n, np.nan)])
        counters = np.array([0, 0, 0, UNDETERMINED], np.int64)
        state = Chain(np.zeros(order + 1), np.zeros((n + 1, n + 1)), estimate, counters)
        return Recursion(advance_filter, (settings,), (state,))


def derivative_rows(tones: int, pole: float) -> Array:
    """Regressors and regressand as combinations of the filter states."""
    order = 2 * tones
    rows = np.zeros((tones + 1, order + 1))
    for k in range(tones + 1):
        derivative = 2 * (tones - k)
        target = k - 1 if k else tones
        sign = -((-1) ** k) if k else 1
        for i in range(derivative + 1):
            rows[target, order - derivative + i] = sign * pole**derivative * comb(derivative, i) * (-1) ** i
    return rows
