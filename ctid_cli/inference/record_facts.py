"""Facts on a record before any model of it: clock, input, output, and what stands beside the response to the input."""

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
from ctid_cli.inference.response_layout import Signals
from ctid_cli.inference.response_model import fit_response
from ctid_cli.inference.response_test import LEVEL as NO_RESPONSE
from ctid_cli.inference.response_test import response_test
from ctid_cli.inference.signal_features import InputMoves, input_moves, outliers, quantum, saturated
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

#: An interval longer than this many median intervals is a gap.
LONG_INTERVAL = 3.0
#: Persistence of excitation is counted up to this order.
HIGHEST_ORDER = 50
#: Of longer records every n-th sample is compared with the response to the whole input.
MOST_SAMPLES = 5000
#: Fewer samples than this show no response beside noise.
FEWEST_SAMPLES = 50
#: An offset of more standard deviations of the output than this needs no test.
FAR = 1000.0
#: Quantiles between which the others lie where gross errors are left out.
TAILS = (0.01, 0.99)
#: Rounds in which outliers are left out and looked for again.
ROUNDS = 3
#: Delays up to this fraction of the record are tried where it is asked whether the output responds at all.
LONGEST_DELAY = 0.3
#: An output moves no more than rounding where its deviation is below this fraction of its mean.
CONSTANT = 1e-9


@dataclass(frozen=True)
class Gap:
    """An interval without samples."""

    #: Last instant before it [s].
    start: float
    #: Time to the next sample [s].
    length: float


@dataclass(frozen=True)
class Beside:
    """What a response without a structure shows, and what stands beside it; nan or None where nothing is shown."""

    #: Variance of the response over that of the noise [dB], with a 95 % interval as all estimates.
    signal_to_noise: Estimate = UNKNOWN
    #: Time after a step of the input until 63 % of the final response [s], the delay included.
    response_time: Estimate = UNKNOWN
    #: Time until the output begins to respond [s].
    delay: Estimate = UNKNOWN
    #: Value of the input at rest, from which the offset counts [input unit].
    input_at_rest: float = math.nan
    offset: SlowTerm | None = None
    drift: SlowTerm | None = None
    start: SlowTerm | None = None
    #: Instants of outliers [s].
    outliers: tuple[float, ...] = ()
    #: Probability that an input which does not depend on the output goes with the noise so much [-].
    feedback_p_value: float = math.nan


@dataclass(frozen=True)
class RecordFacts:
    """Facts on one record; nan stands for what the record does not show."""

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
    #: Values that the input returns to [input unit]; empty where there are many.
    input_levels: tuple[float, ...]
    input_changes: int
    #: Shortest time between two changes [s].
    shortest_hold: float
    #: Time after which the input repeats itself [s].
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
    #: Step in which the output was recorded [output unit]; nan where it is too fine to matter.
    output_quantum: float
    #: Fraction of the output samples that sit exactly at its least or greatest value in runs [-]; 0 for none.
    saturated: float
    #: Frequency below which 95 % of the response to the input lies [rad/s].
    output_bandwidth: float
    #: Probability that noise of the output's colour follows the input as much as the output does [-].
    answer_p_value: float = math.nan
    beside: Beside = field(default_factory=Beside)


def record_facts(record: Record) -> RecordFacts:
    """Return the facts on a record.

    The response to the input is a Gaussian process beside autoregressive noise (`response_model`), so that what stands
    beside it is tested in noise of any colour, and no structure is taken for granted.
    """
    moves = input_moves(record)
    answer = analyse_response(record, moves)
    t, present = record.t, record.y[record.valid]
    steps = np.diff(t) if t.size > 1 else np.array([math.nan])
    interval = float(np.median(steps))
    long = np.flatnonzero(steps > LONG_INTERVAL * interval)
    moving = moves.kind != "constant" and float(present.std()) > CONSTANT * abs(float(present.mean()))
    beside = beside_response(record) if moving and present.size >= FEWEST_SAMPLES else Beside()
    p_value = _response_p_value(record) if moving else math.nan
    if p_value > NO_RESPONSE:
        beside = replace(beside, signal_to_noise=UNKNOWN, response_time=UNKNOWN, delay=UNKNOWN)
    return RecordFacts(
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
        input_period=answer.period,
        excitation_order=excitation_order(record, moves, answer),
        input_band=answer.input_band,
        output_quantum=quantum(present),
        saturated=saturated(present),
        output_bandwidth=answer.bandwidth,
        answer_p_value=p_value,
        beside=beside,
        **_range("input", record.input.at(t)),
        **_range("output", present),
    )


