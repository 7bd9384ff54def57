"""Custom components: base classes for users, and checks of the values that custom estimators return.

The classes of ctid are registered with the bases: ``isinstance(WhiteNoise(variance=1.0), Noise)`` is true.
"""

import copy
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Real
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation import common
from ctid_cli.inference.criteria import fit_percent
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals import noise
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.text import did_you_mean

#: Allowed keys of the mapping that a custom ``fit`` returns.
KEYS = ("parameters", "standard_errors", "status", "message")
_NAME = re.compile(r"[A-Za-z_]\w*(\[\w+\])?", re.ASCII)


class ComponentError(DataError):
    """A custom component changed its arguments, failed, or returned an invalid value."""


# --------------------------------------------------------------------------------------------------------------------
# Base classes


class System(ABC):
    """A custom system, linear or not; its options are the fields of a frozen dataclass.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, System
    >>> @dataclass(frozen=True)
    ... class Squarer(System):
    ...     gain: float = 1.0
    ...     def simulate(self, input, times):
    ...         return self.gain * input.at(times) ** 2
    >>> Squarer(gain=2.0).simulate(HeldSignal([0.0, 1.0], [0.0, 3.0]), np.array([0.0, 1.0]))
    array([ 0., 18.])
    """

    @abstractmethod
    def simulate(self, input: HeldSignal, times: Array) -> Array:
        """Return the output from rest.

        Parameters
        ----------
        input : HeldSignal
            Input of the system [input unit].
        times : ndarray, shape (N,)
            Instants of the samples [s], increasing.

        Returns
        -------
        ndarray, shape (N,)
            Output without noise [output unit].
        """


class Noise(ABC):  # noqa: B024 - one of two methods is enough
    """A custom noise; its options are the fields of a frozen dataclass.

    A subclass defines `generate`, or `generate_at` where the noise depends on the instants of the samples.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import numpy as np
    >>> from ctid_cli import Noise
    >>> @dataclass(frozen=True)
    ... class Uniform(Noise):
    ...     half_width: float
    ...     def generate(self, output, rng):
    ...         return rng.uniform(-self.half_width, self.half_width, output.size)
    >>> Uniform(0.1).generate(np.zeros(3), np.random.default_rng(0)).round(3)
    array([ 0.027, -0.046, -0.092])
    """

    #: Whether samples at different instants are correlated.
    coloured: ClassVar[bool] = True

    def generate(self, output: Array, rng: np.random.Generator) -> Array:
        """Return the noise of one record.

        Parameters
        ----------
        output : ndarray, shape (N,)
            Output without noise [output unit]; zero in a closed loop, where the noise comes first.
        rng : numpy.random.Generator
            Source of random numbers, and the only one.

        Returns
        -------
        ndarray, shape (N,)
            Noise [output unit]; NaN is a missing sample.
        """
        raise NotImplementedError

    def generate_at(self, times: Array, output: Array, rng: np.random.Generator) -> Array:
        """Return the noise of one record at given instants.

        Parameters
        ----------
        times : ndarray, shape (N,)
            Instants of the samples [s], increasing.
        output : ndarray, shape (N,)
            Output without noise [output unit]; zero in a closed loop, where the noise comes first.
        rng : numpy.random.Generator
            Source of random numbers, and the only one.

        Returns
        -------
        ndarray, shape (N,)
            Noise [output unit]; NaN is a missing sample.
        """
        return self.generate(output, rng)


class Estimator(ABC):
    """A custom estimator; its options are the fields of a frozen dataclass.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from ctid_cli import Estimator, HeldSignal, Record
    >>> @dataclass(frozen=True)
    ... class Mean(Estimator):
    ...     def fit(self, record, start=None):
    ...         return {"parameters": {"mean": record.y[record.valid].mean()}}
    >>> record = Record([0.0, 1.0, 2.0], [1.0, 2.0, 6.0], HeldSignal([0.0], [1.0]))
    >>> float(Mean().fit(record)["parameters"]["mean"])
    3.0
    """

    #: Part of a start that it uses: ``"delay"``, ``"parameters"``, or None.
    start_from: ClassVar[common.StartFrom | None] = None

    @abstractmethod
    def fit(self, record: Record, start: common.Start | None) -> Fit | Mapping[str, Any]:
        """Estimate from a record.

        Parameters
        ----------
        record : Record
            The measured record; its arrays are read-only.
        start : Start or None
            Initial values; None unless `start_from` is set.

        Returns
        -------
        Fit or mapping
            The estimate, or its ``parameters`` by name, with ``standard_errors``, ``status`` and ``message`` if it has
            them.
        """


