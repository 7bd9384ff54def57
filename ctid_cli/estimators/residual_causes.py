"""What may be behind residuals that fail their tests: each cause is tried, and the cost falls or it does not."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.estimators.measured_submodels import LaidOut, Options
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.inference.residual_tests import SideBySide, constant, dependence, normal_tail, rest_of
from ctid_cli.signals.record import Record

#: Rates of a further pole, from three periods of the record to the sampling rate; delays tried outside the range.
RATES, DELAYS = 4, 12
#: Greatest delay that is tried: this times that of the range, and this fraction of the record.
FARTHER, OF_RECORD = 2.0, 0.1
#: Probability of such an evidence of a bad clock where the clock is good.
CLOCK = 1e-6


@dataclass(frozen=True)
class Richer:
    """A model that is richer than the one that was fitted."""

    poles: int
    zeros: int
    delay: float
    #: Fraction by which it lowers the cost [-].
    fall: float


@dataclass(frozen=True)
class Clock:
    """Errors that go with the speed of the output."""

    #: Share of the variance of the errors [-], and standard deviation of the instants [s].
    share: float
    jitter: float
    p_value: float


def another_order(laid_out: LaidOut, fit: MeasuredFit, options: Options) -> Richer | None:
    """One more pole, and a zero if that does better; None where it cannot be tried."""
    if not isinstance(laid_out, MeasuredRecords) or fit.known or fit.weighting is not None or fit.model.order >= 12:
        return None
    problem, bounds = laid_out.problem, laid_out.treatment.delay_bounds
    longest = max(float(np.ptp(data.t)) for data in problem.records)
    shortest = min(float(np.median(np.diff(data.t))) for data in problem.records)
    found = []
    for zeros in (options.zeros, options.zeros + 1):
        richer = problem._replace(zeros=zeros)
        for rate in np.geomspace(3.0 / longest, 1.0 / shortest, RATES):
            poles = np.append(fit.model.poles, -rate)
            least = local_minimum(richer, poles, fit.model.delay, bounds).squared_error
            found.append(Richer(options.poles + 1, zeros, fit.model.delay, _fall(least, fit)))
    plain = max(found[:RATES], key=lambda one: one.fall)
    best = max(found, key=lambda one: one.fall)
    # A zero more has to be worth it.
    return best if best.fall > plain.fall + 0.1 * (1.0 - plain.fall) else plain


def another_delay(laid_out: LaidOut, fit: MeasuredFit, options: Options) -> Richer | None:
    """The best delay outside the range that was searched; None where it cannot be tried."""
    if not isinstance(laid_out, MeasuredRecords) or fit.weighting is not None:
        return None
    low, high = options.delay_bounds
    longest = max(float(np.ptp(data.t)) for data in laid_out.problem.records)
    greatest = max(FARTHER * high, min(OF_RECORD * longest, 5.0 / _slowest(laid_out, fit)))
    if greatest >= 0.5 * longest:
        return None
    trials = [float(delay) for delay in np.linspace(0.0, greatest, DELAYS) if not low <= delay <= high]
    if options.zeros == options.poles or not trials:
        return None
    near = laid_out.problem, laid_out.free_poles(fit.model)
    costs = [local_minimum(*near, delay, (0.0, greatest), known=laid_out.known) for delay in trials]
    best = min(costs, key=lambda local: local.squared_error)
    return Richer(options.poles, options.zeros, best.point.delay.seconds, _fall(best.squared_error, fit))


def _slowest(laid_out: MeasuredRecords, fit: MeasuredFit) -> float:
    """Least magnitude of a pole but the integrators [rad/s]; infinite where there is none."""
    return float(np.abs(laid_out.free_poles(fit.model)).min(initial=np.inf))


def clock_evidence(fit: MeasuredFit, records: Sequence[Record]) -> Clock:
    """Whether errors are larger, or of the sign that a slow clock gives, where the output moves fast."""
    return max((_of_record(*parts) for parts in _parts(fit, records)), key=lambda one: one.share)


def _parts(fit: MeasuredFit, records: Sequence[Record]) -> Iterator[tuple[Array, Array, Array, Array]]:
    for e, psi, use, record in zip(fit.residuals, fit.sensitivities, fit.used, records, strict=True):
        t = record.t[use]
        yield e, psi, t, np.gradient(record.y[use] - e, t)


def _of_record(e: Array, psi: Array, t: Array, speed: Array) -> Clock:
    """Jitter makes ``e^2`` follow the squared speed; a clock that wanders makes e follow the speed times slow waves."""
    noise, energy = fit_noise_model([e]), speed**2
    if not noise.innovation_variance > 0 or np.ptp(energy) == 0.0 or e.size < 50:
        return Clock(0.0, 0.0, 1.0)
    white = noise.innovations(e)
    squares, moving = white**2 - np.mean(white**2), energy - energy.mean()
    slope = float(squares @ moving / (moving @ moving))
    z = float(squares @ moving) / float(np.sqrt((squares**2) @ (moving**2)))
    share = slope * float(energy.mean()) / float(np.mean(white**2))
    if slope > 0 and (chance := normal_tail(z)) < CLOCK:
        return Clock(min(share, 1.0), float(np.sqrt(slope)), chance)
    return _wandering(e, psi, t, speed)


def _wandering(e: Array, psi: Array, t: Array, speed: Array) -> Clock:
    place = (t - t[0]) / float(t[-1] - t[0])
    waves = np.column_stack([place - 0.5, *(wave(k * np.pi * place) for k in (1, 2, 3) for wave in (np.cos, np.sin))])
    beside, columns = SideBySide((constant(t.size), psi)), speed[:, None] * waves
    rest, left = rest_of(e, beside), rest_of(e, SideBySide((beside, columns)))
    noise = fit_noise_model([left])
    if not noise.innovation_variance > 0:
        return Clock(0.0, 0.0, 1.0)
    chance = dependence(e, columns, noise, beside).p_value
    share = 1.0 - float(left @ left) / float(rest @ rest)
    away = float(np.sqrt(np.mean((rest - left) ** 2) / np.mean(speed**2)))
    return Clock(share if chance < CLOCK else 0.0, away, chance)


def _fall(squared_error: float, fit: MeasuredFit) -> float:
    return max(1.0 - squared_error / (fit.cost * fit.count), 0.0)
