"""Data sets: the record that estimators are given, and what is known besides."""

import dataclasses
import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import ContinuousPid, Relay
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_integer
from ctid_cli.signals.csv_file import Offset, read_held_signal, read_record
from ctid_cli.signals.drifts import ContinuousNoise, noise_at
from ctid_cli.signals.excitation import Excitation, InputFile
from ctid_cli.signals.files import require_file
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.noise import Noise
from ctid_cli.signals.record import Enters, Loop, Record
from ctid_cli.signals.recorder import Recorder
from ctid_cli.signals.regularity import regular_interval
from ctid_cli.signals.sampling import Sampling
from ctid_cli.signals.send_on_delta import SendOnDelta
from ctid_cli.signals.streams import stream
from ctid_cli.simulation.additive_parameters import additive_parameters
from ctid_cli.simulation.own_components import OwnSystem

#: Data sets to try models on are numbered from here: no experiment has so many.
FRESH = 2**31


@dataclass(frozen=True)
class LoopOptions:
    """What closes a loop around a system."""

    #: A `DiscreteController`, or by its gains a `ContinuousPid`, or a `Relay`.
    controller: Any
    reference: Excitation | None = None
    enters: Enters = "controller"

    def at(self, interval: float) -> Self:
        """The loop with the controller that acts at a sampling interval."""
        if not isinstance(self.controller, ContinuousPid):
            return self
        return dataclasses.replace(self, controller=self.controller.discrete(interval))


@dataclass(frozen=True, eq=False)
class DataSet:
    """A record and what is known of its origin."""

    record: Record
    true_model: TransferFunction | AdditiveModel | None = None
    validation: Record | None = None
    #: Makes the record of a fresh data set, if one is asked for.
    fresh: Callable[[], Record] | None = None

    def result_of(self, fit: Any, start: Any, terms: Sequence[Term] | None) -> dict[str, Any]:
        """What is stored of a fit to the record."""
        parameters, errors, quantiles = additive_parameters(fit, terms)
        errors, quantiles = {**fit.standard_errors, **errors}, {**fit.quantiles, **quantiles}
        law = fit.law
        # Of estimators of one's own, which may give parameters of any name, and no model.
        named, model = getattr(fit, "named", {}), fit.model
        # Of useful redundancy alone.
        search = getattr(fit, "search", None)
        return {
            "status": fit.status.name,
            "message": getattr(fit, "message", "") or str(fit.status.value),
            "start_delay": None if start is None else start.delay,
            "delay": named.get("delay") if model is None else model.delay,
            "numerator": None if model is None else model.numerator,
            "denominator": None if model is None else model.denominator,
            "parameters": {**named, **(parameters or {})} or None,
            "standard_errors": errors,
            "covariance": "" if law is None else law.kind,
            "degrees_of_freedom": law.degrees_of_freedom if law and law.kind in ("white", "robust") else None,
            "quantiles": {name: quantiles[name] for name, error in errors.items() if np.isfinite(error)} or None,
            "cost": fit.cost,
            "fit_percent": fit.fit_percent,
            "validation_fit_percent": _fit_percent(model, self.validation, "y"),
            "fresh_fit_percent": _fit_percent(model, self._fresh_record, "noise_free"),
            "iterations": None if fit.iterations is None else int(fit.iterations),
            "search_delay": None if search is None else search.point,
            "switches": None if search is None else len(search.switches),
            "condition_number": fit.condition_number,
        }

    @cached_property
    def _fresh_record(self) -> Record | None:
        return None if self.fresh is None else self.fresh()


