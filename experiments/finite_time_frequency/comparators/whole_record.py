"""Frequencies of a whole record by ESPRIT and by nonlinear least squares: references for the other estimators."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctid_cli import DataError, Flag, FrequencyEstimator, FrequencyTrack

from .common import complete_samples, is_certain

#: Rows of ESPRIT's Hankel matrix as a fraction of the samples, and their largest number.
ROWS_FRACTION = 0.4
MOST_ROWS = 400
#: More samples than this make the matrix too large to decompose; averages are nearly as informative.
MOST_AVERAGES = 100_000
#: Singular values below this fraction of the largest are rounding.
RANK_TOLERANCE = 1e-11
#: Below this ratio of the singular values the sinusoids cannot be distinguished.
SINGULAR = 1e-10
#: A residual below this fraction of the signal (root mean squares) is rounding, and is replaced by this fraction.
ROUNDING = 1e-13
#: Probability with which white noise alone is accepted as a tone.
FALSE_TONE = 1e-6
#: Gauss-Newton steps end if one changes all phases by less than this over the record [rad], or after this number.
TOLERANCE = 1e-8
MOST_STEPS = 50
#: Halvings of a step that raises the cost by more than these fractions of itself and of the signal's square.
HALVINGS = 20
COST_ROUNDING = 1e-12
SIGNAL_ROUNDING = 1e-26


@dataclass(frozen=True, kw_only=True)
class Esprit(FrequencyEstimator):
    r"""Frequencies of a whole record by ESPRIT.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    averaging : float, default 0.0
        Blocks of this length are averaged first [s], to leave some hundred samples; 0 for none. Frequencies must lie
        below pi over this time.

    Notes
    -----
    The Hankel matrix of a sum of n sinusoids has rank 2 n, and its column space U satisfies ``U_down = U_up F``, where
    F has the eigenvalues ``exp(+-j w_i T)``. F is found by least squares from the leading left singular vectors.

    References
    ----------
    R. Roy and T. Kailath, "ESPRIT - estimation of signal parameters via rotational invariance techniques", *IEEE Trans.
    Acoustics, Speech, and Signal Processing* 37 (1989) 984-995. doi:10.1109/29.32276
    """

    whole_record: ClassVar[bool] = True

    averaging: float = 0.0

    def __post_init__(self):
        super().__post_init__()
        if self.averaging < 0.0:
            raise DataError(f"averaging must not be negative, not {self.averaging!r}", "averaging")

    def check(self, count, interval):
        """Refuse records with too few averages left, or too many."""
        self._blocks(count, interval)

    def _blocks(self, count, interval):
        """Return the number of samples in an average, and of rows of the Hankel matrix."""
        block = max(1, round(min(self.averaging / interval, float(count))))
        averages = count // block
        rows = min(int(ROWS_FRACTION * averages), MOST_ROWS)
        if rows < 2 * self.tones + 1:
            few = f"{averages} samples, after the averaging, are too few for {self.tones} tones"
            raise DataError(f"{few}; use a longer record or a shorter averaging", "averaging")
        if averages > MOST_AVERAGES:
            many = f"{averages:,} samples are more than the {MOST_AVERAGES:,} that ESPRIT takes"
            least = f"{count / MOST_AVERAGES * interval:.2g} s"
            raise DataError(f"{many}; use an averaging of at least {least}, or a part of the record", "averaging")
        return block, rows

    def track(self, samples, interval):
        """Return the rotation of the signal space of the averaged record."""
        y = complete_samples(samples)
        n = self.tones
        block, rows = self._blocks(y.size, interval)
        averages = y[: y.size // block * block].reshape(-1, block).mean(axis=1)
        hankel = np.lib.stride_tricks.sliding_window_view(averages, averages.size - rows + 1)
        vectors, singular_values, _ = np.linalg.svd(hankel, full_matrices=False)
        flags = Flag(0)
        if not singular_values[2 * n - 1] > RANK_TOLERANCE * singular_values[0]:
            flags |= Flag.UNDETERMINED
        basis = vectors[:, : 2 * n]
        rotations = np.linalg.eigvals(np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0])
        angles = np.sort(np.angle(rotations[np.imag(rotations) > 0]))
        if angles.size < n:
            # Real eigenvalues: a constant, an alternating or a vanishing part in place of a sinusoid.
            flags |= Flag.COMPLEX_ROOTS
            angles = np.sort(np.abs(np.angle(rotations)))[::2]
        return whole_track(y, interval, angles / (block * interval), flags)


@dataclass(frozen=True, kw_only=True)
class NonlinearLeastSquares(Esprit):
    r"""Frequencies of a whole record by nonlinear least squares: maximum likelihood in white Gaussian noise.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    averaging : float, default 0.0
        Blocks that :class:`Esprit` averages for the start [s]; 0 for none.

    Notes
    -----
    Minimises the sum of squares over frequencies and amplitudes. The amplitudes are eliminated in every step (variable
    projection), and the Gauss-Newton step of the frequencies is halved until it lowers the cost. In white Gaussian
    noise the estimate reaches the Cramer-Rao bound. The cost has many minima about 2 pi/T apart, T the length of the
    record, so it needs a close start, which ESPRIT gives.

    References
    ----------
    D. C. Rife and R. R. Boorstyn, "Multiple tone parameter estimation from discrete-time observations", *Bell System
    Technical Journal* 55 (1976) 1389-1410. doi:10.1002/j.1538-7305.1976.tb02941.x
    """

    def track(self, samples, interval):
        """Return the result of Gauss-Newton steps from the frequencies of ESPRIT."""
        y = complete_samples(samples)
        flags = Flag(0)
        omega = super().track(y, interval).frequencies[0]
        t = centred_times(y.size, interval)
        negligible = SIGNAL_ROUNDING * float(y @ y)
        try:
            step, _, cost = frequency_step(y, t, omega)
            for _ in range(MOST_STEPS):
                if np.abs(step).max() * (t[-1] - t[0]) <= TOLERANCE:
                    break
                for _ in range(HALVINGS):
                    trial = omega + step
                    if (trial > 0).all() and (trial < np.pi / interval).all():
                        outcome = frequency_step(y, t, trial)
                        if outcome[2] <= cost * (1.0 + COST_ROUNDING) + negligible:
                            break
                    step = 0.5 * step
                else:
                    break
                omega, (step, _, cost) = trial, outcome
            else:
                flags |= Flag.NOT_CONVERGED
        except np.linalg.LinAlgError:
            flags |= Flag.UNDETERMINED
        return whole_track(y, interval, np.sort(omega), flags)


def centred_times(count, interval):
    """Return the instants with the middle of the record as origin, where sines and cosines are least correlated."""
    return interval * (np.arange(count) - 0.5 * (count - 1))


def fit_amplitudes(y, t, omega):
    """Return sines and cosines, their coefficients by least squares, and the residual."""
    angles = t[:, None] * omega
    design = np.hstack([np.sin(angles), np.cos(angles)])
    coefficients, _, _, singular_values = np.linalg.lstsq(design, y, rcond=None)
    if singular_values[-1] < SINGULAR * singular_values[0]:
        raise np.linalg.LinAlgError("the samples cannot tell the sinusoids apart")
    return design, coefficients, y - design @ coefficients


def frequency_step(y, t, omega):
    """Return the Gauss-Newton step of the frequencies, the error that the residual can cause, and its square."""
    n = omega.size
    design, coefficients, residual = fit_amplitudes(y, t, omega)
    slopes = t[:, None] * (design[:, n:] * coefficients[:n] - design[:, :n] * coefficients[n:])
    # Part of the slopes that is orthogonal to the amplitudes.
    orthogonal, _ = np.linalg.qr(design)
    slopes -= orthogonal @ (orthogonal.T @ slopes)
    cost, scales = float(residual @ residual), np.linalg.norm(slopes, axis=0)
    if not (scales > 0).all():
        return np.zeros(n), np.full(n, np.inf), cost
    q, r = np.linalg.qr(slopes / scales)
    if np.abs(np.diag(r)).min() < SINGULAR:
        return np.zeros(n), np.full(n, np.inf), cost
    inverse = np.linalg.inv(r)
    error = np.linalg.norm(inverse, axis=1) / scales * np.sqrt(cost + ROUNDING**2 * float(y @ y))
    return inverse @ (q.T @ residual) / scales, error, cost


def whole_track(y, interval, omega, flags):
    """Return the track of one row, with the flags from possible errors and amplitudes.

    The weakest tone is compared with the strongest apparent one in white noise of the residual's size: each of the N/2
    ordinates of the periodogram of white noise of variance s^2 exceeds ``N A^2/4 = g s^2`` with the probability
    ``exp(-g)``, the largest with ``N/2 exp(-g)`` (R. A. Fisher, "Tests of significance in harmonic analysis", *Proc.
    Royal Society A* 125 (1929) 54-59, for many samples).
    """
    n, t = omega.size, centred_times(y.size, interval)
    try:
        _, error, _ = frequency_step(y, t, omega)
        _, coefficients, residual = fit_amplitudes(y, t, omega)
    except np.linalg.LinAlgError:
        flags |= Flag.UNDETERMINED | Flag.UNCERTAIN
    else:
        length = t[-1] - t[0]
        if not is_certain(omega[None, :], error[None, :], length, length)[0]:
            flags |= Flag.UNCERTAIN
        variance = float(residual @ residual) / max(y.size - 3 * n, 1)
        weakest = float((coefficients[:n] ** 2 + coefficients[n:] ** 2).min())
        if not weakest > 4.0 * variance / y.size * np.log(0.5 * y.size / FALSE_TONE):
            flags |= Flag.UNDETERMINED
    return FrequencyTrack(np.array([(y.size - 1) * interval]), omega[None, :], np.array([int(flags)], np.uint16))
