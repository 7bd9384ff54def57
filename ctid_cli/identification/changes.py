"""Changes of a fit that may be remedies, and the options of ``ctid fit`` that make them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.estimation.optimum.best_model import Begin
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.identification.choice import fit_options
from ctid_cli.identification.held_back import held_back_errors
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.models.several_inputs import delays_of, fractions_of
from ctid_cli.signals.held import Hold, regular_interval
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import Holds

#: Delays are tried up to this fraction of the shortest record, or this multiple of the greatest that was searched.
LATEST, FARTHER = 0.1, 2.0
#: Number of rates of an added pole, from 3 / duration to the sampling rate, and of starting delays.
RATES, DELAYS = 4, 12
#: Damping of an added pole pair.
DAMPING = 0.3
#: Two poles, a pair, of rate 1 rad/s.
PAIR = np.roots([1.0, 2.0 * DAMPING, 1.0])

Kind = Literal["loss", "structure", "delay", "hold", "treatment"]


@dataclass(frozen=True, eq=False)
class FittedOptions:
    """A fit of an estimator to records with a hold of their inputs."""

    options: DelayProfile
    hold: Holds
    records: tuple[Record, ...]
    fit: MeasuredFit

    @property
    def parameters(self) -> int:
        """Number of free parameters, including those at infinity."""
        return self.fit.theta.size - len(self.fit.known) + self.fit.poles_at_infinity

    @property
    def denominators(self) -> dict[str, DelayProfile]:
        """Options of each denominator by the name of its input, which is empty for a common denominator."""
        each = self.each_input(self.options)
        return {"": self.options} if self.options.common else each

    @property
    def poles(self) -> dict[str, ComplexArray]:
        """Poles of each denominator without integrators [rad/s]."""
        pairs = zip(self.denominators.items(), fractions_of(self.fit.model), strict=False)
        sizes = ((name, model.denominator, model.denominator.size - own.integrators) for (name, own), model in pairs)
        return {name: np.asarray(np.roots(denominator[:size]), dtype=complex) for name, denominator, size in sizes}

    @property
    def rates(self) -> Array:
        """Rates of poles [rad/s] that the records can resolve."""
        longest = max(record.duration for record in self.records)
        shortest = min(float(np.median(np.diff(record.t))) for record in self.records)
        return np.geomspace(3.0 / longest, 1.0 / shortest, RATES)

    @cached_property
    def errors(self) -> list[Array]:
        """Output errors of held-back blocks."""
        return held_back_errors(self.options, self.records, self.start())

    def each_input(self, options: DelayProfile) -> dict[str, DelayProfile]:
        """Return the options of each input by its name, which is empty for a single input."""
        names = tuple(self.records[0].held) if self.records[0].several else ("",)
        return dict(zip(names, options._each(names), strict=True))

    def start(self, poles: Mapping[str, ComplexArray] | None = None, delays: Sequence[float] | None = None) -> Begin:
        """Return the start of a search at the model, with other poles of some denominators, or other delays [s]."""
        each = list((self.poles | dict(poles or {})).values())
        begin = np.concatenate(each) if len(each) > 1 else np.atleast_1d(np.real(np.poly(each[0])))
        return begin, tuple(delays_of(self.fit.model) if delays is None else delays)


class Change(NamedTuple):
    """Changed options and hold, with starts of the search."""

    options: DelayProfile
    hold: Holds
    starts: Sequence[Begin]


def _changed(
    base: FittedOptions, starts: Sequence[Begin] = (), name: str = "", own: Any = None, **fields: Any
) -> Iterator[Change]:
    """Yield a change of options, some of them of a named input, unless the estimator refuses it."""
    options, own = base.options, own or {}
    try:
        if name:
            inputs = {one.name: one for one in options.inputs or ()}
            inputs[name] = replace(inputs.get(name, InputModel(name)), **own)
            options = replace(options, inputs=tuple(inputs.values()), **fields)
        else:
            options = replace(options, **own, **fields)
    except ValueError:
        return
    if options != base.options:
        yield Change(options, base.hold, starts or [base.start()])


def _structures(base: FittedOptions) -> Iterator[Change]:
    """Yield one and two more poles of each denominator, more zeros, and an integrator, added or replacing a pole."""
    options = base.options
    if options.fixed or base.fit.poles_at_infinity:
        return
    offset = "estimate" if options.offset in ("remove", "drift") else options.offset
    for name, own in base.denominators.items():
        poles, n, m = base.poles[name], own.poles, own.zeros
        one = [base.start({name: np.append(poles, -rate)}) for rate in base.rates]
        two = [base.start({name: np.append(poles, rate * PAIR)}) for rate in base.rates]
        for starts, more, zeros in (one, 1, m), (one, 1, m + 1), (two, 2, m + 1), (two, 2, m + 2), ((), 0, m + 1):
            yield from _changed(base, starts, name, {"poles": n + more, "zeros": zeros})
        if not own.integrators:
            fewer = [base.start({name: left}) for left in _with_fewer(poles)]
            yield from _changed(base, (), name, {"integrators": 1}, offset=offset)
            yield from _changed(base, fewer, name, {"poles": n - 1, "integrators": 1}, offset=offset)


def _with_fewer(poles: ComplexArray) -> Iterator[ComplexArray]:
    """Yield poles without one real pole, or with a real pole of the same size in place of a pair."""
    for pole in poles[poles.imag >= 0.0].tolist():
        left = poles[(poles != pole) & (poles != np.conj(pole))]
        yield np.append(left, [-abs(pole)] * (pole.imag > 0.0))


def _delays(base: FittedOptions) -> Iterator[Change]:
    """Yield a range of the delay of each input from zero to a tenth of the record."""
    shortest = min(record.duration for record in base.records)
    for k, (name, own) in enumerate(base.each_input(base.options).items()):
        reach = float(f"{max(FARTHER * own.delay_bounds[1], LATEST * shortest):.2g}")
        if reach < 0.5 * shortest:
            delays = [delays_of(base.fit.model) for _ in range(DELAYS)]
            for each, delay in zip(delays, np.linspace(0.0, reach, DELAYS).tolist(), strict=True):
                each[k] = delay
            starts = [base.start(delays=each) for each in delays]
            yield from _changed(base, starts, name, {"delay_bounds": (0.0, reach)})


def _holds(base: FittedOptions) -> Iterator[Change]:
    """Yield other holds of each input; none for steps, whose hold is visible, nor a band-limited one for jumps."""
    # A discrete controller holds its input.
    if any(record.loop is not None for record in base.records):
        return
    names = list(base.records[0].held)
    holds = [base.hold] * len(names) if isinstance(base.hold, str) else list(base.hold)
    for k, name in enumerate(names):
        own = [record.of_input(name) for record in base.records]
        kinds = {input_moves(record).kind for record in own}
        regular = all(regular_interval(record.input.t) is not None for record in own)
        for hold in get_args(Hold) if not kinds <= {"constant", "steps"} else ():
            if hold != holds[k] and (hold != "band-limited" or (regular and kinds == {"continuous"})):
                changed = (*holds[:k], hold, *holds[k + 1 :])
                yield Change(base.options, changed, [base.start()])


def _treatments(base: FittedOptions) -> Iterator[Change]:
    """Yield an initial state, an offset, both, and a drift."""
    options = base.options
    # The missing treatment may have moved the poles far away.
    alike = [{name: np.full(poles.size, -rate) for name, poles in base.poles.items()} for rate in base.rates]
    starts = [base.start(), *map(base.start, alike)]
    state = "estimate" if options.initial_state == "rest" else options.initial_state
    for offset in dict.fromkeys((options.offset, "estimate", "drift")):
        for initial_state in dict.fromkeys((options.initial_state, state)):
            if (initial_state, offset) == ("estimate", "none"):  # which may hide a step response
                continue
            fields: dict[str, Any] = {"initial_state": initial_state, "offset": offset}
            if initial_state != "rest":
                fields["input_before"] = None
            yield from _changed(base, starts, **fields)


def _losses(base: FittedOptions) -> Iterator[Change]:
    """Yield a loss that outliers do not affect."""
    if base.options.loss == "squares":
        yield from _changed(base, loss="tukey")


CHANGES: dict[Kind, Callable[[FittedOptions], Iterator[Change]]] = {
    "loss": _losses,
    "structure": _structures,
    "delay": _delays,
    "hold": _holds,
    "treatment": _treatments,
}


def option_of(old: FittedOptions, new: FittedOptions) -> str:
    """Return the options of ``ctid fit`` that turn one fit into another."""
    before = fit_options(old.options, old.records[0])
    return " ".join(text for text in fit_options(new.options, new.records[0]) if text not in before)
