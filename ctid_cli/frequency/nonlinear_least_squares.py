"""Frequencies of a whole record by nonlinear least squares: maximum likelihood in white Gaussian noise."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency.amplitudes import estimate_of, frequency_errors, present_samples
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.tracking import BatchEstimator, FrequencyEstimate
from ctid_cli.signals.checks import require_integer, require_not_negative, require_positive

#: Halvings of a step that raises the cost by more than these fractions of itself and of the signal's square.
HALVINGS = 20
COST_ROUNDING = 1e-12
SIGNAL_ROUNDING = 1e-26


@dataclass(frozen=True, kw_only=True)
class NonlinearLeastSquares(BatchEstimator):
    r"""Frequencies by nonlinear least squares on the whole record, a reference for the online estimators.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    initial_frequencies : tuple of float, optional
        Start [rad/s]; by default that of :class:`~ctid_cli.frequency.esprit.Esprit`, which needs a record without gaps.
    averaging : float, default 0.0
        Blocks that ESPRIT averages for the start [s]; 0 for none.
    bias : bool, default False
        Whether a constant part is estimated too.
    max_iterations : int, default 50
        Largest number of iterations.
    tolerance : float, default 1e-8
        Stop when a step turns no phase by more than this over the record [rad].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Minimises the sum of squares over frequencies and amplitudes. The amplitudes are eliminated in every step (variable
    projection), and the Gauss-Newton step of the frequencies is halved until it lowers the cost. In white Gaussian
    noise the estimate reaches the Cramer-Rao bound. The cost has many minima about 2 pi/T apart, T the length of the
    record, so the start must be close.

    References
    ----------
    D. C. Rife and R. R. Boorstyn, "Multiple tone parameter estimation from discrete-time observations", *Bell System
    Technical Journal* 55 (1976) 1389-1410. doi:10.1002/j.1538-7305.1976.tb02941.x
    """

    kind: ClassVar[str] = "nonlinear_least_squares"

    initial_frequencies: tuple[float, ...] | None = None
    averaging: float = 0.0
    bias: bool = False
    max_iterations: int = 50
    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        super().__post_init__()
        require_not_negative("averaging", self.averaging, "s")
        require_integer("max_iterations", self.max_iterations, 1)
        require_positive("tolerance", self.tolerance, "rad")
        self._keep_one_for_each("initial_frequencies", "rad/s")
        initial = self.initial_frequencies or ()
        if len(set(initial)) < len(initial):
            raise OptionError("initial_frequencies", f"initial_frequencies must differ, not {initial!r}.")

    def estimate(self, samples: ArrayLike, interval: float) -> FrequencyEstimate:
        """Gauss-Newton steps from the given frequencies, or from those of ESPRIT if no sample is missing."""
        y, t = present_samples(samples, interval)
        n = self.tones
        if y.size < 3 * n + self.bias:
            raise DataError(f"{y.size} samples are too few for {n} tones; use a longer record.")
        flags = Flag(0)
        if self.initial_frequencies is None:
            # A constant would take the place of a tone.
            centred = np.asarray(samples, dtype=float) - (y.mean() if self.bias else 0.0)
            start = Esprit(tones=n, averaging=self.averaging).estimate(centred, interval)
            omega = start.omega
            flags |= start.flags & Flag.UNDETERMINED
        else:
            omega = np.sort(np.asarray(self.initial_frequencies))
        length = t[-1] - t[0]
        negligible = SIGNAL_ROUNDING * float(y @ y)
        uncertainty = np.full(n, np.nan)
        try:
            step, uncertainty, misfit = frequency_errors(y, t, omega, bias=self.bias)
            for _ in range(self.max_iterations):
                if np.abs(step).max() * length <= self.tolerance:
                    break
                for _ in range(HALVINGS):
                    trial = omega + step
                    if (trial > 0).all() and (trial < np.pi / interval).all():
                        outcome = frequency_errors(y, t, trial, bias=self.bias)
                        if outcome[2] <= misfit * (1.0 + COST_ROUNDING) + negligible:
                            break
                    step = 0.5 * step
                else:
                    break
                omega, (step, uncertainty, misfit) = trial, outcome
            else:
                flags |= Flag.NOT_CONVERGED
        except DataError:
            flags |= Flag.UNDETERMINED
        order = np.argsort(omega)
        return estimate_of(y, t, omega[order], uncertainty[order], flags, bias=self.bias)
