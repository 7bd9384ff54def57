"""Records: output samples and the held inputs of one experiment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import freeze, require_choice
from ctid_cli.signals.data_checks import Rows, check_input, check_output, check_times
from ctid_cli.signals.held import REGULARITY, HeldSignal, Hold, regular_interval
from ctid_cli.signals.treatment import Holds

#: Where the reference enters a loop.
Enters = Literal["controller", "input"]
#: Records of different lengths overlap if all samples at common instants agree and the output changes this many times
#: among them: outputs at rest or in coarse steps agree by chance.
FEW_CHANGES = 20


class Controller(Protocol):
    """The parts of a controller ``C(q)``, or ``C(s)`` in continuous time, needed by a record."""

    @property
    def numerator(self) -> ArrayLike:
        """Coefficients in descending powers of q or s."""

    @property
    def denominator(self) -> ArrayLike:
        """Coefficients in descending powers of q or s."""


@dataclass(frozen=True, eq=False)
class Loop:
    """The feedback loop during a record.

    Parameters
    ----------
    reference : ndarray, shape (N,)
        The reference r at the sampling instants.
    controller : Controller or None
        The controller; None if unknown.
    enters : {"controller", "input"}, default "controller"
        Whether r enters before the controller, ``u = C (r - y)``, or after it, ``u = r - C y``.
    hold : {"zoh", "foh"}, default "zoh"
        Interpolation of the reference between samples, which only matters for a continuous-time controller.

    Raises
    ------
    DataError
        If the reference is not a list of finite numbers.
    ValueError
        If ``enters`` is invalid.
    """

    reference: Array
    controller: Controller | None
    enters: Enters = "controller"
    hold: Hold = "zoh"

    def __post_init__(self) -> None:
        require_choice("enters", self.enters, get_args(Enters))
        require_choice("hold", self.hold, ("zoh", "foh"))
        reference = np.array(self.reference, dtype=float)
        if reference.ndim != 1 or not np.isfinite(reference).all():
            raise DataError("the reference of a loop must be one finite number for each sample")
        freeze(self, reference=reference)

    @property
    def continuous(self) -> bool:
        """Whether the controller acts in continuous time."""
        return bool(getattr(self.controller, "continuous", False))


@dataclass(frozen=True, eq=False)
class Record:
    """Output samples, their instants, and the held input.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants of the output samples [s], strictly increasing.
    y : ndarray, shape (N,)
        Output samples [output unit]; a NaN is a masked (missing) sample.
    inputs : HeldSignal, or mapping of names to HeldSignal or array_like
        The input on its own break times [s]; or several inputs by name. Values without times belong to the instants of
        the output; their hold is not given, as with :meth:`from_arrays`.
    noise_free : ndarray, shape (N,), optional
        The output without noise [output unit], known only for simulated records.
    name : str, default ""
        Source of the record, for messages.
    loop : Loop, optional
        The feedback loop; None for a record in open loop or in an unknown loop.
    feedback : bool, default False
        Whether the input depends on the output in a way that ``loop`` does not describe.

    Raises
    ------
    DataError
        If the record is empty, its times do not increase strictly, or no output is finite; or if there is a loop with a
        discrete controller, and the clock is not regular or the input not constant between samples.

    Notes
    -----
    Arrays are copied and made read-only: a record never changes, and does not change the data of the caller.
    """

    t: Array
    y: Array
    inputs: HeldSignal | Mapping[str, HeldSignal | ArrayLike]
    noise_free: Array | None = None
    name: str = ""
    loop: Loop | None = None
    feedback: bool = False

    def __post_init__(self) -> None:
        t = np.array(self.t, dtype=float)
        y = np.array(self.y, dtype=float)
        rows = Rows(self.name)
        if t.ndim != 1 or t.shape != y.shape:
            shapes = f"{t.shape} and {y.shape}"
            raise DataError(f"{named(self)}times and outputs must be one-dimensional and of equal length; got {shapes}")
        if t.size == 0:
            raise DataError(f"{named(self)}the record is empty")
        check_times(t, "the time", rows)
        check_output(y, "the output", rows)
        object.__setattr__(self, "inputs", _named_inputs(self.inputs, t, named(self)))
        for name, signal in self.held.items():
            check_input(signal.values, f"the input {name}" if self.several else "the input", rows)
        freeze(self, t=t, y=y)
        if self.loop is not None:
            self._require_loop(self.loop)

    def __repr__(self) -> str:
        clock = "irregular clock" if self.interval is None else f"every {self.interval:.6g} s"
        missing = f", {np.count_nonzero(~self.valid)} missing" if not self.valid.all() else ""
        loop = ", in a loop" if self.loop else ""
        inputs = f", inputs {', '.join(self.held)}" if self.several else ""
        name = f"{self.name!r}, " if self.name else ""
        span = f"{self.n_samples} samples from {self.t[0]:g} to {self.t[-1]:g} s"
        return f"Record({name}{span}, {clock}{missing}{inputs}{loop})"

    def _require_loop(self, loop: Loop) -> None:
        where = named(self)
        if loop.reference.size != self.t.size:
            raise DataError(f"{where}the reference has {loop.reference.size} values for {self.t.size} samples")
        if loop.continuous or loop.controller is None:
            return
        if self.interval is None:
            why = "its controller is discrete and acts at every sample, and these are not equidistant"
            raise DataError(f"{where}a closed loop needs a regular clock: {why}")
        if self.input.hold != "zoh" or not self.input_on_grid:
            what = "the input is held (zoh) from one sample to the next"
            raise DataError(f"{where}in a closed loop {what}; give its values at the samples")

    @classmethod
    def from_arrays(cls, t: ArrayLike, u: ArrayLike, y: ArrayLike, hold: Hold | None = None, name: str = "") -> Record:
        """Make a record whose input is given at the instants of the output.

        Parameters
        ----------
        t : array_like, shape (N,)
            Sampling instants [s].
        u : array_like, shape (N,)
            Input samples [input unit].
        y : array_like, shape (N,)
            Output samples [output unit]; NaN marks a missing sample.
        hold : {"zoh", "foh", "band-limited"}, optional
            Interpolation of the input between its samples. If it is not given, an input that changes in steps is
            ``zoh``; of a smooth one, estimators take the hold that fits best, and say so.
        name : str, default ""
            Name in messages.

        Returns
        -------
        Record
            The record.
        """
        times = np.asarray(t, dtype=float)
        signal = HeldSignal(times, np.asarray(u, dtype=float), hold or "zoh", assumed=hold is None)
        return cls(times, np.asarray(y, dtype=float), signal, name=name)

    @property
    def held(self) -> dict[str, HeldSignal]:
        """The inputs by name; a single unnamed input is called u."""
        assert isinstance(self.inputs, dict)
        return self.inputs

    @property
    def several(self) -> bool:
        """Whether there are several inputs."""
        return len(self.held) > 1

    @property
    def input(self) -> HeldSignal:
        """The input of a record with one input.

        Raises
        ------
        DataError
            If there are several inputs.
        """
        self.require_one_input()
        return next(iter(self.held.values()))

    def require_one_input(self) -> None:
        """Raise a DataError if there are several inputs."""
        if self.several:
            raise DataError(
                f"{named(self)}the record has the inputs {', '.join(self.held)}, and this is available for one input "
                "only; give one"
            )

    @property
    def hold(self) -> Holds:
        """Hold of the inputs; a tuple if they differ."""
        each = tuple(signal.hold for signal in self.held.values())
        return each[0] if len(set(each)) == 1 else each

    @property
    def hold_assumed(self) -> bool:
        """Whether the hold of an input was not given."""
        return any(signal.assumed for signal in self.held.values())

    @property
    def hold_options(self) -> list[str]:
        """The hold as values of ``--hold``."""
        if isinstance(self.hold, str):
            return [self.hold]
        return [f"{name}={signal.hold}" for name, signal in self.held.items()]

    @property
    def each_input(self) -> list[Record]:
        """The record with each of its inputs separately."""
        return [self.of_input(name) for name in self.held]

    def of_input(self, name: str) -> Record:
        """Return the record with only one of its inputs.

        Parameters
        ----------
        name : str
            Name of the input.
        """
        return replace(self, inputs={name: self.held[name]}) if self.several else self

    @property
    def in_loop(self) -> bool:
        """Whether the input is known to depend on the output."""
        return self.loop is not None or self.feedback

    @property
    def n_samples(self) -> int:
        """Number of output samples, masked ones included."""
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Time from the first to the last output sample [s]."""
        return float(self.t[-1] - self.t[0])

    @cached_property
    def valid(self) -> BoolArray:
        """Mask of the present output samples, shape (N,)."""
        return np.isfinite(self.y)

    @cached_property
    def bridged_y(self) -> Array:
        """Outputs with missing samples interpolated linearly [output unit], shape (N,)."""
        if self.valid.all():
            return self.y
        return np.asarray(np.interp(self.t, self.t[self.valid], self.y[self.valid]), dtype=float)

    @cached_property
    def interval(self) -> float | None:
        """Sampling interval [s] if the output clock is regular, else None."""
        return regular_interval(self.t)

    @cached_property
    def input_on_grid(self) -> bool:
        """Whether the breaks of the inputs are the output's (regular) sampling instants."""
        interval = self.interval
        if interval is None:
            return False
        return all(
            signal.t.size == self.t.size and bool(np.abs(signal.t - self.t).max() <= REGULARITY * interval)
            for signal in self.held.values()
        )