class Measure(ABC):
    """A custom measure of an estimate; its options are the fields of a frozen dataclass.

    Its value is stored with every estimate. Tables show the median over the data sets.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from ctid_cli import Measure
    >>> @dataclass(frozen=True)
    ... class GainError(Measure):
    ...     unit = "%"
    ...     def value(self, fit, data):
    ...         true = data.true_model.steady_state_gain
    ...         return 100.0 * abs(fit.model.steady_state_gain / true - 1.0)
    """

    #: Unit of the value, which tables show.
    unit: ClassVar[str] = "-"

    @abstractmethod
    def value(self, fit: Any, data: Any) -> float:
        """Return the value of the measure.

        Parameters
        ----------
        fit : Fit
            The estimate as the estimator returned it. A returned mapping becomes a fit with ``parameters`` and
            ``standard_errors`` by name, and a ``model`` if the parameters define one. An estimate of the frequencies
            of a signal has ``track``, a `FrequencyTrack`.
        data : DataSet
            Result of `simulate_dataset`: ``record`` and, for a system of ctid, ``true_model``.

        Returns
        -------
        float
            The value [unit]; NaN if undefined.

        Raises
        ------
        Exception
            Any exception leaves the estimate unchanged, without a value of the measure; the text of the exception is
            stored in the message of the estimate.
        """


System.register(TransferFunction)
System.register(AdditiveModel)
Noise.register(noise.Noise)
Estimator.register(common.Estimator)


def is_custom(component: Any) -> bool:
    """Return whether a component is not part of ctid."""
    return component is not None and not type(component).__module__.startswith("ctid_cli.")


# --------------------------------------------------------------------------------------------------------------------
# Estimates


@dataclass(frozen=True, eq=False, repr=False)
class CustomFit(Fit):
    """Named parameters that a custom estimator returned, and the model that they define, if any."""

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


@dataclass(frozen=True, eq=False)
class Prepared:
    """An estimator bound to a record; nothing is computed before the start is known."""

    fit: Callable[..., Any]


@dataclass(frozen=True)
class CustomEstimation:
    """Adapter of a custom estimator to the interface of ctid's estimators."""

    options: Any

    @property
    def start_from(self) -> Any:
        """Part of a start that the estimator uses."""
        return getattr(self.options, "start_from", None)

    def prepare(self, record: Record) -> Prepared:
        """Return the estimator bound to the record."""
        return Prepared(partial(self._fit, record))

    def _fit(self, record: Record, start: Any = None) -> Fit:
        """Estimate from a copy of the record without the noise-free output."""
        inputs = {name: replace(signal) for name, signal in record.held.items()}
        given = replace(record, inputs=inputs, noise_free=None)
        found = called(self.options, "fit", given, start)
        pairs = [(given.t, record.t), (given.y, record.y)]
        for name, signal in record.held.items():
            pairs += [(given.held[name].t, signal.t), (given.held[name].values, signal.values)]
        if not all(np.array_equal(now, then, equal_nan=True) for now, then in pairs):
            raise _changes(self.options, "fit")
        return taken(found, record, f"{type(self.options).__name__}.fit")


def called(options: Any, method: str, *given: Any) -> Any:
    """Call a method on a copy of the options, so that no estimate depends on earlier ones."""
    try:
        return getattr(copy.deepcopy(options), method)(*given)
    except ValueError as error:
        if "read-only" in str(error):
            raise _changes(options, method) from error
        raise


def _changes(options: Any, method: str) -> ComponentError:
    what = f"{type(options).__name__}.{method}"
    return ComponentError(f"{what} changes the record that it is given; copy first: y = np.array(samples)")


def value_of(measure: Measure, fit: Any, data: Any) -> float:
    """Return the value of a measure, which gets copies so that its changes have no effect elsewhere."""
    what = f"{type(measure).__name__}.value"
    measure, fit, data = copy.deepcopy((measure, fit, data))
    value = measure.value(fit, data)
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ComponentError(f"{what} returned {type(value).__name__}; one number is expected, float(...)")
    if np.isinf(value):
        raise ComponentError(f"{what} returned {float(value)}; a number, or NaN where there is no value, is expected")
    return float(value)


