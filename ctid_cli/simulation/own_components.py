"""Components of one's own at work: what they are given, and what of theirs is taken.

Each class here stands in the place of one of ours and holds the options that a specification gave, an instance of a
class that the user wrote. Whatever such an instance returns is checked here and nowhere else.
"""

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.inference.criteria import fit_percent
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.own_code import reason
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import Noise
from ctid_cli.signals.record import Record
from ctid_cli.signals.sampling import InputRecord, Sampling
from ctid_cli.text import did_you_mean

#: What a mapping may hold that a fit returns.
KEYS = ("parameters", "standard_errors", "status", "message")
_NAME = re.compile(r"[A-Za-z_]\w*(\[\w+\])?", re.ASCII)


class ContractError(DataError):
    """A component of one's own, which it knows, did what it must not, or returned what it must not."""

    def __init__(self, message: str, component: Any = None) -> None:
        super().__init__(message)
        self.component = component


def called(options: Any, method: str) -> str:
    """How a message names a method of a component."""
    return f"{type(options).__name__}.{method}"


def _asked(options: Any, method: str, *given: Any) -> Any:
    """What a component answers; arrays that it is given cannot be changed."""
    for array in given:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    try:
        return getattr(options, method)(*given)
    except Exception as error:
        raise ContractError(f"{called(options, method)} failed: {reason(error)}", options) from error


def _samples(options: Any, method: str, given: tuple[Any, ...], size: int | None, *, missing: bool = False) -> Array:
    """The numbers that a component answers, one for each sample."""
    found = _asked(options, method, *given)
    wanted = f"and an array of {'' if size is None else f'{size} '}finite numbers is expected"
    try:
        values = np.array(found, dtype=float)
    except (TypeError, ValueError):
        raise ContractError(f"{called(options, method)} returned {type(found).__name__}, {wanted}", options) from None
    if values.ndim != 1 or (size is not None and values.size != size):
        shape = f"an array of shape {values.shape}"
        raise ContractError(f"{called(options, method)} returned {shape}, {wanted}", options)
    bad = ~np.isfinite(values) & ~(missing & np.isnan(values))
    if bad.any():
        raise ContractError(f"{called(options, method)} returned {values[bad][0]}, {wanted}", options)
    return values


# --------------------------------------------------------------------------------------------------------------------
# What data are made of


@dataclass(frozen=True)
class OwnExcitation(Excitation):
    """An input of one's own."""

    options: Any

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """The signal over one record."""
        found = _asked(self.options, "generate", sample_times, rng)
        if not isinstance(found, HeldSignal):
            text = f"{called(self.options, 'generate')} returned {type(found).__name__}"
            raise ContractError(f"{text}, and a ctid_cli.HeldSignal(t, values) is expected", self.options)
        return found


@dataclass(frozen=True)
class OwnSampling(Sampling):
    """A sampling scheme of one's own."""

    options: Any

    @property
    def input_record(self) -> InputRecord:  # type: ignore[override]
        """What the estimator is told of the input."""
        return "sampled" if getattr(self.options, "input_record", "exact") == "sampled" else "exact"

    @property
    def samples(self) -> int:  # type: ignore[override]
        """Number of samples of a record."""
        return self._some.size

    @property
    def mean_interval(self) -> float:
        """Mean interval of a record [s]."""
        return float(np.ptp(self._some) / (self._some.size - 1))

    @property
    def _some(self) -> Array:
        return self.times(np.random.default_rng(0))

    def times(self, rng: np.random.Generator) -> Array:
        """Instants [s]."""
        found = _samples(self.options, "times", (rng,), None)
        if found.size < 2 or not (np.diff(found) > 0).all():
            wanted = "must return two or more instants that increase"
            raise ContractError(f"{called(self.options, 'times')} {wanted}", self.options)
        return found


