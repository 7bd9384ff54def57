"""Options of a model and of the treatment of its records, given or chosen."""

from dataclasses import dataclass, field

from ctid_cli.errors import OptionError
from ctid_cli.estimation.common import Bound, Fixed
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.identification.candidates import MOST_POLES, Span
from ctid_cli.identification.criterion import Ranking, Searched
from ctid_cli.inference.response_test import ResponseTest
from ctid_cli.models.additive import terms_text
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import AskedHold, Hold, Holds, InitialState, InputBefore, LossKind, Offset
from ctid_cli.text import probability

#: Options that each of several inputs may have itself.
OF_INPUTS = ("poles", "zeros", "integrators", "delay_bounds")


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

    @property
    def delays_given(self) -> tuple[float, float] | None:
        """Range that contains the delays of all inputs; None if one of them is to be chosen."""
        own = [one.delay_bounds for one in self.inputs or ()]
        given = [self.delay_bounds if bounds is None else bounds for bounds in own] or [self.delay_bounds]
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
        """Admitted structures; if degrees of single inputs are given, small ones to compare treatments."""
        if self.modes is not None:
            return Span(integrators=(self.integrators or 0,), modes=self.modes)
        if self.typed:
            own = [one.integrators for one in self.inputs or () if one.integrators is not None]
            treated = None not in (self.initial_state, self.offset, self.delays_given) and self.hold != "auto"
            # The smallest structure suffices if no treatment is to be chosen.
            poles, zeros = ((1, 1), (0, 0)) if treated else ((1, 3), (0, 2))
            return Span(poles, zeros, (max(own, default=self.integrators or 0),))
        poles, zeros = (
            (each, each) if isinstance(each, int) else each or (0, MOST_POLES) for each in (self.poles, self.zeros)
        )
        none = isinstance(self.poles, int) or self.offset in ("remove", "drift") or self.initial_state == "periodic"
        free = (0,) if none else (0, 1)
        integrators = free if self.integrators is None else (self.integrators,)
        return Span(poles, zeros, integrators, fixed=self.fixed, bounds=self.bounds)

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
        All structures of the grid, the best first.
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
