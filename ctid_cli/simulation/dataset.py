"""Data sets: the record that estimators are given, and its source."""

import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.custom_code import reason
from ctid_cli.errors import DataError, OptionError
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import ContinuousController, ContinuousPid, Relay
from ctid_cli.models.factoring import factored, factored_jacobian
from ctid_cli.models.several_inputs import MultiInputModel, SystemModel, parts_of
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_integer
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.files import COPIES, file_sha256
from ctid_cli.signals.held import HeldSignal, Hold, regular_interval
from ctid_cli.signals.measurement import Offset, read_measurement
from ctid_cli.signals.noise import stream
from ctid_cli.signals.record import Enters, Loop, Record
from ctid_cli.signals.sampling import Sampling
from ctid_cli.simulation.components import ComponentError, Noise, System, is_custom

#: First replicate number of the fresh data sets for validation; above the largest allowed in an experiment.
FRESH = 2**31


@dataclass(frozen=True)
class LoopOptions:
    """Feedback around a system."""

    #: A `DiscreteController`, a `ContinuousPid` (by its gains), a `ContinuousController` or a `Relay`.
    controller: Any
    reference: Excitation | None = None
    enters: Enters = "controller"

    def at(self, interval: float) -> Self:
        """Return the loop with its controller discretised at a sampling interval."""
        if not isinstance(self.controller, ContinuousPid):
            return self
        return dataclasses.replace(self, controller=self.controller.discrete(interval))


class InSubmodels(NamedTuple):
    """Parameters of submodels by name; None if an estimate has none."""

    parameters: dict[str, float] | None = None
    standard_errors: Mapping[str, float] = MappingProxyType({})
    #: Standard errors to each side of the 95 % intervals.
    quantiles: Mapping[str, float] = MappingProxyType({})


def additive_parameters(fit: Any, terms: Sequence[Term] | None) -> InSubmodels:
    """Return parameters by name, with errors and quantiles for an estimated fraction.

    These are the submodels' parameters of one transfer function, and all of several inputs.

    The covariance of a fraction's coefficients is transformed by the Jacobian of its partial fractions. A fraction has
    no such parameters if its poles are repeated, or their number or the number of complex pairs does not fit the terms.
    """
    additive = getattr(fit, "additive", None)
    if additive is not None:
        return InSubmodels(additive.parameters)
    if isinstance(fit.model, MultiInputModel):
        return InSubmodels(fit.coefficients)
    if terms is None or fit.model is None:
        return InSubmodels()
    try:
        with np.errstate(all="ignore"):  # overflow raises DataError
            model = factored(fit.model, terms)
            jacobian = factored_jacobian(fit.model, model)
    except (DataError, np.linalg.LinAlgError):
        return InSubmodels()
    coefficients, names = list(fit.model.parameters), list(fit.parameter_names)
    errors, quantiles = np.full((2, len(model.names)), np.nan)
    # A leading zero is a parameter but not a coefficient of the model: the powers would not match.
    if set(names) - {"delay"} == set(coefficients):
        places = [names.index(name) for name in coefficients]
        with np.errstate(invalid="ignore"):
            covariance = jacobian @ fit.covariance[np.ix_(places, places)] @ jacobian.T
            errors = np.sqrt(np.diag(covariance))
        if fit.law is None:
            quantiles[:] = normal_quantile()
        else:
            quantiles = fit.law.transformed(jacobian @ np.eye(len(names))[places]).quantiles()
    stated = (dict(zip(model.names, each.tolist(), strict=True)) for each in (errors, quantiles))
    return InSubmodels(model.parameters, *stated)