def beginning(record: Record, samples: int) -> Record:
    """Return the first samples of a record, with the input until the last of them."""
    if record.n_samples <= samples:
        return record
    t = record.t[:samples]
    inputs = {}
    for name, signal in record.held.items():
        known = signal.t <= t[-1]
        inputs[name] = HeldSignal(signal.t[known], signal.values[known], signal.hold)
    return Record(t, record.y[:samples], inputs, name=record.name)


def with_hold(record: Record, hold: Holds) -> Record:
    """Return a record with a given hold of its inputs."""
    if record.hold == hold and not record.hold_assumed:
        return record
    holds = [hold] * len(record.held) if isinstance(hold, str) else hold
    each = zip(record.held.items(), holds, strict=True)
    return replace(record, inputs={name: HeldSignal(one.t, one.values, own) for (name, one), own in each})


def common_samples(record: Record, others: Sequence[Record]) -> int:
    """Return how many samples of a record others have too, perhaps with times shifted by a constant."""
    return sum(_shared(record, other) for other in others)


def _shared(one: Record, other: Record) -> int:
    """Return the number of common samples of two records that are copies of each other or overlap; 0 for others."""
    at_start = float(other.t[0] - one.t[0])
    few = slice(None, None, max(one.n_samples // FEW_CHANGES, 1))
    for shift in dict.fromkeys([0.0, at_start, *_shifts(one, other), *(-each for each in _shifts(other, one))]):
        # Most records differ at the first samples that are compared.
        for part in few, slice(None):
            own, theirs = _at_same_times(one.t[part] + shift, other.t)
            y, equal = one.y[part][own], other.y[theirs]
            if not np.array_equal(y, equal, equal_nan=True):
                break
        else:
            whole = own.size == one.n_samples == other.n_samples
            # Repeated experiments with a coarsely rounded output may agree.
            different = np.unique(y[np.isfinite(y)]).size >= FEW_CHANGES or (
                whole and bool(one.name) and one.name == other.name
            )
            each = list(zip(one.held.values(), other.held.values(), strict=False))
            same = (_same_input(*pair, one.t[own], other.t[theirs]) for pair in each)
            if different and len(one.held) == len(other.held) and all(same):
                return int(own.size)
    return 0


def _shifts(one: Record, other: Record) -> list[float]:
    """Return the shift of time at which the beginning of a record, from its first change on, is in another."""
    own, valid = np.flatnonzero(one.valid), np.flatnonzero(other.valid)
    changed = np.flatnonzero(np.diff(one.y[own]))
    own = own[changed[:1].sum() :][: min(2 * FEW_CHANGES, valid.size)]
    places = np.arange(valid.size - own.size + 1) if changed.size else np.arange(0)
    for k, value in enumerate(one.y[own]):
        places = places[other.y[valid[places + k]] == value]
    # Several shifts are those of a periodic output.
    return (other.t[valid[places]] - one.t[own[0]]).tolist() if places.size == 1 else []


def _at_same_times(one: Array, other: Array) -> tuple[IndexArray, IndexArray]:
    """Return the indices of equal instants of two clocks, up to rounding."""
    slack = 1e-4 * float(other[-1] - other[0]) / max(other.size - 1, 1)
    places = np.minimum(np.searchsorted(other, one - slack), other.size - 1)
    found = np.flatnonzero(np.abs(other[places] - one) <= slack)
    return found, places[found]


def _same_input(one: HeldSignal, other: HeldSignal, own: Array, theirs: Array) -> bool:
    """Return whether two inputs are equal at instants, as far as both are known there."""
    known = (own >= one.t[0]) & (theirs >= other.t[0])
    return bool(known.any()) and np.allclose(one.at(own[known]), other.at(theirs[known]), rtol=1e-9, atol=0.0)


def _named_inputs(
    inputs: HeldSignal | Mapping[str, HeldSignal | ArrayLike], t: Array, where: str
) -> dict[str, HeldSignal]:
    """Return inputs by name; arrays become signals held between the instants of the output."""
    if isinstance(inputs, HeldSignal):
        return {"u": inputs}
    if not isinstance(inputs, Mapping):
        wanted = "a HeldSignal, such as HeldSignal(t, u), or several signals by name"
        arrays = "Record.from_arrays(t, u, y) takes arrays"
        raise DataError(f"{where}inputs must be {wanted}, not {type(inputs).__name__}; {arrays}")
    if not inputs:
        raise DataError(f"{where}there is no input")
    return {
        name: one if isinstance(one, HeldSignal) else HeldSignal(t, np.asarray(one, dtype=float), assumed=True)
        for name, one in inputs.items()
    }


def as_records(records: Any) -> list[Record]:
    """Return one record or several as a list; a DataError for anything else, and for records that overlap."""
    several = list(records) if isinstance(records, Iterable) else [records]
    for one in several:
        if not isinstance(one, Record):
            raise DataError(f"records must be a Record or a list of these, not {type(records).__name__}")
    for (k, one), (later, other) in combinations(enumerate(several, start=1), 2):
        if shared := _shared(one, other):
            names = [f"{number}{f' ({each.name})' * bool(each.name)}" for number, each in ((k, one), (later, other))]
            what = f"records {' and '.join(names)} have {shared} of their samples in common, input and output"
            raise DataError(f"{what}: a copy makes standard errors too small; give each measured sample once")
    return several


def named(record: Record) -> str:
    """Return the beginning of a message about a record."""
    return f"{record.name}: " if record.name else ""
