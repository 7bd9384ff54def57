"""Facts about a record before modelling: clock, input, output, response to the input, and other parts of the output."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.inference.input_response import InputResponse, analyse_response, regular_grid
from ctid_cli.inference.record_tests import SlowTerm, feedback, outlying, slow_columns, slow_terms
from ctid_cli.inference.response_estimates import (
    UNKNOWN,
    Estimate,
    delay,
    response_time,
    signal_to_noise,
    step_responses,
)
from ctid_cli.inference.response_model import Signals, fit_response
from ctid_cli.inference.response_test import LEVEL as NO_RESPONSE
from ctid_cli.inference.response_test import response_test
from ctid_cli.inference.signal_features import InputMoves, growth_time, input_moves, outliers, quantum, saturated
from ctid_cli.inference.spectral_methods import find_period
from ctid_cli.processors import one_thread
from ctid_cli.progress import reported
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

#: An interval longer than this number of median intervals is a gap.
LONG_INTERVAL = 3.0
#: Persistence of excitation is counted up to this order.
HIGHEST_ORDER = 50
#: Largest number of samples for the response; longer records are subsampled.
MOST_SAMPLES = 5000
#: Fewest samples for the response.
FEWEST_SAMPLES = 50
#: An offset of more standard deviations of the output than this is significant without a test.
FAR = 1000.0
#: Quantiles of the range used to detect gross errors.
TAILS = (0.01, 0.99)
#: Iterations of removing outliers and searching for more.
ROUNDS = 3
#: Longest delay in the test of the response [duration of the record].
LONGEST_DELAY = 0.3
#: An output is constant if its deviation is below this fraction of its mean: what rounding leaves.
CONSTANT = 1e-12


@dataclass(frozen=True)
class Gap:
    """An interval without samples."""

    #: Last instant before it [s].
    start: float
    #: Time to the next sample [s].
    length: float


@dataclass(frozen=True)
class Decomposition:
    """Nonparametric response of an output, slow terms, outliers and feedback; NaN or None if not determined."""

    #: Variance of the response over that of the noise [dB].
    signal_to_noise: Estimate = UNKNOWN
    #: Time after a step of the input until 63 % of the final response [s], the delay included.
    response_time: Estimate = UNKNOWN
    #: Time until the output begins to respond [s].
    delay: Estimate = UNKNOWN
    #: Value of the input at rest, for which the offset is defined [input unit].
    input_at_rest: float = math.nan
    offset: SlowTerm | None = None
    drift: SlowTerm | None = None
    start: SlowTerm | None = None
    #: Instants of outliers [s].
    outliers: tuple[float, ...] = ()
    #: p-value of the test for feedback from the output to the input [-].
    feedback_p_value: float = math.nan


@dataclass(frozen=True)
class RecordFacts:
    """Facts about one record; NaN if the record does not determine a value."""

    name: str
    n_samples: int
    n_masked: int
    #: First instant, and time to the last one [s].
    start: float
    duration: float
    #: Median, shortest and longest sampling interval, and the standard deviation of all but the gaps [s].
    interval: float
    interval_min: float
    interval_max: float
    interval_deviation: float
    regular: bool
    gaps: tuple[Gap, ...]
    #: Half the sampling frequency at the median interval [rad/s].
    nyquist: float
    input_kind: str
    #: Mean, standard deviation, least and greatest value of the input during the record [input unit].
    input_mean: float
    input_deviation: float
    input_low: float
    input_high: float
    #: Values that the input returns to [input unit]; empty if there are many.
    input_levels: tuple[float, ...]
    input_changes: int
    #: Shortest time between two changes [s].
    shortest_hold: float
    #: Period of the input [s].
    input_period: float
    #: Order of persistent excitation, counted up to 50 [-].
    excitation_order: int
    #: Frequencies between which 95 % of the power of the input lies [rad/s].
    input_band: tuple[float, float]
    #: Mean, standard deviation, least and greatest value of the output [output unit].
    output_mean: float
    output_deviation: float
    output_low: float
    output_high: float
    #: Quantisation step of the output [output unit]; NaN if negligible.
    output_quantum: float
    #: Fraction of the output samples in runs at its least or greatest value [-].
    saturated: float
    #: Frequency below which 95 % of the response to the input lies [rad/s].
    output_bandwidth: float
    #: Time in which a diverging output grows by a factor of e [s]; NaN for any other.
    growth_time: float = math.nan
    #: p-value of the test for a response to the input [-].
    answer_p_value: float = math.nan
    parts: Decomposition = field(default_factory=Decomposition)

    @property
    def output_constant(self) -> bool:
        """Whether the output does not move, but for rounding."""
        return not self.output_deviation > CONSTANT * abs(self.output_mean)


@one_thread
@reported("facts of the record")
def record_facts(record: Record) -> RecordFacts:
    """Return the facts about a record.

    The response to the input is modelled as a Gaussian process in autoregressive noise (`response_model`), so that the
    tests are valid for noise of any colour and assume no model structure.
    """
    moves = input_moves(record)
    response = analyse_response(record, moves)
    spacing, sampled = sampled_input(record)
    t, present = record.t, record.y[record.valid]
    steps = np.diff(t) if t.size > 1 else np.array([math.nan])
    interval = float(np.median(steps))
    long = np.flatnonzero(steps > LONG_INTERVAL * interval)
    facts = RecordFacts(
        name=record.name,
        n_samples=record.n_samples,
        n_masked=int(np.count_nonzero(~record.valid)),
        start=float(t[0]),
        duration=record.duration,
        interval=interval,
        interval_min=float(steps.min()),
        interval_max=float(steps.max()),
        interval_deviation=float(steps[steps <= LONG_INTERVAL * interval].std()) if t.size > 1 else math.nan,
        regular=record.interval is not None,
        gaps=tuple(Gap(float(t[k]), float(steps[k])) for k in long),
        nyquist=math.pi / interval,
        input_kind=moves.kind,
        input_levels=moves.levels,
        input_changes=int(moves.changes.size),
        shortest_hold=moves.shortest_hold,
        input_period=spacing * (find_period(sampled) or math.nan),
        excitation_order=excitation_order(spacing, sampled, moves, response),
        input_band=response.input_band,
        output_quantum=quantum(present),
        saturated=saturated(present),
        output_bandwidth=response.bandwidth,
        growth_time=growth_time(t[record.valid], present, record.input.at(t[record.valid])),
        **_range("input", record.input.at(t)),
        **_range("output", present),
    )
    if moves.kind == "constant" or facts.output_constant:
        return facts
    parts = decompose(record) if present.size >= FEWEST_SAMPLES else Decomposition()
    p_value = _response_p_value(record)
    if p_value > NO_RESPONSE:
        parts = replace(parts, signal_to_noise=UNKNOWN, response_time=UNKNOWN, delay=UNKNOWN)
    return replace(facts, answer_p_value=p_value, parts=parts)


def _range(signal: str, x: Array) -> dict[str, Any]:
    """Return the fields with the range of a signal."""
    values = {"mean": x.mean(), "deviation": x.std(), "low": x.min(), "high": x.max()}
    return {f"{signal}_{name}": float(value) for name, value in values.items()}


@reported("test for a response")
def _response_p_value(record: Record) -> float:
    """Return the p-value of the test for a response, with the system initially in equilibrium."""
    signal = record.input
    moved = HeldSignal(signal.t, signal.values - signal.at(record.t[:1]), signal.hold)
    test = response_test([replace(record, inputs=moved)], [record.valid], (0.0, LONGEST_DELAY * record.duration))
    return test.p_value


@reported("offset, drift and outliers")
def decompose(record: Record) -> Decomposition:
    """Fit the response of a record with a varying input, without outliers, and test the other parts of the output."""
    every = -(-int(np.count_nonzero(record.valid)) // MOST_SAMPLES)
    interval, places = float(np.median(np.diff(record.t))), np.flatnonzero(record.valid)
    middle = float(np.median(record.y[places]))
    # A very large offset would cause rounding errors in products.
    shift = middle if abs(middle) > FAR * float(np.std(record.y[places])) else 0.0
    removed, far = places[_gross(record.y[places])], np.zeros(0, dtype=np.int64)
    known = ("offset",) if shift else ()
    values = record.input.values
    first, low, high = float(values[0]), float(values.min()), float(values.max())
    befores = {0.0, first}
    for _ in range(ROUNDS):
        removed = np.union1d(removed, far)
        used = np.setdiff1d(places[::every], removed)
        signals = Signals(record.t[used], record.y[used] - shift, record.input, interval)
        model = fit_response(signals, befores)
        terms = slow_terms(model, known)
        if terms["start"].detected and not low <= model.layout.before <= high:
            # Zero would be a step from rest, which the output does not show.
            befores = {first}
            model = fit_response(signals, befores)
            terms = slow_terms(model, known)
        slow = slow_columns(model, terms)
        response, rest = model.parts(slow)
        far = used[outlying(model, rest)]
        if not far.size:
            break
    offset = terms["offset"]
    terms["offset"] = replace(offset, value=offset.value + shift, low=offset.low + shift, high=offset.high + shift)
    steps = step_responses(model, slow)
    return Decomposition(
        signal_to_noise(model, slow),
        response_time(model, steps),
        delay(model, slow, steps),
        model.layout.before,
        **terms,
        outliers=tuple(record.t[np.union1d(removed, far)].tolist()),
        feedback_p_value=feedback(record.input.at(record.t[used]), response, rest, model),
    )


def _gross(y: Array) -> IntArray:
    """Return gross outliers, beyond the range of the other samples by at least that range."""
    low, high = np.quantile(y, TAILS)
    found = outliers(y)
    far: IntArray = found[np.abs(y[found] - 0.5 * (low + high)) > 1.5 * (high - low)]
    return far


def sampled_input(record: Record) -> tuple[float, Array]:
    """Return the interval of a regular grid, and the input on it."""
    grid = regular_grid(record)
    return grid.interval, record.input.at(record.t[0] + grid.interval * (np.arange(grid.u.size) + 1e-6))


@reported("order of excitation")
def excitation_order(interval: float, u: Array, moves: InputMoves, response: InputResponse) -> int:
    """Return the order of persistent excitation, at most 50: the rank of the autocovariance of the input to -40 dB."""
    highest = response.input_band[1]
    if moves.kind == "continuous" and highest > 0:
        # Neighbouring samples of a slow input are nearly equal: subsample it according to its bandwidth.
        u = u[:: max(1, int(math.pi / (1.5 * highest * interval)))]
    order = min(HIGHEST_ORDER, u.size // 3)
    if order < 1 or moves.kind == "constant":
        return 0
    past = np.lib.stride_tricks.sliding_window_view(u, order)[:: max(1, u.size // 20_000)]
    past = past - past.mean(axis=0)
    strength = np.linalg.eigvalsh(past.T @ past)
    return int(np.count_nonzero(strength > 1e-4 * strength[-1]))