@dataclass(frozen=True, eq=False)
class SimulatedSource:
    """Data sets from a simulated system."""

    system: TransferFunction | AdditiveModel | OwnSystem
    excitation: Excitation | None
    sampling: Sampling
    noise: Noise | ContinuousNoise | None
    seed: int
    loop: LoopOptions | None = None
    recorder: Recorder = field(default_factory=Recorder)
    #: Whether models are tried on a data set besides the one that they are estimated from.
    fresh: bool = False

    def dataset(self, replicate: int) -> DataSet:
        """One realisation."""
        data = self._realised(replicate)
        return replace(data, fresh=lambda: self._realised(FRESH + replicate).record) if self.fresh else data

    def _realised(self, replicate: int) -> DataSet:
        generator = self.excitation if self.loop is None else self.loop.reference
        if isinstance(generator, InputFile) and generator.sha256 is not None:
            require_content(generator.file, generator.sha256)
        times = self.sampling.times(stream(self.seed, "sampling", replicate))
        applied = HeldSignal(times[:1], np.zeros(1))  # a relay needs no reference
        if generator is not None:
            applied = generator.generate(times, stream(self.seed, "input", replicate))
        if self.loop is not None:
            assert not isinstance(self.system, OwnSystem)
            return DataSet(self._record_in(self.loop, times, applied.at(times), replicate), true_model=self.system)
        output = _simulated(self.system, applied, times)
        y = self.recorder.rounded(output + self._drawn(times, output, replicate))
        if isinstance(self.sampling, SendOnDelta):
            sent = self.sampling.sent(y)
            times, output, y = times[sent], output[sent], y[sent]
        known = applied
        if self.sampling.input_record == "sampled":
            known = HeldSignal(times, applied.at(times), applied.hold)
        record = Record(times, self._with_losses(y, replicate), known, noise_free=output)
        return DataSet(record, true_model=None if isinstance(self.system, OwnSystem) else self.system)

    def _record_in(self, loop: LoopOptions, times: Array, reference: Array, replicate: int) -> Record:
        from ctid_cli.filtering.loop import simulate_loop

        assert not isinstance(self.system, OwnSystem)
        interval = regular_interval(times)
        if interval is None:
            raise DataError("a closed loop needs a regular clock, since its controller acts at every sample")
        # The noise comes before the output, because the output answers to it.
        noise = self._drawn(times, np.zeros(times.size), replicate)
        controller = loop.at(interval).controller
        u, x = simulate_loop(self.system, controller, reference, noise, interval, loop.enters)
        # Estimators know the loops of linear controllers only.
        closed = None if isinstance(controller, Relay) else Loop(reference, controller, loop.enters)
        y = self._with_losses(self.recorder.rounded(x + noise), replicate)
        return Record(times, y, HeldSignal(times, u), noise_free=x, loop=closed, feedback=True)

    def _drawn(self, times: Array, output: Array, replicate: int) -> Array:
        if self.noise is None:
            return np.zeros(output.size)
        return noise_at(self.noise, times, output, stream(self.seed, "noise", replicate))

    def _with_losses(self, y: Array, replicate: int) -> Array:
        return self.recorder.with_losses(y, stream(self.seed, "recorder", replicate))


