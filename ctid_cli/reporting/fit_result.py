"""Result of ``ctid fit``: an estimated model with its uncertainty and diagnostics."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.errors import StorageError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import Identification, Options, models_of
from ctid_cli.estimators.loop_output_error import LoopFit, LoopOutputError
from ctid_cli.estimators.measured_fit import MeasuredFit, MultiInputFit
from ctid_cli.estimators.measured_submodels import SubmodelsFit
from ctid_cli.identification.sentences import spelled
from ctid_cli.inference.fit import Status
from ctid_cli.inference.noise_estimate import NoiseEstimate
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.inference.units import Units
from ctid_cli.models.several_inputs import fractions_of
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.estimate import PARAMETER, parameter_rows
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.fit_content import DERIVED, additive_of, derived_of, fit_content, parameters_of
from ctid_cli.reporting.fit_plot import FitFigures
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.model_plot import figure_chapters, inputs_drawing
from ctid_cli.reporting.pages.page import Chapter, PagedResult, shown
from ctid_cli.reporting.pages.question import formula
from ctid_cli.reporting.records import Records
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Loop, Record
from ctid_cli.signals.treatment import Hold
from ctid_cli.storage.fit_file import fit_text
from ctid_cli.text import count, listed, probability
from ctid_cli.written_files import write_file

FIT_DEFINITION = "100 (1 - ||y - x|| / ||y - mean y||)"
R2_DEFINITION = "1 - ||y - x||^2 / ||y - mean y||^2"

#: Hold of the input, in words.
HOLDS: dict[Hold, str] = {
    "zoh": "constant between samples",
    "foh": "straight lines between samples",
    "band-limited": "without power above the Nyquist frequency",
}
#: Treatment of the initial state and the offset, in words.
TREATMENTS = {
    "rest": "at rest before the record",
    "estimate": "estimated with the model",
    "periodic": "steady state of an input that repeats the record",
    "drift": "constant and slope estimated with the model",
    "none": "none",
    "remove": "means of input and output subtracted",
}
#: Derived quantities that are greater than zero.
POSITIVE = re.compile("time_constant|natural_frequency")
#: Significant digits of the coefficients in the equation.
DIGITS = 5
#: Effect of a loss on the listed samples, and its name.
LITTLE = {"huber": "less than half their weight", "tukey": "no weight"}
LOSSES = {"huber": "Huber's", "tukey": "Tukey's biweight"}


@dataclass(frozen=True, eq=False)
class FitResult(PagedResult):
    """A fit with its records."""

    fitted: Identification
    records: Records
    #: Additional horizons at which predictions are assessed [samples].
    ahead: int | None = None

    @classmethod
    def of(cls, fitted: Identification) -> FitResult:
        """Return the result of a fit from Python, whose records are in memory."""
        other = None if fitted.validation is None else Measurement.of(fitted.validation.record)
        return cls(fitted, Records([Measurement.of(record) for record in fitted.records], other))

    @property
    def fine(self) -> str:
        """Sentence if there are no warnings."""
        fit = self.fitted.fit
        if isinstance(fit, MultiInputFit) or fit.noise is not None:
            return "The search ended well, and the residuals pass their tests; changes of the model were not tried."
        return "The search ended well, the residuals pass their tests, and no change that was tried gives a better fit."

    @property
    def units(self) -> Units:
        """Units of the records."""
        return self.records.units

    @property
    def figures(self) -> FitFigures:
        """Figure of the fit and its parts."""
        return FitFigures(self.fitted, self.records.measurements, self.units)

    def sections(self) -> list[Section]:
        """Return records, settings, parameters, derived quantities, diagnostics and warnings."""
        return [
            _titled_list("Chosen:", self.fitted.choices),
            self.data(),
            Section(table=Table.of_pairs(self.settings())),
            self.parameters(),
            self.derived(),
            Section(table=Table.of_pairs(self.quality()), drawing=self.drawing()),
            _titled_list("Warnings:", self.fitted.warnings),
        ]

    def main_table(self) -> Table:
        """Return a row for each parameter: estimate, standard error, interval, unit and status."""
        return Table.of_rows(parameter_rows(parameters_of(self.fitted, self.units)), is_named=True)

    def drawing(self) -> Drawing:
        """Return the figure of output, residuals, their correlation, and the cost over the delay."""
        several = isinstance(self.fitted.fit, MultiInputFit)
        return inputs_drawing(self.figures) if several else self.figures.all()

    def page_head(self) -> tuple[str, str]:
        """Return the title of the page, and the quality of the simulation."""
        fit, validation = self.fitted.fit, self.fitted.validation
        structure = "; ".join(f"{name}: {spelled(own)}" if name else spelled(own) for name, own in self._structures())
        lead = f"{structure}{self.lost_poles}. Fit {number(fit.fit_percent, 4)} % on {count(fit.count, 'sample')}"
        if validation is not None:
            common = self.fitted.seen_in_validation
            shared = f" ({count(common, 'sample')} of it also used for the estimation)" if common else ""
            lead += (
                f"; {number(validation.fit_percent, 4)} % on the validation record {_shown(validation.name)}{shared}"
            )
        return f"Fit of {', '.join(_shown(record.name) for record in self.records.data)}", f"{lead}. {fit.status.value}"

    def chapters(self) -> Iterator[Chapter]:
        """Return data, model and figures."""
        yield from self.chapters_of_numbers()
        yield from figure_chapters(self.figures, self.drawing(), self.records.validation)

    def chapters_of_numbers(self) -> Iterator[Chapter]:
        """Return data and model."""
        equations, additive = [], additive_of(self.fitted.fit)
        for name, model in zip(models_of(self.fitted), fractions_of(self.fitted.fit.model), strict=True):
            parts = [(model, 0)] if additive is None else [(part, part.integrators) for part in additive.submodels]
            terms = [(part.numerator.tolist(), part.denominator.tolist(), poles) for part, poles in parts]
            equation = formula(terms, delayed=model.delay > 0, digits=DIGITS)
            equations.append(f"Response to {name}: {equation}" if name else equation)
        quality = Section("Quality of the fit", table=Table.of_pairs(self.quality()))
        yield Chapter("Data", [self.data(), Section(table=Table.of_pairs(self.settings()))])
        yield Chapter("Model", [Section(sentences=equations), self.parameters(), self.derived(), quality])

    def cited(self) -> list[str]:
        """Return the articles on the methods of the fit, and on the frequency response shown with it."""
        fitted = self.fitted
        keys = ["gonzalez2025" if fitted.options.kind == "additive_srivc" else "kaufman1975"]
        keys += ["huber2009"] if fitted.fit.weighting is not None else []
        keys += ["harvey1979", "hausman1978"] if fitted.fit.noise is not None else []
        keys += ["patterson1971"] if fitted.uncertainty.kind in ("robust", "bootstrap") else []
        return [*keys, "pintelon2012"]

    # --- sections ----------------------------------------------------------------------------------

    def data(self) -> Section:
        """Return the records, and notes from reading them."""
        lines: list[str] = []
        for measurement, use in zip(self.records.measurements, self.fitted.fit.used, strict=True):
            lines += [_record_line(measurement, int(np.count_nonzero(use)), self.units), *measurement.notes]
        return Section(sentences=lines)

    def parameters(self) -> Section:
        """Return the parameters with their uncertainty."""
        notes = [*self.fitted.marks(self.units.time), f"{self.fitted.errors_sentence} {form_of(self.fitted.fit)}"]
        return Section(table=Table.of(parameters_of(self.fitted, self.units), PARAMETER), notes=notes)

    def derived(self) -> Section:
        """Return derived quantities as a table, and why some have no error."""
        rows = derived_of(self.fitted, self.units)
        notes = list(dict.fromkeys(row.reason for row in rows if row.reason and not row.is_undetermined))
        below = [row.name for row in rows if POSITIVE.search(row.name) and row.low < 0.0]
        if below:
            notes.append(
                f"The linearised intervals of {listed(below)} contain negative values: the errors are too large."
            )
        return Section(table=Table.of(rows, DERIVED), notes=notes)

    def settings(self) -> Iterator[tuple[str, str]]:
        """Yield the estimator, and the treatment of the records."""
        fit, options, units, first = self.fitted.fit, self.fitted.options, self.units, self.records.measurements[0]
        yield from self.structure()
        yield from _loop(options, first)
        if isinstance(fit, SubmodelsFit):
            yield "start", fit.start_method
        yield "initial state", f"{TREATMENTS[options.initial_state]}{_before(self.fitted)}"
        yield "offset", f"{_offset(self.fitted, units)} (--offset {options.offset})"
        record = first.record
        for text, signal in zip(record.hold_options, record.held.values(), strict=False):
            of, _, _ = text.rpartition("=")
            label = f"input {of}" if of else "inputs" if record.several else "input"
            yield label, f"{HOLDS[signal.hold]} (--hold {text})"
        if fit.weighting is not None:
            yield "loss", _loss_text(fit, fit.weighting, self.records.data, units)

    def _structures(self) -> list[tuple[str, Options]]:
        """Return the specified structure of each of several inputs by name; for one input without a name."""
        fit, options = self.fitted.fit, self.fitted.options
        if isinstance(fit, MultiInputFit) and isinstance(options, DelayProfile):
            names = list(fit.model.parts)
            return list(zip(names, options._each(names), strict=True))
        return [("", options)]

    @property
    def lost_poles(self) -> str:
        """Sentence on the poles that the model has fewer than specified."""
        lost = self.fitted.fit.poles_at_infinity
        return f" ({lost} of the poles at infinity, not shown)" if lost else ""

    def structure(self) -> Iterator[tuple[str, str]]:
        """Yield the structure of the model, and its known parameters."""
        options = self.fitted.options
        if isinstance(self.fitted.fit, MultiInputFit) and isinstance(options, DelayProfile):
            yield "model", "common denominator" if options.common else "a denominator for each input"
        for name, own in self._structures():
            structure = f"{spelled(own)}{self.lost_poles}"
            yield f"input {name}" if name else "model", f"{structure}; delay {_searched(own, self.units)}"
        if options.fixed:
            yield "known", ", ".join(f"{one.name} = {one.value:.6g}" for one in options.fixed) + " (--fix)"

    def quality(self) -> Iterator[tuple[str, str]]:
        """Yield measures of the quality of the fit."""
        fit, criteria, validation, units = self.fitted.fit, self.fitted.criteria, self.fitted.validation, self.units
        yield "fit", f"{number(fit.fit_percent, 5)} % = {FIT_DEFINITION}"
        yield "R2", f"{number(fit.r2, 6)} = {R2_DEFINITION}"
        how = "predicted one sample ahead" if isinstance(fit, LoopFit) and fit.in_ignored_loop else "simulated"
        yield "", f"y measured, x {how}, over the samples used"
        if fit.noise is not None:
            yield from self._noise(fit.noise)
        if validation is not None:
            text = (
                f"fit {number(validation.fit_percent, 5)} %, R2 {number(validation.r2, 6)} on {_shown(validation.name)}"
            )
            yield "validation", f"{text}, {count(validation.count, 'sample')}; with its own initial state and offset"
            for k in self.predicted:
                assert fit.noise is not None
                yield "", _prediction(k, validation.prediction_fit(fit.noise, k))
        what = "mean squared output error" if fit.weighting is None else "twice the mean loss"
        yield "cost", f"{units.amount(number(fit.cost), units.square)}, {what}"
        per = "cost" if fit.noise is None else "var e"
        yield "AIC", f"{number(criteria.aic)} = N ln {per} + 2 p"
        yield "BIC", f"{number(criteria.bic)} = N ln {per} + p ln N"
        yield "", f"N = {criteria.count} samples, p = {criteria.parameters} parameters"
        if isinstance(fit, SubmodelsFit):
            yield from fit.conditions
        yield from self.search()
        inputs = len(fractions_of(fit.model))
        for k, test in enumerate(self.fitted.tests):
            number_of = f" {k // inputs + 1}" * (len(fit.residuals) > 1)
            tested = _tested(test) if k % inputs == 0 else _cross_tested(test)
            yield f"{fit.left_over}{number_of}" if k % inputs == 0 else "", tested

    def search(self) -> Iterator[tuple[str, str]]:
        """Yield the outcome of the search, and the bounds of the admissible models that it met."""
        fit, units = self.fitted.fit, self.units
        if fit.status is not Status.CONVERGED:
            yield "status", fit.status.value
        if fit.starts is not None:
            tried, agree = fit.starts
            yield "search", f"best of {count(tried, 'start')}" + f", reached from {agree} of them" * (tried > 1)
        for name, end in fit.bounds_met:
            yield "at bound", f"{name} = {end:g}, as given"
        at_box = fit.held_poles or (fit.status in (Status.AT_BOUND, Status.RIDGE) and not fit.bounds_met)
        if fit.box is not None and at_box:
            yield "admissible", fit.box.sentence(units.time)
            for name, limit, value in fit.box.limits_met(fit.held_poles):
                unit = "" if name == "least_damping" else f" rad/{units.time}"
                yield "at bound", f"{limit.what}, {value:.4g}{unit}: {limit.meaning}"

    @property
    def predicted(self) -> list[int]:
        """Horizons of assessed predictions [samples]; empty without a noise model."""
        return [] if self.fitted.fit.noise is None else list(dict.fromkeys([1, self.ahead or 1]))

    def _noise(self, estimate: NoiseEstimate) -> Iterator[tuple[str, str]]:
        """Yield the noise model, the quality of its predictions, and the output-error fit."""
        fit, units, (p, q) = self.fitted.fit, self.units, estimate.orders
        chosen = ", orders of least BIC" * estimate.chosen
        variance = units.amount(number(estimate.noise.innovation_variance or 0.0), units.square)
        yield "noise", f"ARMA({p},{q}){chosen}: {estimate.formula}; variance of e {variance}"
        for k in self.predicted:
            yield "", _prediction(k, fit.prediction_fit(k))
        yield "output error", f"fit {number(estimate.output_error_fit, 5)} % without the noise model"
        if estimate.test.freedom:
            yield "", f"its difference from this fit: {probability(estimate.test.p_value)} by Hausman's test"

    def file_text(self, folder: Path, command: str | None = None) -> str:
        """Return the text of ``fit.json`` in a folder; paths of records are relative to it."""
        measurements, validation = self.records.measurements, self.records.validation
        return fit_text(self.fitted, self.content(), measurements, validation, folder, command)

    def content(self) -> dict[str, Any]:
        """Return the fit for ``fit.json`` and ``ctid fit --json``."""
        return fit_content(self.fitted, self.records, self.predicted)


def _titled_list(title: str, texts: Sequence[str]) -> Section:
    """Return a list under a title, or nothing if it is empty."""
    return Section(title, [f"- {text}" for text in texts]) if texts else Section()


def _shown(name: str) -> str:
    """Return the name of a record without its folder."""
    return shown(name) or "a record"


def _prediction(k: int, fit_percent: float) -> str:
    return f"fit {number(fit_percent, 5)} % of predictions {count(k, 'sample')} ahead"


def _searched(options: Options, units: Units) -> str:
    """Return the range of the delay, or its known value."""
    low, high = options.delay_bounds
    return f"searched from {low:g} to {high:g} {units.time}" if low < high else f"known, {low:g} {units.time}"


def _loop(options: Options, measurement: Measurement) -> Iterator[tuple[str, str]]:
    """Yield the loop of a record, and which part of it the estimator uses."""
    loop, instruments = measurement.record.loop, getattr(options, "instruments", "open_loop")
    if instruments == "reference":
        yield "loop", f"unknown controller; instruments from the reference r = {measurement.reference}"
    elif isinstance(options, LoopOutputError) and (loop is None or loop.controller is None):
        yield "loop", "unknown controller, replaced by one that stabilises the model; innovations"
    elif instruments == "closed_loop" and loop is not None and loop.controller is not None:
        simulated = isinstance(options, LoopOutputError)
        how = "output error of the simulated loop, y - T r" if simulated else "instruments from the noise-free loop"
        yield "loop", f"{_control_law(loop)}; r = {measurement.reference}; {how}"


def _control_law(loop: Loop) -> str:
    """Return the input from reference r and output y."""
    sides = (getattr(loop.controller, name) for name in ("numerator", "denominator"))
    b, a = (" ".join(f"{c:.6g}" for c in np.asarray(side)) for side in sides)
    p = "s" if loop.continuous else "q"
    where = f"u = C({p}) (r - y)" if loop.enters == "controller" else f"u = r - C({p}) y"
    return f"{where}, C = ({b})/({a}) in descending powers of {p}"


def _record_line(measurement: Measurement, used: int, units: Units) -> str:
    """Return one record: its samples, those that are missing or not used, clock and columns."""
    record = measurement.record
    missing = record.n_samples - int(np.count_nonzero(record.valid))
    less = [f"{used} used"] * (used < record.n_samples) + [f"{missing} missing"] * (missing > 0)
    part = f" ({', '.join(less)})" if less else ""
    clock = "regular clock" if record.interval is not None else "irregular clock"
    span = f"{part} from {record.t[0]:.6g} to {record.t[-1]:.6g} {units.time}, {clock}"
    columns = f"input{'s' * record.several} {units.column(measurement, 'input')}, "
    columns += f"output {units.column(measurement, 'output')}"
    return f"{shown(record.name) or 'record'}: {count(record.n_samples, 'sample')}{span}; {columns}"


def _before(result: Identification) -> str:
    """Return the input before the record, if it is not zero, and its options and those of the state."""
    before, state = getattr(result.options, "input_before", None), f"--initial-state {result.options.initial_state}"
    if before is None:
        return f" ({state})"
    levels = _levels_before(result)
    typed = before if before == "first" else f"{before:g}"
    return f", with the input at {levels} ({state} --input-before {typed})"


def _levels_before(result: Identification) -> str:
    return ", ".join(f"{level:.6g}" for level in result.fit.input_offsets)


def _offset(result: Identification, units: Units) -> str:
    fit, options = result.fit, result.options
    if options.offset != "remove":
        from_rest = options.offset == "estimate" and getattr(options, "input_before", None) is not None
        told = f"; it is the output at rest with the input at {_levels_before(result)}" * from_rest
        return f"{TREATMENTS[options.offset]}{told}"
    count_of = len(fit.input_offsets) // len(fit.offsets)
    each = [fit.input_offsets[k : k + count_of] for k in range(0, len(fit.input_offsets), count_of)]
    means = []
    for levels, level in zip(each, fit.offsets, strict=True):
        of_inputs = [units.amount(f"{u:.6g}", units.of_input(k).input) for k, u in enumerate(levels)]
        means.append(", ".join([*of_inputs, units.amount(f"{level:.6g}", units.output)]))
    return f"{TREATMENTS['remove']}: {'; '.join(means)}"


def form_of(fit: MeasuredFit) -> str:
    """Return how coefficients are scaled and numbered."""
    if additive_of(fit) is not None:
        return "g1_a2 multiplies p^2 in the denominator of the first submodel, whose constant term is 1."
    return "Monic denominator, descending powers."


def _loss_text(fit: MeasuredFit, weighting: Weighting, records: Sequence[Record], units: Units) -> str:
    """Return the scale of a loss other than squares, and the samples with a small weight."""
    kind, times = weighting.kind, weighting.outlier_times(records, fit.used)
    scales = ", ".join(number(loss.scale, 3) for loss in weighting.losses)
    deviation = units.amount(scales, units.output)
    text = f"{LOSSES[kind]} (--loss {kind}), standard deviation {deviation} from the median absolute error"
    total = sum(each.size for each in times)
    samples = f"{total} of {count(fit.count, 'sample')} {'has' if total == 1 else 'have'} {LITTLE[kind]}"
    if total:
        samples += f"; fit {number(weighting.fit_percent(records, fit.used, fit.residuals), 5)} % without them"
    return f"{text}; {samples}"


def _tested(test: ResidualTests) -> str:
    """Return the outcome of the tests of residuals; the warnings suggest remedies."""
    white = "white" if test.white else "not white"
    return f"{white} ({probability(test.whiteness_p_value)}), {_cross_tested(test)}"


def _cross_tested(test: ResidualTests) -> str:
    free = f"{'independent of' if test.uncorrelated else 'dependent on'} the {test.driver}"
    return f"{free} ({probability(test.cross_p_value)})"


def save_fit(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write a fit to a file that :func:`~ctid_cli.storage.fit_file.load_fit` and ``ctid report`` read.

    Parameters
    ----------
    result : Identification
        The fit.
    path : path
        The file, such as ``fit.json``. It contains the samples of records in memory, which have no file.

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    text = result._result().file_text(Path(path).parent)
    try:
        write_file(Path(path), text.encode() + b"\n")
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror or error}") from error