@dataclass(frozen=True, eq=False)
class DataSet:
    """A record with its true model and validation record, where known."""

    record: Record
    true_model: SystemModel | None = None
    validation: Record | None = None
    #: Function that returns the record of a fresh data set, if requested.
    fresh: Callable[[], Record] | None = None

    def result_of(self, fit: Any, start: Any, terms: Sequence[Term] | None) -> dict[str, Any]:
        """Return the stored quantities of a fit to the record."""
        parameters, errors, quantiles = additive_parameters(fit, terms)
        errors, quantiles = {**fit.standard_errors, **errors}, {**fit.quantiles, **quantiles}
        law = fit.law
        # Custom estimators may give parameters of any name, and no model.
        named, model = getattr(fit, "named", {}), fit.model
        fraction = None if isinstance(model, MultiInputModel) else model
        # Only fits by useful redundancy have a search.
        search = getattr(fit, "search", None)
        return {
            "status": fit.status.name,
            "message": getattr(fit, "message", "") or str(fit.status.value),
            "start_delay": None if start is None else start.delay,
            "delay": named.get("delay") if fraction is None else fraction.delay,
            "numerator": None if fraction is None else fraction.numerator,
            "denominator": None if fraction is None else fraction.denominator,
            "parameters": {**named, **(parameters or {})} or None,
            "standard_errors": errors,
            "covariance": "" if law is None else law.kind,
            "degrees_of_freedom": law.degrees_of_freedom if law and law.kind in ("white", "robust") else None,
            "quantiles": {name: quantiles[name] for name, error in errors.items() if np.isfinite(error)} or None,
            "marks": " ".join(fit.marks()) if hasattr(fit, "marks") else "",
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

    #: Of several inputs the model with the excitation of each by its name.
    system: SystemModel | System
    excitation: Excitation | Mapping[str, Excitation] | None
    sampling: Sampling
    noise: Noise | None
    seed: int
    loop: LoopOptions | None = None
    #: Whether models are also validated on a fresh data set.
    fresh: bool = False

    def dataset(self, replicate: int) -> DataSet:
        """Return one realisation."""
        data = self._realised(replicate)
        return replace(data, fresh=lambda: self._realised(FRESH + replicate).record) if self.fresh else data

    def require_stable(self) -> None:
        """Raise an error for an unstable loop; a loop with a relay is exempt because its input is bounded."""
        from ctid_cli.filtering.loop import loop_radius

        if self.loop is None or isinstance(self.loop.controller, Relay):
            return
        interval = self.sampling.mean_interval
        with at("loop.controller"):
            try:
                with np.errstate(all="ignore"):
                    radius = loop_radius(self.system, self.loop.at(interval).controller, interval)  # type: ignore[arg-type]
            except np.linalg.LinAlgError:
                overflow = f"the loop: its numbers overflow at intervals of {interval:g} s; scale the coefficients"
                raise DataError(overflow) from None
            if not radius < 1.0:
                largest = f"at intervals of {interval:g} s its largest pole has the magnitude {radius:.6g}"
                raise DataError(f"the loop with the true system is unstable: {largest}; lower the gain")

    @property
    def generators(self) -> dict[str, tuple[str, Any]]:
        """Place and what makes it of each input, or of the reference of the loop, by its name."""
        if self.loop is not None:
            return {"u": ("loop.reference", self.loop.reference)}
        if isinstance(self.excitation, Mapping):
            return {name: (f"inputs.{name}.excitation", one) for name, one in self.excitation.items()}
        return {"u": ("excitation", self.excitation)}

    @property
    def parts(self) -> dict[str, Any]:
        """Components that generate the data, by specification key and in order of evaluation."""
        generators = dict(self.generators.values())
        return {"sampling": self.sampling, **generators, "system": self.system, "noise": self.noise}

    def _realised(self, replicate: int) -> DataSet:
        with at("sampling"):
            times = samples_of(_as_planned(self.sampling), "times", stream(self.seed, "sampling", replicate))
            if times.size < 2 or not (np.diff(times) > 0).all():
                wanted = "must return two or more instants that increase"
                raise ComponentError(f"{_called(self.sampling, 'times')} {wanted}")
        applied: dict[str, HeldSignal] = {}
        for number, (name, (place, generator)) in enumerate(self.generators.items()):
            with at(place):
                applied[name] = _applied(generator, times, stream(self.seed, "input", replicate, number))
        if self.loop is not None:
            system = self.system
            assert isinstance(system, TransferFunction | AdditiveModel)
            reference = applied["u"]
            held = HeldSignal(times, reference.at(times), reference.hold)
            return DataSet(self._record_in(self.loop, system, held, replicate), true_model=system)
        true_model = self.system if isinstance(self.system, SystemModel) else None
        with at("system"):
            if true_model is None:
                output = samples_of(self.system, "simulate", applied["u"], times, size=times.size)
            else:
                output = _simulated(true_model, applied, times)
        y = output + self._drawn(times, output, replicate)
        if self.sampling.input_record == "sampled":
            applied = {name: HeldSignal(times, one.at(times), one.hold) for name, one in applied.items()}
        return DataSet(Record(times, y, applied, noise_free=output), true_model=true_model)

    def _record_in(
        self, loop: LoopOptions, system: TransferFunction | AdditiveModel, reference: HeldSignal, replicate: int
    ) -> Record:
        from ctid_cli.filtering.loop import simulate_continuous_loop, simulate_loop

        times, r, controller, hold = reference.t, reference.values, loop.controller, reference.hold
        # The noise comes before the output, because the output depends on it.
        noise = self._drawn(times, np.zeros(times.size), replicate)
        if isinstance(controller, ContinuousController):
            with at("loop.controller"):
                u, x = simulate_continuous_loop(system, controller, reference, noise, loop.enters)
        else:
            interval = regular_interval(times)
            if interval is None:
                raise DataError("a closed loop needs a regular clock, since its controller acts at every sample")
            controller, hold = loop.at(interval).controller, "zoh"
            with at("loop.controller"):
                u, x = simulate_loop(system, controller, r, noise, interval, loop.enters)
        # Estimators know the loops of linear controllers only.
        closed = None if isinstance(controller, Relay) else Loop(r, controller, loop.enters, hold)
        return Record(times, x + noise, HeldSignal(times, u, hold), noise_free=x, loop=closed, feedback=True)

    def _drawn(self, times: Array, output: Array, replicate: int) -> Array:
        if self.noise is None:
            return np.zeros(output.size)
        rng = stream(self.seed, "noise", replicate)
        with at("noise"):
            if getattr(type(self.noise), "generate_at", Noise.generate_at) is not Noise.generate_at:
                return samples_of(self.noise, "generate_at", times, output, rng, size=output.size, missing=True)
            return samples_of(self.noise, "generate", output, rng, size=output.size, missing=True)


@contextmanager
def at(place: str) -> Iterator[None]:
    """Add the specification key to a DataError raised inside."""
    try:
        yield
    except DataError as error:
        error.section = error.section or place
        raise


def made(component: Any, method: str, *given: Any) -> Any:
    """Call a method of a component with read-only arrays."""
    for array in given:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    try:
        return getattr(component, method)(*given)
    except Exception as error:
        if is_custom(component):
            raise ComponentError(f"{_called(component, method)} failed: {reason(error)}") from error
        raise


def samples_of(component: Any, method: str, *given: Any, size: int | None = None, missing: bool = False) -> Array:
    """Return the checked numbers that a component generates, one for each sample."""
    found = made(component, method, *given)
    wanted = f"and an array of {'' if size is None else f'{size} '}finite numbers is expected"
    try:
        values = np.array(found, dtype=float)
    except (TypeError, ValueError):
        raise ComponentError(f"{_called(component, method)} returned {type(found).__name__}, {wanted}") from None
    if values.ndim != 1 or size not in (None, values.size):
        raise ComponentError(f"{_called(component, method)} returned an array of shape {values.shape}, {wanted}")
    bad = ~np.isfinite(values) & ~(missing & np.isnan(values))
    if bad.any():
        raise ComponentError(f"{_called(component, method)} returned {values[bad][0]}, {wanted}")
    return values


def _called(component: Any, method: str) -> str:
    """Return the name of a method of a component for a message."""
    return f"{type(component).__name__}.{method}"


@dataclass(frozen=True, eq=False)
class MeasuredSource:
    """Data set from a measured record.

    Parameters
    ----------
    file : str
        File with the record, relative to the folder of the specification.
    sha256 : str, optional
        SHA-256 of the file.
    time : str, default "t"
        Column of the instants [s].
    input : str, default "u"
        Column of the input [input unit].
    output : str, default "y"
        Column of the output [output unit]; empty or NaN is a missing sample.
    hold : {"zoh", "foh", "band-limited"}, default "zoh"
        Intersample behaviour of the input.
    offset : {"remove", "none"}, default "none"
        Whether to subtract the means of input and output over the estimation samples.
    estimation_samples : int, optional
        Number of first samples for estimation; the others are for validation. Null uses all for estimation.
    reference : str, optional
        Column of the reference, if the record was taken in closed loop; `loop` has the controller.
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
    reference: str | None = None
    loop: LoopOptions | None = None

    def __post_init__(self) -> None:
        if self.estimation_samples is not None:
            require_integer("estimation_samples", self.estimation_samples, 2)
        known = self.loop is None or not isinstance(self.loop.controller, ContinuousController)
        if self.reference is not None and self.hold != "zoh" and known:
            raise OptionError("hold", "must be zoh in a loop: a discrete controller holds the input")

    def dataset(self, replicate: int) -> DataSet:
        """Read the record."""
        if replicate != 0:
            raise ValueError(f"a measured record has replicate 0 only, not {replicate}")
        file = self.file if self.sha256 is None else require_content(self.file, self.sha256)
        columns: dict[str, Any]
        columns = {"time": self.time, "input": self.input, "output": self.output, "reference": self.reference}
        measured = read_measurement(file, **columns, hold=self.hold, in_seconds=True)
        whole = measured.record
        t, u, y = whole.t, whole.input.values, whole.y
        count = t.size if self.estimation_samples is None else self.estimation_samples
        used = f"the {count} samples used for estimation"
        if count > t.size:
            raise DataError(f"{self.file}: estimation_samples is {count}, but the file has {t.size} samples")
        if not np.isfinite(y[:count]).any():
            raise DataError(f"{self.file}: the output is not a finite number in any of {used}")
        if np.ptp(u[:count]) == 0.0:
            constant = f"the input {self.input!r} is constant ({u[0]:g}) over {used}"
            raise DataError(f"{self.file}: {constant}; it excites nothing to identify")
        loop = None
        if measured.reference_values is not None:
            r = measured.reference_values[:count]
            if self.loop is not None:
                mean = r.mean() if self.offset == "remove" else 0.0
                # A record of a loop with an irregular clock raises an error elsewhere.
                controller = self.loop.at(regular_interval(t[:count]) or 1.0).controller
                loop = Loop(r - mean, controller, self.loop.enters, "foh" if self.hold == "foh" else "zoh")
        if self.offset == "remove":
            # Means over the estimation samples only: the validation samples must not affect the model.
            u = u - u[:count].mean()
            y = y - np.nanmean(y[:count])
        # Without its folder, because messages of estimators that contain the name are stored.
        name = Path(self.file).name
        signal = HeldSignal(t[:count], u[:count], self.hold)
        record = Record(t[:count], y[:count], signal, name=name, loop=loop, feedback=self.loop is not None)
        rest = np.where(np.arange(t.size) < count, np.nan, y)
        if not np.isfinite(rest).any():
            return DataSet(record)
        return DataSet(record, validation=Record(t, rest, HeldSignal(t, u, self.hold), name=name))


Source = SimulatedSource | MeasuredSource


def _applied(generator: Any, times: Array, rng: np.random.Generator) -> HeldSignal:
    """Return what drives a simulation: an input, or the reference of a loop."""
    if generator is None:  # a relay needs no reference
        return HeldSignal(times[:1], np.zeros(1))
    generator = _as_planned(generator)
    found = made(generator, "generate", times, rng)
    if not isinstance(found, HeldSignal):
        text = f"{_called(generator, 'generate')} returned {type(found).__name__}"
        raise ComponentError(f"{text}, and a ctid_cli.HeldSignal(t, values) is expected")
    return found


def _simulated(model: SystemModel, inputs: Mapping[str, HeldSignal], times: Array) -> Array:
    """Return the output of a model: the sum of its responses to all inputs."""
    from ctid_cli.filtering.simulate import simulate, simulate_additive

    responses = [
        simulate_additive(part, inputs[name], times)
        if isinstance(part, AdditiveModel)
        else simulate(part, inputs[name], times)
        for name, part in parts_of(model, inputs).items()
    ]
    return np.asarray(np.sum(responses, axis=0))


def _fit_percent(model: Any, record: Record | None, output: str) -> float | None:
    """Return the fit of a model to an output of a record [%]; None if any of the three is missing."""
    from ctid_cli.inference.criteria import fit_percent

    wanted: Array | None = getattr(record, output, None)
    if model is None or record is None or wanted is None:
        return None
    there = np.isfinite(wanted)
    return float(fit_percent(wanted[there], _simulated(model, record.held, record.t)[there]))


def joined(folder: Path, file: str) -> str:
    """Return the path of a file relative to the working directory."""
    return Path(os.path.normpath(folder / file)).as_posix()


def located(options: Any, folder: Path) -> Any:
    """Return the options with the path of their file, if any, relative to the working directory."""
    if is_custom(options) or not hasattr(options, "file"):
        return options
    return dataclasses.replace(options, file=joined(folder, options.file))


def require_content(path: str, sha256: str) -> str:
    """Return the path of a file, and raise an error if its content is not that of the planned experiment."""
    if sha256 in COPIES:
        return COPIES[sha256]
    found = file_sha256(path)
    if found != sha256:
        planned = f"differs from that of the planned experiment ({sha256[:12]}…)"
        restore = "restore the file, or run the changed one as a separate experiment"
        raise DataError(f"{path}: the content (SHA-256 {found[:12]}…) {planned}; {restore}")
    return path


def _as_planned(options: Any) -> Any:
    """Return options that read a file with the path of the planned file."""
    sha256 = None if is_custom(options) else getattr(options, "sha256", None)
    return options if sha256 is None else replace(options, file=require_content(options.file, sha256))