def _range(signal: str, x: Array) -> dict[str, Any]:
    """Fields on the values of a signal."""
    values = {"mean": x.mean(), "deviation": x.std(), "low": x.min(), "high": x.max()}
    return {f"{signal}_{name}": float(value) for name, value in values.items()}


def _response_p_value(record: Record) -> float:
    """Probability that the output follows the input by chance, with the system in equilibrium at first."""
    signal = record.input
    moved = HeldSignal(signal.t, signal.values - signal.at(record.t[:1]), signal.hold)
    test = response_test([record.driven_by(u=moved)], [record.valid], (0.0, LONGEST_DELAY * record.duration))
    return test.p_value


def beside_response(record: Record) -> Beside:
    """Fit the response of a record whose input varies, without outliers, and test what stands beside it."""
    every = -(-int(np.count_nonzero(record.valid)) // MOST_SAMPLES)
    interval, places = float(np.median(np.diff(record.t))), np.flatnonzero(record.valid)
    middle = float(np.median(record.y[places]))
    # Products of so large an offset would round the rest away.
    shift = middle if abs(middle) > FAR * float(np.std(record.y[places])) else 0.0
    wild, far = places[_gross(record.y[places])], np.zeros(0, dtype=np.int64)
    for _ in range(ROUNDS):
        wild = np.union1d(wild, far)
        used = np.setdiff1d(places[::every], wild)
        model = fit_response(Signals(record.t[used], record.y[used] - shift, record.input, interval))
        terms = slow_terms(model, ("offset",) if shift else ())
        slow = slow_columns(model, terms)
        response, rest = model.parts(slow)
        far = used[outlying(model, rest)]
        if not far.size:
            break
    offset = terms["offset"]
    terms["offset"] = replace(offset, value=offset.value + shift, low=offset.low + shift, high=offset.high + shift)
    steps = step_responses(model, slow)
    return Beside(
        signal_to_noise(model, slow),
        response_time(model, steps),
        delay(model, slow, steps),
        model.layout.before,
        **terms,
        outliers=tuple(record.t[np.union1d(wild, far)].tolist()),
        feedback_p_value=feedback(record.input.at(record.t[used]), response, rest, model),
    )


def _gross(y: Array) -> IntArray:
    """Outliers so large that no response should be fitted to them: beyond the range of the others by as much again."""
    low, high = np.quantile(y, TAILS)
    found = outliers(y)
    far: IntArray = found[np.abs(y[found] - 0.5 * (low + high)) > 1.5 * (high - low)]
    return far


def excitation_order(record: Record, moves: InputMoves, answer: InputResponse) -> int:
    """Rank of the autocovariance of the input, at most 50; directions 40 dB below the strongest do not count."""
    grid = regular_grid(record)
    u = record.input.at(record.t[0] + grid.interval * (np.arange(grid.u.size) + 1e-6))
    highest = answer.input_band[1]
    if moves.kind == "continuous" and highest > 0:
        # Of a slow input, neighbouring samples are all alike: look at it as fast as it moves.
        u = u[:: max(1, int(math.pi / (1.5 * highest * grid.interval)))]
    order = min(HIGHEST_ORDER, u.size // 3)
    if order < 1 or moves.kind == "constant":
        return 0
    past = np.lib.stride_tricks.sliding_window_view(u, order)[:: max(1, u.size // 20_000)]
    past = past - past.mean(axis=0)
    strength = np.linalg.eigvalsh(past.T @ past)
    return int(np.count_nonzero(strength > 1e-4 * strength[-1]))