@dataclass(frozen=True)
class OwnNoise(Noise):
    """A noise of one's own; NaN is a missing output."""

    coloured: ClassVar[bool] = True
    snr_db: ClassVar[None] = None  # type: ignore[misc]

    options: Any

    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        """What is added to the output."""
        return _samples(self.options, "generate", (noise_free, rng), noise_free.size, missing=True)


@dataclass(frozen=True)
class OwnClockedNoise(OwnNoise):
    """A noise of one's own that asks for the instants of the samples."""

    def generate_at(self, times: Array, noise_free: Array, rng: np.random.Generator) -> Array:
        """What is added to the output."""
        return _samples(self.options, "generate", (noise_free, times, rng), noise_free.size, missing=True)


@dataclass(frozen=True)
class OwnSystem:
    """A system of one's own, linear or not."""

    options: Any

    def simulate(self, applied: HeldSignal, times: Array) -> Array:
        """Its output."""
        return _samples(self.options, "simulate", (applied, times), times.size)


# --------------------------------------------------------------------------------------------------------------------
# Estimators


@dataclass(frozen=True, eq=False, repr=False)
class OwnFit(Fit):
    """Named parameters that an estimator of one's own returned, and the model that they make, if they make one."""

    model: TransferFunction | None  # type: ignore[assignment]
    iterations: int | None  # type: ignore[assignment]
    named: Mapping[str, float] = field(default_factory=dict)
    named_errors: Mapping[str, float] = field(default_factory=dict)
    message: str = ""

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters by name."""
        return dict(self.named)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name."""
        return dict(self.named_errors)


@dataclass(frozen=True)
class OwnEstimation:
    """An estimator of one's own in the place of one of ours."""

    options: Any

    @property
    def start_from(self) -> Any:
        """What it takes from a start."""
        return getattr(self.options, "start_from", None)

    def prepare(self, record: Record) -> "PreparedOwn":
        """Nothing is computed before a start is known."""
        return PreparedOwn(self.options, record)


@dataclass(frozen=True, eq=False)
class PreparedOwn:
    """An estimator of one's own, with a record."""

    options: Any
    record: Record

    def fit(self, start: Any = None) -> Fit:
        """Estimate.

        The estimator gets copies of its options and of the record, without what no measurement has. So no estimate
        depends on what was estimated before, in this process or in another.
        """
        record, what = self.record, called(self.options, "fit")
        given = replace(record, input=replace(record.input), noise_free=None)
        changes = ContractError(f"{what} changes the record that it is given; copy first: y = record.y.copy()")
        try:
            found = copy.deepcopy(self.options).fit(given, start)
        except ValueError as error:
            if "read-only" in str(error):
                raise changes from error
            raise
        pairs = [(given.t, record.t), (given.y, record.y), (given.input.t, record.input.t)]
        pairs += [(given.input.values, record.input.values)]
        if not all(np.array_equal(now, then, equal_nan=True) for now, then in pairs):
            raise changes
        return taken(found, record, what)


def taken(found: Any, record: Record, what: str) -> Fit:
    """A fit as it is stored, from what an estimator of one's own returned."""
    if isinstance(found, Fit):
        values = [*np.ravel(found.model.numerator), *np.ravel(found.model.denominator), found.model.delay]
        if not np.isfinite(values).all():
            raise ContractError(f"{what} returned a model with a coefficient that is not finite")
        return found
    status = _stated(found, what)
    named = _numbers(found.get("parameters"), f"{what} returned parameters", finite=status.succeeded)
    errors = _numbers(found.get("standard_errors") or {}, f"{what} returned standard_errors", finite=False)
    if not named:
        raise ContractError(f"{what} returned no parameters")
    if unknown := errors.keys() - named.keys():
        raise ContractError(f"{what} returned standard errors of {', '.join(sorted(unknown))}, but no such parameters")
    model = _model(named, what) if np.isfinite([*named.values()]).all() else None
    cost, fit = (float("nan"),) * 2 if model is None else _agreement(model, record)
    names = tuple(named)
    covariance = np.full((len(names), len(names)), np.nan)
    return OwnFit(
        model=model,
        parameter_names=names,
        covariance=covariance,
        status=status,
        cost=cost,
        fit_percent=fit,
        r2=float("nan"),
        count=int(record.valid.sum()),
        iterations=None,
        condition_number=float("nan"),
        named=named,
        named_errors={name: errors.get(name, float("nan")) for name in names},
        message=str(found.get("message") or "The estimator says so."),
    )