def taken(found: Any, record: Record, what: str) -> Fit:
    """Return the fit to be stored, from the value that a custom estimator returned."""
    if isinstance(found, Fit):
        values = [*np.ravel(found.model.numerator), *np.ravel(found.model.denominator), found.model.delay]
        if not np.isfinite(values).all():
            raise ComponentError(f"{what} returned a model with a coefficient that is not finite")
        return found
    status = _stated(found, what)
    named = _numbers(found.get("parameters"), f"{what} returned parameters", finite=status.succeeded)
    errors = _numbers(found.get("standard_errors") or {}, f"{what} returned standard_errors", finite=False)
    if not named:
        raise ComponentError(f"{what} returned no parameters")
    if unknown := errors.keys() - named.keys():
        raise ComponentError(f"{what} returned standard errors of {', '.join(sorted(unknown))}, but no such parameters")
    model = _model(named, what) if np.isfinite([*named.values()]).all() else None
    cost, fit = (float("nan"),) * 2 if model is None else _agreement(model, record)
    names = tuple(named)
    covariance = np.full((len(names), len(names)), np.nan)
    return CustomFit(
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
        message=str(found.get("message") or "Status reported by the custom estimator."),
    )


def _stated(found: Any, what: str) -> Status:
    """Return the status of a mapping, and raise an error if it has unknown keys."""
    if not isinstance(found, Mapping):
        wanted = "a Fit or a mapping with parameters, standard_errors and status is expected"
        raise ComponentError(f"{what} returned {type(found).__name__}, and {wanted}")
    for key in found:
        if key not in KEYS:
            hint = did_you_mean(str(key), KEYS) or ";"
            raise ComponentError(f"{what} returned the key {key!r}{hint} allowed: {', '.join(KEYS)}")
    name = found.get("status", "CONVERGED")
    if not isinstance(name, str) or name not in Status.__members__:
        raise ComponentError(f"{what} returned the status {name!r}; allowed: {', '.join(Status.__members__)}")
    return Status[name]


def _numbers(found: Any, what: str, *, finite: bool) -> dict[str, float]:
    """Return checked numbers by name."""
    if not isinstance(found, Mapping):
        raise ComponentError(f"{what}: {type(found).__name__}; numbers by name are expected, such as {{'b0': 2.0}}")
    values = {}
    for name, value in found.items():
        if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name) > 60:
            raise ComponentError(f"{what}: {name!r} cannot be a name; letters, digits and '_' are allowed, as in tau_1")
        if value is not None and (not isinstance(value, Real) or isinstance(value, bool)):
            raise ComponentError(f"{what}: {name} is {type(value).__name__}; one number is expected, float(...)")
        values[name] = float("nan" if value is None else value)
        if finite and not np.isfinite(values[name]):
            why = "give a status such as DIVERGED, or raise an exception, where there is no estimate"
            raise ComponentError(f"{what}: {name} is {value}; {why}")
    return values


def _model(named: Mapping[str, float], what: str) -> TransferFunction | None:
    """Return the transfer function with coefficients ``b0 …``, ``a1 …`` and ``delay``; None if there are none."""
    given = {letter: [name for name in named if re.fullmatch(rf"{letter}\d+", name)] for letter in "ba"}
    if not given["b"] or not given["a"]:
        return None
    for letter, first in (("b", 0), ("a", 1)):
        expected = [f"{letter}{k}" for k in range(first, first + len(given[letter]))]
        if set(given[letter]) != set(expected):
            message = f"{what} returned {', '.join(given[letter])}; the coefficients in descending powers are"
            raise ComponentError(f"{message} {', '.join(expected)}")
        given[letter] = expected
    if len(given["b"]) > len(given["a"]) + 1:
        numbers = f"{len(given['b'])} coefficients b and {len(given['a'])} a"
        raise ComponentError(f"{what} returned {numbers}: too many zeros")
    numerator, denominator = ([named[name] for name in given[letter]] for letter in "ba")
    if named.get("delay", 0.0) < 0:
        raise ComponentError(f"{what} returned a delay of {named['delay']:g} s; a delay is zero or more")
    return TransferFunction(numerator, [1.0, *denominator], named.get("delay", 0.0))


def _agreement(model: TransferFunction, record: Record) -> tuple[float, float]:
    """Return mean squared output error [output unit^2] and fit [%] from rest; NaN if the simulation fails."""
    from ctid_cli.filtering.simulate import simulate

    try:
        with np.errstate(all="ignore"):
            x, y = simulate(model, record.input, record.t)[record.valid], record.y[record.valid]
            return float(np.mean((y - x) ** 2)), float(fit_percent(y, x))
    except (ValueError, ArithmeticError, DataError, np.linalg.LinAlgError):
        return float("nan"), float("nan")
