"""Options of a model and of the treatment of its records, given or chosen, and the models that are compared."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctid_cli.errors import OptionError
from ctid_cli.estimation.common import Bound, Fixed
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.inference.criteria import InformationCriteria
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.response_test import ResponseTest
from ctid_cli.models.additive import terms_text
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import AskedHold, Hold, Holds, InitialState, InputBefore, LossKind, Offset
from ctid_cli.text import probability

#: Options of the compared models: one transfer function, or a sum of submodels.
Searched = DelayProfile | AdditiveOutputError
#: Options that each of several inputs may have itself.
OF_INPUTS = ("poles", "zeros", "integrators", "delay_bounds")
#: Most poles, integrators included, unless more are asked for.
MOST_POLES = 6
#: Bounds at which a pair of poles is undamped, and radians of the record between which the response of such a pair may
#: be an oscillation of the noise: slower ones are two integrators, and faster ones would decay by more than a tenth.
UNDAMPED, RESOLVED, UNRESOLVED = frozenset({"least_damping", "imaginary"}), 3.0, 100.0
#: Poles (integrators included) and zeros of the structures with which settings of records are compared.
SMALL = ((1, 0), (2, 1), (3, 2))


class Span(NamedTuple):
    """Ranges of the numbers of poles (without integrators) and zeros, and the numbers of integrators."""

    poles: tuple[int, int] = (0, MOST_POLES)
    zeros: tuple[int, int] = (0, MOST_POLES)
    integrators: tuple[int, ...] = (0, 1)

    def orders(self, unasked: bool) -> range:
        """Return the numbers of poles, integrators included."""
        most = self.poles[1] + max(self.integrators)
        return range(1, (min(most, max(MOST_POLES, self.zeros[0] + 1)) if unasked else most) + 1)

    def structures(self, order: int, integrators: int, delay_free: bool) -> Iterator[tuple[int, int]]:
        """Yield poles and zeros of all structures of an order, integrators included."""
        poles = order - integrators
        if max(self.poles[0], int(not integrators)) <= poles <= self.poles[1]:
            for zeros in range(self.zeros[0], min(self.zeros[1], order - int(delay_free)) + 1):
                yield poles, zeros

    def small(self, integrators: int, delay_free: bool, most: int = len(SMALL)) -> list[tuple[int, int]]:
        """Return small structures with which settings are compared; the smallest one if none is small."""
        found = [
            (order, each)
            for order in self.orders(unasked=False)
            for each in self.structures(order, integrators, delay_free)
        ]
        small = [each for order, each in found if (order, each[1]) in SMALL[:most]]
        return small or [each for _, each in found[:1]]


@dataclass(frozen=True)
class Given:
    """Given options of a model and of the treatment of its records; what is None is chosen.

    Parameters
    ----------
    poles, zeros : int or tuple of int, optional
        Number, or range of the number, of poles (without integrators) and zeros.
    integrators : int, optional
        Poles at the origin; 0 or 1 is chosen, but 0 if the number of poles is given.
    delay_bounds : tuple of float, optional
        Least and greatest delay [s]; two equal numbers are a known delay.
    initial_state : {"rest", "estimate", "periodic"}, optional
        State before the record.
    offset : {"none", "remove", "estimate", "drift"}, optional
        Offset of the output.
    input_before : float or "first", optional
        Input before the first sample of a record that begins at rest [input unit].
    hold : {"auto", "zoh", "foh", "band-limited"} or tuple of these but "auto", default "auto"
        Hold of the input; a tuple has the hold of each of several inputs.
    loss : {"squares", "huber", "tukey"}, optional
        Loss of output errors; squares are chosen, or tukey if there are outliers and it helps. All else is chosen with
        squares, in the second case without the outliers.
    fixed : tuple of Fixed, optional
        Known parameters of the fit.
    bounds : tuple of Bound, optional
        Bounds of parameters of the fit.
    noise_model : str, default "white"
        Noise model estimated with the plant: ``arma:P,Q``, or ``auto``; the choice does not use it.
    inputs : tuple of InputModel, optional
        Given options of each of several inputs.
    modes : tuple of int, optional
        Range of the number of second-order submodels, if the model is their sum, in place of poles and zeros;
        integrators, in the first submodel, are 0 unless given.
    """

    poles: int | tuple[int, int] | None = None
    zeros: int | tuple[int, int] | None = None
    integrators: int | None = None
    delay_bounds: tuple[float, float] | None = None
    initial_state: InitialState | None = None
    offset: Offset | None = None
    input_before: InputBefore = None
    hold: AskedHold | tuple[Hold, ...] = "auto"
    loss: LossKind | None = None
    fixed: tuple[Fixed, ...] | None = None
    noise_model: str = "white"
    inputs: tuple[InputModel, ...] | None = None
    modes: tuple[int, int] | None = None
    bounds: tuple[Bound, ...] | None = None

    @property
    def typed(self) -> bool:
        """Whether degrees of single inputs are given, so that no structure is chosen."""
        return any((one.poles, one.zeros, one.integrators) != (None,) * 3 for one in self.inputs or ())

    def delays_given(self, record: Record) -> tuple[float, float] | None:
        """Return the range that contains the delays of all inputs of a record.

        Parameters
        ----------
        record : Record
            The record.

        Returns
        -------
        tuple of float or None
            Least and greatest delay [s]; None if one of them is to be chosen.
        """
        own = {one.name: one.delay_bounds for one in self.inputs or ()}
        names = record.held if record.several else ("",)
        given = [self.delay_bounds if own.get(name) is None else own[name] for name in names]
        known = [bounds for bounds in given if bounds is not None]
        if len(known) < len(given):
            return None
        return min(low for low, _ in known), max(high for _, high in known)

    @property
    def delays_of_inputs(self) -> tuple[InputModel, ...] | None:
        """Given delay ranges of single inputs."""
        own = [InputModel(one.name, delay_bounds=one.delay_bounds) for one in self.inputs or ()]
        return tuple(one for one in own if one.delay_bounds is not None) or None

    @property
    def span(self) -> Span:
        """Admitted structures of transfer functions; of sums those with which treatments are compared."""
        if self.modes is not None:
            return Span(integrators=(self.integrators or 0,))
        zeros = (self.zeros, self.zeros) if isinstance(self.zeros, int) else self.zeros
        most = max(MOST_POLES, zeros[0] + 1 if zeros else 0)
        poles = (self.poles, self.poles) if isinstance(self.poles, int) else self.poles or (0, most)
        zeros = zeros or (0, poles[1] + 1)
        none = isinstance(self.poles, int) or self.offset in ("remove", "drift") or self.initial_state == "periodic"
        free = (0,) if none else (0, 1)
        return Span(poles, zeros, free if self.integrators is None else (self.integrators,))

    @property
    def single(self) -> bool:
        """Whether one structure is given."""
        return self.typed or (isinstance(self.poles, int) and isinstance(self.zeros, int) and self.modes is None)

    def check(self) -> None:
        """Raise an OptionError if given options contradict each other."""
        if self.modes is not None and (self.fixed or self.poles is not None or self.zeros is not None):
            raise OptionError("modes", "modes choose the submodels: give no poles, zeros or known coefficients")
        delays = self.delay_bounds or (0.0, 1.0)
        (least, most), (fewest_zeros, _) = self.span.poles, self.span.zeros
        integrators = max(self.span.integrators)
        if isinstance(self.poles, tuple) and fewest_zeros > most + integrators - int(delays[0] < delays[1]):
            raise OptionError("zeros", f"no structure has at least {fewest_zeros} zeros and at most {most} poles")
        # A single structure is checked itself, a range by its fewest poles.
        poles, zeros = (self.poles, fewest_zeros) if isinstance(self.poles, int) else (max(least, 1), 0)
        DelayProfile(
            *(poles, zeros, delays),
            initial_state=self.initial_state or "rest",
            offset=self.offset or "none",
            loss=self.loss or "squares",
            fixed=self.fixed,
            integrators=self.integrators or 0,
            input_before=self.input_before,
            noise_model=self.noise_model,
            inputs=self.inputs,
            bounds=self.bounds,
        )


class HeldBack(NamedTuple):
    """Errors of blocks of the records, each predicted by a fit without its outputs, beside those of another model."""

    #: Fit of all blocks [%].
    percent: float
    #: Mean over the blocks of the logarithm of the ratio of their mean squared errors [-], and its standard error.
    difference: float
    standard_error: float
    #: Whether the errors are not significantly larger than those of the models they are compared with.
    acceptable: bool


def zero_on_integrator(model: TransferFunction, length: float) -> float | None:
    """Return the zero that nearly cancels an integrator over a record of a length [s]; None if there is none."""
    zero = min(model.zeros.real[model.zeros.imag == 0.0], key=abs, default=np.inf)
    return float(zero) if model.denominator[-1] == 0.0 and abs(zero) * length < 1.0 else None


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model that is compared with others on the same samples.

    Parameters
    ----------
    options : DelayProfile or AdditiveOutputError
        Structure, range of the delay, and treatment of state and offset.
    hold : {"zoh", "foh", "band-limited"}
        Hold of the input.
    fit : MeasuredFit
        Fit with the least squared output error found, without standard errors.
    size : int
        Number of parameters, including those of each record.
    criterion : float
        Value of the criterion; only differences between candidates are meaningful.
    criteria : InformationCriteria
        AICc, BIC and FPE of the innovations.
    held_back : HeldBack, optional
        Errors of held-back blocks beside those of the candidate of least criterion, if they were computed.
    """

    options: Searched
    hold: Holds
    fit: MeasuredFit
    size: int
    criterion: float = float("nan")
    criteria: InformationCriteria | None = None
    held_back: HeldBack | None = None

    @property
    def name(self) -> str:
        """Poles, zeros and integrators: ``2/1``, ``1/0 + 1`` or, for several inputs, ``3/1,2``; for a sum its terms."""
        options = self.options
        if isinstance(options, AdditiveOutputError):
            return terms_text(options.terms)
        integrators = f" + {options.integrators}" if options.integrators else ""
        own = [options.zeros if one.zeros is None else one.zeros for one in options.inputs or ()]
        zeros = ",".join(map(str, own)) if len(set(own)) > 1 else f"{own[0] if own else options.zeros}"
        return f"{options.poles}/{zeros}{integrators}"

    @property
    def is_proper(self) -> bool:
        """Whether all poles are finite, no pair may follow an oscillation of the noise, nor an integrator its drift."""
        fit, box = self.fit, self.fit.box
        if fit.poles_at_infinity or box is None:
            return not fit.poles_at_infinity
        length = 1.0 / box.spread[0]
        if isinstance(fit.model, TransferFunction) and zero_on_integrator(fit.model, length) is not None:
            return False
        followed = [pole for pole in fit.held_poles if RESOLVED < abs(pole.imag) * length < UNRESOLVED]
        return not any(UNDAMPED & set(box.met_by(pole)) for pole in followed)

    @property
    def structure(self) -> tuple[int, int]:
        """Number of integrators, and number of poles with them."""
        return self.options.integrators, self.options.order

    def value(self, name: str) -> object:
        """Return the hold of the input, or an option.

        Parameters
        ----------
        name : str
            ``hold``, or the name of an option.

        Returns
        -------
        object
            Its value.
        """
        return self.hold if name == "hold" else getattr(self.options, name)