def _stated(found: Any, what: str) -> Status:
    """The status of a mapping that has only keys which it may have."""
    if not isinstance(found, Mapping):
        wanted = "a Fit or a mapping with parameters, standard_errors and status is expected"
        raise ContractError(f"{what} returned {type(found).__name__}, and {wanted}")
    for key in found:
        if key not in KEYS:
            raise ContractError(f"{what} returned the key {key!r}{did_you_mean(str(key), KEYS) or ';'} allowed: {KEYS}")
    name = found.get("status", "CONVERGED")
    if not isinstance(name, str) or name not in Status.__members__:
        raise ContractError(f"{what} returned the status {name!r}; allowed: {', '.join(Status.__members__)}")
    return Status[name]


def _numbers(found: Any, what: str, *, finite: bool) -> dict[str, float]:
    """Numbers by name."""
    if not isinstance(found, Mapping):
        raise ContractError(f"{what}: {type(found).__name__}; numbers by name are expected, such as {{'b0': 2.0}}")
    values = {}
    for name, value in found.items():
        if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name) > 60:
            raise ContractError(f"{what}: {name!r} cannot be a name; letters, digits and '_' are allowed, as in tau_1")
        if value is not None and (not isinstance(value, Real) or isinstance(value, bool)):
            raise ContractError(f"{what}: {name} is {type(value).__name__}; one number is expected, float(...)")
        values[name] = float("nan" if value is None else value)
        if finite and not np.isfinite(values[name]):
            why = "give a status such as DIVERGED, or raise an exception, where there is no estimate"
            raise ContractError(f"{what}: {name} is {value}; {why}")
    return values


def _model(named: Mapping[str, float], what: str) -> TransferFunction | None:
    """The transfer function that ``b0 …``, ``a1 …`` and ``delay`` make, in descending powers; None without them."""
    given = {letter: [name for name in named if re.fullmatch(rf"{letter}\d+", name)] for letter in "ba"}
    if not given["b"] or not given["a"]:
        return None
    for letter, first in (("b", 0), ("a", 1)):
        expected = [f"{letter}{k}" for k in range(first, first + len(given[letter]))]
        if set(given[letter]) != set(expected):
            message = f"{what} returned {', '.join(given[letter])}; the coefficients in descending powers are"
            raise ContractError(f"{message} {', '.join(expected)}")
        given[letter] = expected
    if len(given["b"]) > len(given["a"]) + 1:
        raise ContractError(f"{what} returned {len(given['b'])} coefficients b and {len(given['a'])} a: too many zeros")
    numerator, denominator = ([named[name] for name in given[letter]] for letter in "ba")
    if named.get("delay", 0.0) < 0:
        raise ContractError(f"{what} returned a delay of {named['delay']:g} s; a delay is zero or more")
    return TransferFunction(numerator, [1.0, *denominator], named.get("delay", 0.0))


def _agreement(model: TransferFunction, record: Record) -> tuple[float, float]:
    """Mean squared output error [output unit^2] and fit [%] from rest; NaN where the model cannot be simulated."""
    from ctid_cli.filtering.simulate import simulate

    try:
        with np.errstate(all="ignore"):
            x, y = simulate(model, record.input, record.t)[record.valid], record.y[record.valid]
            return float(np.mean((y - x) ** 2)), float(fit_percent(y, x))
    except (ValueError, ArithmeticError, DataError, np.linalg.LinAlgError):
        return float("nan"), float("nan")
