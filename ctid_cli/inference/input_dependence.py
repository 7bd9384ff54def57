"""What residuals have to do with the input: dynamics that the model misses, and feedback from output to input."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.inference.quantile import robust_deviation
from ctid_cli.inference.residuals import dependence
from ctid_cli.signals.record import Record

#: Inputs looked at, in sampling intervals: before the instant at which the model uses them, and after the residual.
PAST, FUTURE = 25, 10
#: A delay that is too long leaves out inputs this many intervals later.
LATE = 3
#: Time constants of a further pole, from the sampling interval to this fraction of the record.
TRIED, LONGEST = 6, 0.2
#: Earlier inputs and simulated outputs from which a controller's next move is told, and the delays of its answer.
ORDER, ANSWERS = 4, 3
#: Steps of the robust regression, and the residual in robust standard deviations from which on it counts no more.
REWEIGHTED, CLIPPED = 8, 1.5


@dataclass(frozen=True)
class InputDependence:
    """Probabilities of a dependence like this if there is none [-]."""

    #: Of the residuals on what one more pole, and a zero, would add to the output.
    pole_p_value: float
    #: Share of the variance of the residuals that these would explain [-].
    pole_share: float
    #: Of the input on residuals before it, and the share of these that its moves foretell.
    feedback_p_value: float
    feedback_share: float


def input_dependence(e: Array, x: Array, psi: Array, t: Array, record: Record, delay: float) -> InputDependence | None:
    r"""Test residuals at instants t against earlier and later inputs; None in too short a record.

    The model is contained in that with one more pole and zero, ``B (s + z) / (A (s + p))`` with z = p; its derivative
    there is the simulated output x behind ``1/(s + p)``, and a few p span what a pole could add.

    Later inputs are freed of what earlier ones tell of them (Sims' test of causality): dynamics that the model misses
    correlate the residuals with the future of an input that is correlated itself, but only by way of its past.
    """
    interval = float(np.median(np.diff(record.t)))
    past, future = min(PAST, t.size // 8), min(FUTURE, t.size // 16)
    inside = (t - delay - past * interval >= record.t[0]) & (t + future * interval <= record.t[-1])
    if future < ORDER or np.count_nonzero(inside) < 2 * (past + future + psi.shape[1]):
        return None
    added = _behind_a_pole(x - x[0], np.geomspace(1.0, LONGEST * t.size, TRIED))[inside]
    e, x, psi, t = e[inside] - e[inside].mean(), x[inside], psi[inside], t[inside]
    noise = fit_noise_model([e])
    if not noise.innovation_variance > 0:
        return None
    beside = np.column_stack((np.ones(t.size), psi))
    pole = dependence(e, added, noise, beside)
    both = np.column_stack((beside, added))
    share = 1.0 - _power(_rest(e, both)) / _power(_rest(e, beside))

    def inputs(first: Array, steps: range) -> Array:
        return np.column_stack([record.input.at(first + k * interval) for k in steps])

    earlier = inputs(t - delay, range(min(LATE, int(delay / interval)), -past, -1))
    known = np.column_stack((beside, earlier - earlier.mean(axis=0)))
    # Between its samples an input along straight lines has moved before the residual.
    first = 1 if record.input.hold == "foh" else 0
    later = dependence(e, inputs(t, range(first, first + future)), noise, known)
    found = [(later.p_value, (later.statistic - later.freedom) / t.size)] if later.freedom else []
    if not first:
        z = _answer_at_once(_rest(e, known), x, inputs(t, range(0, -ORDER - 1, -1)))
        found.append((2 * ANSWERS * float(ndtr(-z)), z * z / t.size))
    likely, told = min(found, default=(1.0, 0.0))
    return InputDependence(pole.p_value, share, min(1.0, len(found) * likely), told)


def _answer_at_once(e: Array, x: Array, u: Array) -> float:
    """How far the input moves with residuals of the last instants, in standard deviations of what chance gives.

    What the input and the simulated output were does not tell all moves: those of a reference that is held are rare
    and large, and would drown the answer to the noise. So they are clipped. Residuals that are white and independent
    of the input are independent of any function of it.
    """
    steps = range(ORDER)
    before = np.column_stack((np.ones(e.size), u[:, 1:], *(np.roll(x, k) for k in steps)))[ORDER:]
    now, weight, rest = u[ORDER:, 0], np.ones(e.size - ORDER), u[ORDER:, 0]
    for _ in range(REWEIGHTED):
        half = np.sqrt(weight)
        rest = now - before @ np.linalg.lstsq(half[:, None] * before, half * now, rcond=1e-10)[0]
        scale = robust_deviation(rest)
        if not scale > 1e-9 * float(np.ptp(now)):
            return 0.0
        weight = 1.0 / np.maximum(np.abs(rest) / scale, 1.0)
    moves = np.clip(rest / scale, -CLIPPED, CLIPPED)
    white = fit_noise_model([e]).innovations(e)
    scores = [moves * white[ORDER - k : e.size - k] for k in range(ANSWERS)]
    return max(abs(float(score.sum())) / float(np.sqrt(score @ score)) for score in scores)


def _behind_a_pole(x: Array, time_constants: Array) -> Array:
    """Samples behind first-order filters with the given time constants in samples."""
    from scipy.signal import lfilter  # slow to import

    poles = np.exp(-1.0 / time_constants)
    return np.column_stack([lfilter([1.0 - p], [1.0, -p], x) for p in poles])


def _rest(e: Array, columns: Array) -> Array:
    """What columns leave of residuals."""
    rest: Array = e - columns @ np.linalg.lstsq(columns, e, rcond=None)[0]
    return rest


def _power(e: Array) -> float:
    return float(e @ e)