@dataclass(frozen=True, eq=False)
class Ranking:
    """Candidates by increasing criterion, and their noise model."""

    candidates: tuple[Candidate, ...]
    noise: NoiseModel

    @property
    def best(self) -> Candidate:
        """Proper candidate of least criterion."""
        return next((each for each in self.candidates if each.is_proper), self.candidates[0])

    def of(self, **options: object) -> "Ranking | None":
        """Return the candidates with these options; None if there are none."""
        found = [each for each in self.candidates if all(each.value(name) == own for name, own in options.items())]
        return Ranking(tuple(found), self.noise) if found else None

    def runner_up(self, *names: str) -> Candidate | None:
        """Return the first candidate that differs from the best in a named option, or None."""
        best = [self.best.value(name) for name in names]
        return next((each for each in self.candidates if [each.value(n) for n in names] != best), None)


@dataclass(frozen=True, eq=False)
class Choice:
    """A structure and a treatment, with the candidates from which they were chosen.

    Parameters
    ----------
    options : DelayProfile or AdditiveOutputError
        Options to fit.
    records : tuple of Record
        Records with the chosen hold.
    fitted : tuple of Record
        These records, or parts of long ones, to which the candidates were fitted.
    ranking : Ranking
        All structures of the grid by increasing criterion.
    taken : Candidate
        The chosen one, which need not have the least criterion.
    answer : ResponseTest
        Test for a response of the outputs to the inputs.
    sentences : tuple of str
        One for each choice, with its criterion and that of the runner-up.
    gains : dict of str to tuple of float
        Static gains with other treatments of the records that the criterion does not reject, if their signs differ.
    holds : tuple
        Other holds of the input that the criterion does not reject.
    """

    options: Searched
    records: tuple[Record, ...] = field(repr=False)
    fitted: tuple[Record, ...] = field(repr=False)
    ranking: Ranking = field(repr=False)
    taken: Candidate = field(repr=False)
    answer: ResponseTest
    sentences: tuple[str, ...]
    gains: dict[str, tuple[float, ...]] = field(default_factory=dict)
    holds: tuple[Holds, ...] = ()

    @property
    def has_model(self) -> bool:
        """Whether a response is detected."""
        return self.answer.seen

    @property
    def why_no_model(self) -> str:
        """Reason why there is no model."""
        evidence = f" {self.answer.evidence}" if self.answer.explained == self.answer.explained else ""
        return (
            "No model: no response of the output to the input is detected "
            f"({probability(self.answer.p_value)}).{evidence}"
        )

    def words(self) -> list[str]:
        """Return the choice as options of ``ctid fit``."""
        return " ".join(fit_options(self.options, self.records[0])).split()


