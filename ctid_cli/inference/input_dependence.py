"""What residuals have to do with the input: dynamics that the model misses, and feedback from output to input."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.beside import SideBySide, constant, orthonormal, rest_of, row_blocks
from ctid_cli.inference.noise_model import autoregress, fit_noise_model
from ctid_cli.inference.quantile import normal_tail, robust_deviation
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

    Earlier and later count the samples, whose instants are those at which a controller acts.

    The model is contained in that with one more pole and zero, ``B (s + z) / (A (s + p))`` with z = p; its derivative
    there is the simulated output x behind ``1/(s + p)``, and a few p span what a pole could add.

    Later inputs are freed of what earlier ones tell of them (Sims' test of causality): dynamics that the model misses
    correlate the residuals with the future of an input that is correlated itself, but only by way of its past.
    """
    interval = float(np.median(np.diff(record.t)))
    past, future = min(PAST, t.size // 8), min(FUTURE, t.size // 16)
    inside = slice(int(np.searchsorted(t, record.t[0] + delay)) + past, t.size - future)
    if future < ORDER or inside.stop - inside.start < 2 * (past + future + psi.shape[1]):
        return None
    behind = _behind_a_pole(x - x[0], np.geomspace(1.0, LONGEST * t.size, TRIED))
    e, x, psi = e[inside] - e[inside].mean(), x[inside], psi[inside]
    noise = fit_noise_model([e])
    if not noise.innovation_variance > 0:
        return None
    beside = SideBySide((constant(e.size), psi))
    pole = dependence(e, behind[inside], noise, beside)
    share = 1.0 - _power(rest_of(e, SideBySide((beside, behind[inside])))) / _power(rest_of(e, beside))
    del behind  # as large as all that follows

    def inputs(shift: float, steps: range) -> Array:
        """A look at the input so many samples from each residual, without a copy for every column."""
        values = record.input.at(t - shift) - record.input.mean
        looks = np.lib.stride_tricks.sliding_window_view(values, len(steps))
        return looks[inside.start + min(steps) : inside.stop + min(steps), :: steps.step]

    earlier = inputs(delay, range(min(LATE, int(delay / interval)), -past, -1))
    known = SideBySide((beside, earlier))
    # Between its samples an input along straight lines has moved before the residual.
    first = 0 if record.input.hold == "zoh" else 1
    later = dependence(e, inputs(0.0, range(first, first + future)), noise, known)
    found = [(later.p_value, (later.statistic - later.freedom) / e.size)] if later.freedom else []
    if not first:
        z = _answer_at_once(rest_of(e, known), x, inputs(0.0, range(0, -ORDER - 1, -1)))
        found.append((2 * ANSWERS * normal_tail(z), z * z / e.size))
    likely, told = min(found, default=(1.0, 0.0))
    return InputDependence(pole.p_value, share, min(1.0, len(found) * likely), told)


def _answer_at_once(e: Array, x: Array, u: Array) -> float:
    """How far the input moves with residuals of the last instants, in standard deviations of what chance gives.

    What the input and the simulated output were does not tell all moves: those of a reference that is held are rare
    and large, and would drown the answer to the noise. So they are clipped. Residuals that are white and independent
    of the input are independent of any function of it.
    """
    blocks, inputs = list(row_blocks(e.size - ORDER)), u[ORDER:]
    outputs = np.lib.stride_tricks.sliding_window_view(x, ORDER)[1:]
    before = SideBySide((constant(len(inputs)), inputs[:, 1:], outputs))
    weights = orthonormal(before, 1e-10)
    now = rest = inputs[:, 0]
    weight = np.ones(now.size)
    for _ in range(REWEIGHTED):
        gram, products = np.zeros((weights.shape[1],) * 2), np.zeros(weights.shape[1])
        for rows in blocks:
            basis = before[rows] @ weights
            weighted = weight[rows, None] * basis
            gram += weighted.T @ basis
            products += weighted.T @ now[rows]
        moving = weights @ np.linalg.lstsq(gram, products)[0]
        rest = np.concatenate([now[rows] - before[rows] @ moving for rows in blocks])
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
    columns = np.empty((x.size, time_constants.size))
    for column, p in zip(columns.T, np.exp(-1.0 / time_constants), strict=True):
        behind = (1.0 - p) * x[:, None]
        autoregress(behind, np.array([1.0, -p]))
        column[:] = behind[:, 0]
    return columns


def _power(e: Array) -> float:
    return float(e @ e)