@dataclass(frozen=True, eq=False)
class MeasuredSource:
    """A measured record in place of a simulated one.

    Parameters
    ----------
    file : str
        Comma-separated file, relative to the folder of the specification.
    sha256 : str, optional
        SHA-256 of the file.
    time : str, default "t"
        Column of the instants [s].
    input : str, default "u"
        Column of the input [input unit].
    output : str, default "y"
        Column of the output [output unit]; empty or NaN is a missing sample.
    hold : {"zoh", "foh", "band-limited"}, default "zoh"
        How the input behaves between its samples.
    offset : {"remove", "none"}, default "none"
        What is done to the means of input and output over the samples for estimation.
    estimation_samples : int, optional
        Identify on the first so many samples and judge on the rest; null identifies on all.
    reference : str, optional
        Column of the reference, if the record was taken in a loop; loop has the controller.
    loop : LoopOptions, optional
        The loop.
    """

    file: str
    sha256: str | None = None
    time: str = "t"
    input: str = "u"
    output: str = "y"
    hold: Hold = "zoh"
    offset: Offset = "none"
    estimation_samples: int | None = None
    reference: str | None = field(default=None, metadata={"added_later": True})
    loop: LoopOptions | None = None

    def __post_init__(self) -> None:
        if self.estimation_samples is not None:
            require_integer("estimation_samples", self.estimation_samples, 2)
        if self.reference is not None and self.hold != "zoh":
            raise OptionError("hold", "must be zoh in a loop: a discrete controller holds the input")

    def dataset(self, replicate: int) -> DataSet:
        """The record."""
        if replicate != 0:
            raise ValueError(f"a measured record has replicate 0 only, not {replicate}")
        if self.sha256 is not None:
            require_content(self.file, self.sha256)
        whole = read_record(self.file, time=self.time, input=self.input, output=self.output, hold=self.hold)
        t, u, y = whole.t, whole.input.values, whole.y
        count = t.size if self.estimation_samples is None else self.estimation_samples
        used = f"the {count} samples used for estimation"
        if count > t.size:
            raise DataError(f"{self.file}: {count} samples are asked for and the file has {t.size}")
        if not np.isfinite(y[:count]).any():
            raise DataError(f"{self.file}: the output is no finite number in any of {used}")
        if np.ptp(u[:count]) == 0.0:
            constant = f"the input {self.input!r} is constant ({u[0]:g}) over {used}"
            raise DataError(f"{self.file}: {constant}; it excites nothing to identify")
        loop = None
        if self.reference is not None:
            r = read_held_signal(self.file, time=self.time, input=self.reference).values[:count]
            if self.loop is not None:
                mean = r.mean() if self.offset == "remove" else 0.0
                # A record of a loop is refused where its clock is not regular.
                controller = self.loop.at(regular_interval(t[:count]) or 1.0).controller
                loop = Loop(r - mean, controller, self.loop.enters)
        if self.offset == "remove":
            # The remaining samples must not have a say in what the model is made of.
            u = u - u[:count].mean()
            y = y - np.nanmean(y[:count])
        # Without its folder: what an estimator says about the record is part of the results.
        name = Path(self.file).name
        signal = HeldSignal(t[:count], u[:count], self.hold)
        record = Record(t[:count], y[:count], signal, name=name, loop=loop, feedback=self.loop is not None)
        rest = np.where(np.arange(t.size) < count, np.nan, y)
        if not np.isfinite(rest).any():
            return DataSet(record)
        return DataSet(record, validation=Record(t, rest, HeldSignal(t, u, self.hold), name=name))


Source = SimulatedSource | MeasuredSource


def _simulated(system: TransferFunction | AdditiveModel | OwnSystem, applied: HeldSignal, times: Array) -> Array:
    """Output of a model."""
    from ctid_cli.filtering.simulate import simulate, simulate_additive

    if isinstance(system, OwnSystem):
        return system.simulate(applied, times)
    if isinstance(system, AdditiveModel):
        return simulate_additive(system, applied, times)
    return simulate(system, applied, times)


def _fit_percent(model: Any, record: Record | None, output: str) -> float | None:
    """Fit of a model to an output of a record [%], where there are all three."""
    from ctid_cli.inference.criteria import fit_percent

    wanted: Array | None = getattr(record, output, None)
    if model is None or record is None or wanted is None:
        return None
    there = np.isfinite(wanted)
    return float(fit_percent(wanted[there], _simulated(model, record.input, record.t)[there]))


def joined(folder: Path, file: str) -> str:
    """Name of a file as seen from the working directory."""
    return Path(os.path.normpath(folder / file)).as_posix()


def located(options: Any, folder: Path) -> Any:
    """Options with the name of the file that they read, if any, as seen from the working directory."""
    return dataclasses.replace(options, file=joined(folder, options.file)) if hasattr(options, "file") else options


def file_sha256(path: str) -> str:
    """Content hash of a file."""
    if not Path(path).exists():
        raise DataError(f"{path}: there is no such file; names start at the folder of the specification")
    require_file(path)
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: the file cannot be read: {error.strerror or error}") from None


def require_content(path: str, sha256: str) -> None:
    """Refuse a file that is not the one that an experiment was planned with."""
    found = file_sha256(path)
    if found != sha256:
        planned = f"is not that which the experiment was planned with ({sha256[:12]}…)"
        restore = "restore the file, or run the changed one as an experiment of its own"
        raise DataError(f"{path}: the content (SHA-256 {found[:12]}…) {planned}; {restore}")