def fit_options(options: Searched, record: Record) -> list[str]:
    """Return the options of ``ctid fit`` for an estimator and the hold of a record; related ones are one text."""
    found, inputs = list[str](), tuple[InputModel, ...]()
    if isinstance(options, AdditiveOutputError):
        found.append(f"--model additive --terms {terms_text(options.terms)}")
    else:
        inputs = options.inputs or ()
    # Options of all inputs that each of them has itself.
    replaced = [name for name in OF_INPUTS if sum(getattr(one, name) is not None for one in inputs) == len(record.held)]
    for part in (options, *inputs):
        of = f"{part.name}=" if isinstance(part, InputModel) else ""
        own = {name: getattr(part, name) for name in OF_INPUTS if of or name not in replaced}
        if not isinstance(part, AdditiveOutputError):
            degrees = ((name, own.get(name)) for name in ("poles", "zeros"))
            found.append(" ".join(f"--{name} {of}{number}" for name, number in degrees if number is not None))
        if own.get("integrators"):
            found.append(f"--integrators {of}{part.integrators}")
        if own.get("delay_bounds") is not None:
            low, high = own["delay_bounds"]
            found.append(f"--delay {of}{low:g}:{high:g}" if low < high else f"--delay {of}{low:g}")
    found += [f"--initial-state {options.initial_state}", f"--offset {options.offset}"]
    if options.initial_state == "rest" and options.offset != "remove":
        before = options.input_before
        found.append(f"--input-before {before if before == 'first' else f'{before or 0.0:g}'}")
    found += [f"--loss {options.loss}"] * (options.loss != "squares")
    return [*filter(None, found), *(f"--hold {text}" for text in record.hold_options)]
