"""The result of ``ctid fit``: an estimated model with its uncertainty and diagnostics."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.arrays import Array
from ctid_cli.errors import StorageError
from ctid_cli.estimation.optimum.box import Box
from ctid_cli.estimators.delay_profile import DelayProfile, MeasuredFit, MultiInputFit
from ctid_cli.estimators.identification import Identification
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels, Options, SubmodelsFit
from ctid_cli.inference.fit import Status
from ctid_cli.inference.intervals import BIASED
from ctid_cli.inference.noise_estimate import NoiseEstimate
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.reporting.document import Result, Section, pairs
from ctid_cli.reporting.estimate import PARAMETER_FORMATS, Units, parameter_frame, parameter_object
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.fit_content import additive_of, derived_of, fit_content, parameters_of
from ctid_cli.reporting.fit_plot import identification_drawing
from ctid_cli.reporting.inputs_plot import inputs_drawing
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.records import Records
from ctid_cli.signals.band_limited import band_limited_doubt
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import Hold
from ctid_cli.storage.fit_file import fit_text
from ctid_cli.text import count
from ctid_cli.written_files import write_file

FIT_DEFINITION = "100 (1 - ||y - x|| / ||y - mean y||)"
R2_DEFINITION = "1 - ||y - x||^2 / ||y - mean y||^2"

#: The input between its samples.
HOLDS: dict[Hold, str] = {
    "zoh": "constant between its samples",
    "foh": "straight lines between its samples",
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
#: Instants of outliers that the text names.
MOST_NAMED = 5
#: What a loss does to the samples that are listed, and its name.
LITTLE = {"huber": "less than half their weight", "tukey": "no weight"}
LOSSES = {"huber": "Huber's", "tukey": "Tukey's biweight"}


@dataclass(frozen=True, eq=False)
class FitResult(Result):
    """A fit with the records that it was made from."""

    fitted: Identification
    records: Records
    #: How many samples ahead predictions are judged besides.
    ahead: int | None = None

    @classmethod
    def of(cls, fitted: Identification) -> FitResult:
        """Return the result of a fit that was made in Python, whose records are in memory."""
        other = None if fitted.validation is None else Measurement.of(fitted.validation.record)
        return cls(fitted, Records([Measurement.of(record) for record in fitted.records], other))

    @property
    def units(self) -> Units:
        """Units of the records."""
        return self.records.units

    def sections(self) -> list[Section]:
        """Return records, settings, parameters, derived quantities, diagnostics and warnings."""
        warnings = [f"- {warning}" for warning in self.fitted.warnings]
        return [
            *([Section("Chosen:", [f"- {choice}" for choice in self.fitted.choices])] if self.fitted.choices else []),
            self.data(),
            Section(frame=pairs(self.settings())),
            self.parameters(),
            self.derived(),
            Section(frame=pairs(self.quality()), drawing=self.drawing()),
            *([Section("Warnings:", warnings)] if warnings else []),
        ]

    def to_frame(self) -> pd.DataFrame:
        """Return a row for each parameter: estimate, standard error, interval, unit and status."""
        rows = [parameter_object(item) for item in parameters_of(self.fitted, self.units)]
        return pd.DataFrame(rows).set_index("name")

    def drawing(self) -> Drawing:
        """Return the figure of output, residuals, their correlation, and the search over the delay."""
        kind = inputs_drawing if isinstance(self.fitted.fit, MultiInputFit) else identification_drawing
        return kind(self.fitted, self.records.measurements, self.units)

    # --- sections ----------------------------------------------------------------------------------

    def data(self) -> Section:
        """Return the records, and what reading them has shown."""
        lines: list[str] = []
        for measurement, use in zip(self.records.measurements, self.fitted.fit.used, strict=True):
            lines += [_record_line(measurement, int(np.count_nonzero(use)), self.units), *measurement.notes]
        return Section(sentences=lines)

    def parameters(self) -> Section:
        """Return the parameters with their uncertainty."""
        frame = parameter_frame(parameters_of(self.fitted, self.units))
        return Section(frame=frame, formats=PARAMETER_FORMATS, notes=[_covariance_line(self.fitted)])

    def derived(self) -> Section:
        """Return derived quantities as a table, and why some have no error."""
        rows = derived_of(self.fitted, self.units)
        names = ("estimate", "standard_error", "low", "high", "unit")
        titles = ["derived", "estimate", "standard error", "95 % low", "95 % high", "unit"]
        frame = pd.DataFrame([(row.name, *(getattr(row, name) for name in names)) for row in rows], columns=titles)
        reasons = list(dict.fromkeys(row.reason for row in rows if row.reason))
        return Section(frame=frame, formats={"standard error": ".3g"}, notes=reasons)

    def settings(self) -> Iterator[tuple[str, str]]:
        """Return what was estimated, and how the records were taken."""
        fit, options, units, first = self.fitted.fit, self.fitted.options, self.units, self.records.measurements[0]
        hold = first.hold
        if isinstance(fit, MultiInputFit) and isinstance(options, DelayProfile):
            yield "model", "common denominator" if options.common else "a denominator for each input"
            for name, own in zip(fit.model.parts, options._each(list(fit.model.parts)), strict=True):
                yield f"input {name}", f"{_structure(own)}; delay {_searched(own, units)}"
        else:
            yield "model", f"{_structure(options)}; delay {_searched(options, units)}"
        if options.fixed:
            yield "known", ", ".join(f"{one.name} = {one.value:.6g}" for one in options.fixed) + " (--fix)"
        yield from _loop(options, first)
        if isinstance(fit, SubmodelsFit):
            yield "start", fit.start_method
        yield (
            "initial state",
            f"{TREATMENTS[options.initial_state]}{_before(self.fitted)} (--initial-state {options.initial_state})",
        )
        yield "offset", f"{_offset(self.fitted, units)} (--offset {options.offset})"
        yield "input", f"{HOLDS[hold]} (--hold {hold}){_unknown_ends(first, options, units)}"
        if fit.weighting is not None:
            yield "loss", _loss_text(fit, fit.weighting, self.records.data, units)

    def quality(self) -> Iterator[tuple[str, str]]:
        """Return what tells how good the fit is."""
        fit, criteria, validation, units = self.fitted.fit, self.fitted.criteria, self.fitted.validation, self.units
        yield "fit", f"{number(fit.fit_percent, 5)} % = {FIT_DEFINITION}"
        yield "R2", f"{number(fit.r2, 6)} = {R2_DEFINITION}"
        yield "", "y measured, x simulated, over the samples used"
        if fit.noise is not None:
            yield from _noise_lines(fit, fit.noise, self.ahead, units)
        if validation is not None:
            text = f"fit {number(validation.fit_percent, 5)} %, R2 {number(validation.r2, 6)} on {validation.name}, "
            text += f"{count(validation.count, 'sample')}; initial state and offset of its own"
            yield "validation", text
        what = "mean squared output error" if fit.weighting is None else "twice the mean loss"
        yield "cost", f"{number(fit.cost)} ({units.output})^2, {what}"
        per = "cost" if fit.noise is None else "var e"
        sizes = f"N = {criteria.count} samples and p = {criteria.parameters} parameters"
        yield "AIC", f"{number(criteria.aic)} = N ln {per} + 2 p with {sizes}"
        yield "AICc", f"{number(criteria.aicc)} = AIC + 2 (p + 1)(p + 2) / (N - p - 2)"
        yield "BIC", f"{number(criteria.bic)} = N ln {per} + p ln N"
        yield "FPE", f"{number(criteria.fpe)} ({units.output})^2 = {per} (N + p) / (N - p)"
        yield "YIC, R_T^2", f"{number(self.fitted.yic, 5)}, {number(self.fitted.r_t_squared, 6)}"
        yield "condition number", number(fit.condition_number, 3)
        if isinstance(fit, SubmodelsFit):
            yield from _conditions(fit)
        if fit.starts is not None:
            yield "search", f"the best of {count(fit.starts.tried, 'start')}, reached {count(fit.starts.agree, 'time')}"
        if fit.box is not None and (fit.held_poles or fit.status in (Status.AT_BOUND, Status.RIDGE)):
            yield "admissible", _box_text(fit.box, units)
            for name, limit, value in fit.box.limits_met(fit.held_poles):
                unit = "" if name == "least_damping" else f" rad/{units.time}"
                yield "at bound", f"{limit.what}, {value:.4g}{unit}: {limit.meaning}"
        names = list(fit.model.parts) if isinstance(fit, MultiInputFit) else [""]
        for k, test in enumerate(self.fitted.tests):
            what = "residuals" if fit.noise is None else "innovations"
            record, place = divmod(k, len(names))
            number_of = f" {record + 1}" * (len(fit.residuals) > 1)
            yield f"{what}{number_of}", _tested(test, f"input {names[place]}".strip())

    def file_text(self, folder: Path, command: str | None = None) -> str:
        """Return the text of ``fit.json`` in a folder, from which the records are named."""
        measurements, validation = self.records.measurements, self.records.validation
        return fit_text(self.fitted, self.content(), measurements, validation, folder, command)

    def content(self) -> dict[str, Any]:
        """Return the fit for ``fit.json`` and ``ctid fit --json``."""
        return fit_content(self.fitted, self.records, self.ahead)


def _noise_lines(
    fit: MeasuredFit, estimate: NoiseEstimate, ahead: int | None, units: Units
) -> Iterator[tuple[str, str]]:
    """Return the noise model, how well it predicts, and the output-error fit beside it."""
    noise, (p, q) = estimate.noise, estimate.orders
    errors = np.sqrt(np.diag(estimate.covariance))
    d, c = _polynomial(noise.denominator, errors[:p]), _polynomial(noise.numerator, errors[p:])
    chosen = ", orders of least BIC" * estimate.chosen
    variance = f"variance of e {number(noise.innovation_variance or 0.0)} ({units.output})^2"
    yield "noise", f"ARMA({p},{q}){chosen}: v = C/D e, D = {d}, C = {c}; {variance}"
    for k in dict.fromkeys((1, *([ahead] if ahead else []))):
        old = count(k, "sample")
        yield f"fit {k} ahead", f"{number(fit.prediction_fit(k), 5)} % of predictions from outputs at least {old} old"
    with np.errstate(invalid="ignore"):
        ratios = estimate.output_error_errors / np.sqrt(np.diag(fit.covariance))
    each = [
        f"{name} {number(ratio, 3)}"
        for name, ratio in zip(fit.parameter_names, ratios.tolist(), strict=True)
        if np.isfinite(ratio)
    ]
    text = f"fit {number(estimate.output_error_fit, 5)} %; its standard errors over those here: {', '.join(each)}"
    test = f"Hausman's test of the difference: p = {number(estimate.test.p_value, 2)}"
    yield "output error", f"{text}. {test if estimate.test.freedom else 'Nothing is gained that a test could use'}"


def _polynomial(coefficients: Sequence[float], errors: Array) -> str:
    """Return a polynomial in q^-1 with the standard errors of its coefficients."""
    each = zip(coefficients[1:], errors.tolist(), strict=True)
    terms = (f" {'-' if c < 0 else '+'} {abs(c):.4g}({e:.1g}) q^-{k}" for k, (c, e) in enumerate(each, start=1))
    return "1" + "".join(terms)


def _unknown_ends(measurement: Measurement, options: Options, units: Units) -> str:
    """What is not known of a band-limited input for want of the samples beyond the ends."""
    signal = next(iter(measurement.record.held.values()))
    if signal.hold != "band-limited" or options.initial_state == "periodic":
        return ""
    doubt = band_limited_doubt(signal.t, signal.values)
    known = f"within {doubt.reach:.3g} {units.time} of the ends known to about {doubt.ends:.2g} {units.input}"
    rough = f"; {100 * doubt.beyond:.2g} % of its power is too close to the Nyquist frequency" * (doubt.beyond > 0.01)
    return f", {known}{rough}"


def _searched(options: Options, units: Units) -> str:
    """Range of the delay, or its known value."""
    low, high = options.delay_bounds
    return f"searched from {low:g} to {high:g} {units.time}" if low < high else f"known, {low:g} {units.time}"


def _structure(options: Options) -> str:
    """Poles and zeros, of each submodel if there are several."""
    if not isinstance(options, MeasuredSubmodels) or not options.factored:
        integrators = getattr(options, "integrators", 0)
        besides = f" and {count(integrators, 'integrator')}" * (integrators > 0)
        return f"{count(options.poles, 'pole')}, {count(options.zeros, 'zero')}{besides}"
    parts = ", ".join(
        f"{term.poles}/{term.zeros}" + f" and {count(term.integrators, 'integrator')}" * (term.integrators > 0)
        for term in options.terms
    )
    what = f"sum of {len(options.terms)} submodels with" if len(options.terms) > 1 else "one submodel with"
    return f"{what} poles/zeros {parts}"


def _loop(options: Options, measurement: Measurement) -> Iterator[tuple[str, str]]:
    """The loop of a record, and what of it the estimate is made with."""
    loop, instruments = measurement.record.loop, getattr(options, "instruments", "open_loop")
    if instruments == "reference":
        yield "loop", f"controller not known; what of the input follows r = {measurement.reference} as instrument"
    elif instruments == "closed_loop" and loop is not None and loop.controller is not None:
        b, a = (
            " ".join(f"{c:.6g}" for c in np.asarray(side))
            for side in (loop.controller.numerator, loop.controller.denominator)
        )
        p = "s" if loop.continuous else "q"
        where = f"u = C({p}) (r - y)" if loop.enters == "controller" else f"u = r - C({p}) y"
        text = f"{where}, r = {measurement.reference}, C = ({b})/({a}) in descending powers of {p}"
        how = "instruments from the noise-free loop"
        if isinstance(options, LoopOutputError):
            how = "output error of the simulated loop, y - T r"
        yield "loop", f"{text}; {how}"


def _conditions(fit: SubmodelsFit) -> Iterator[tuple[str, str]]:
    """Conditions for consistent estimates (González et al. 2025), at a converged estimate."""
    if not fit.status.succeeded:
        return
    lines = (
        (f"condition ({37 if fit.in_loop else 36})", fit.consistency, "right side over left side, for consistency"),
        ("assumption 4", fit.sampling, "sampling frequency over twice the greatest imaginary part of a pole"),
    )
    for label, margin, text in lines:
        if not np.isnan(margin):
            yield label, f"{'holds' if margin > 1.0 else 'is violated'} with the margin {margin:.3g} = {text}"
    if not np.isnan(fit.two_stage):
        how = "input simulated from the reference, then a fit in open loop"
        yield "two-stage", f"parameters differ by at most {fit.two_stage:.2g} of its standard errors ({how})"


def _box_text(box: Box, units: Units) -> str:
    rate = f"rad/{units.time}"
    swing = f", imaginary parts up to {box.imaginary:.4g} {rate}" if np.isfinite(box.imaginary) else ""
    poles = f"poles from {box.slowest:.4g} to {box.fastest:.4g} {rate}{swing}"
    return f"{poles}; pairs with a damping of at least {box.least_damping:g}"


def _record_line(measurement: Measurement, used: int, units: Units) -> str:
    """One record: its samples, clock and columns."""
    record = measurement.record
    part = "" if used == record.n_samples else f" ({used} used)"
    clock = "regular clock" if record.interval is not None else "irregular clock"
    span = f"{part} from {record.t[0]:.6g} to {record.t[-1]:.6g} {units.time}, {clock}"
    labels = measurement.label("input", units.input), measurement.label("output", units.output)
    columns = f"input{'s' * record.several} {labels[0]}, output {labels[1]}"
    return f"{record.name}: {count(record.n_samples, 'sample')}{span}; {columns}"


def _before(result: Identification) -> str:
    """Return the input before the record, where it is not zero."""
    before = getattr(result.options, "input_before", None)
    levels = ", ".join(f"{level:.6g}" for level in result.fit.input_offsets)
    return "" if before is None else f", with the input at {levels} (--input-before {before})"


def _offset(result: Identification, units: Units) -> str:
    fit, options = result.fit, result.options
    if options.offset != "remove":
        return TREATMENTS[options.offset]
    count_of = len(fit.input_offsets) // len(fit.offsets)
    each = [fit.input_offsets[k : k + count_of] for k in range(0, len(fit.input_offsets), count_of)]
    means = "; ".join(
        ", ".join([*(f"{u:.6g} {units.of_input(k).input}" for k, u in enumerate(levels)), f"{y:.6g} {units.output}"])
        for levels, y in zip(each, fit.offsets, strict=True)
    )
    return f"{TREATMENTS['remove']}: {means}"


def _covariance_line(result: Identification) -> str:
    """What the standard errors hold for."""
    found, asked = result.uncertainty, all(test.white for test in result.tests)
    what = "residuals" if result.fit.noise is None else "innovations"
    text = f"Standard errors are those for white {what}"
    if not result.answer.seen:
        return f"There are no standard errors, as no answer to the input is seen. {_form(result.fit)}"
    if found.kind == "biased":
        return f"{BIASED} {_form(result.fit)}"
    if not np.isfinite(np.diag(found.covariance)).any():
        return f"There are no standard errors. {_form(result.fit)}"
    if found.kind != "white":
        text = f"Standard errors are those for coloured noise{f', because the {what} are not white' * (not asked)}"
    elif result.tests:
        text += f", as the {what} pass the test"
    if found.bootstrap is None:
        text += f"; intervals are estimate -+ {found.quantile(np.zeros(1)):.3g} of them"
        text += f" (t, {found.degrees_of_freedom:.4g} degrees of freedom)"
    else:
        draws = f"95 % of {len(found.bootstrap.errors)} estimates from simulated noise"
        text += f"; intervals are estimate -+ as many of them as {draws} keep within (bootstrap-t)"
    if result.delay_interval is not None:
        text += ", that of the delay from the profile of the cost, which is not quadratic there"
    return f"{text}. {_form(result.fit)}"


def _form(fit: MeasuredFit) -> str:
    """How coefficients are scaled and counted."""
    if additive_of(fit) is None:
        return "Monic denominator, descending powers."
    return "g1_a2 multiplies p^2 in the denominator of the first submodel, whose constant term is 1."


def _loss_text(fit: MeasuredFit, weighting: Weighting, records: Sequence[Record], units: Units) -> str:
    """Return the scale of a loss other than squares, and the samples that count for little."""
    kind, times = weighting.kind, weighting.outlier_times(records, fit.used)
    scales = ", ".join(number(loss.scale, 3) for loss in weighting.losses)
    text = f"{LOSSES[kind]} (--loss {kind}), standard deviation {scales} {units.output} from the median absolute error"
    total = sum(each.size for each in times)
    samples = f"{total} of {count(fit.count, 'sample')} {'has' if total == 1 else 'have'} {LITTLE[kind]}"
    if not total:
        return f"{text}; {samples}"
    listed = []
    for k, each in enumerate(times, start=1):
        where = f" of experiment {k}" if len(records) > 1 else ""
        some = ", ".join(f"{t:.6g}" for t in each[:MOST_NAMED]) + (", ..." if each.size > MOST_NAMED else "")
        listed += [f"{some} {units.time}{where}"] * (each.size > 0)
    without = number(weighting.fit_percent(records, fit.used, fit.residuals), 5)
    return f"{text}; {samples}, at {'; '.join(listed)}; fit {without} % without them"


def _tested(test: ResidualTests, input: str) -> str:
    """Return the outcome of the tests of residuals; the warnings say what to do."""
    white = "white" if test.white else "not white"
    free = f"independent of the {input}" if test.uncorrelated else f"dependent on the {input}"
    return f"{white} (p = {number(test.whiteness_p_value, 2)}), {free} (p = {number(test.cross_p_value, 2)})"


def save_fit(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write a fit to a file that :func:`~ctid_cli.storage.fit_file.load_fit` and ``ctid report`` read.

    Parameters
    ----------
    result : Identification
        The fit.
    path : path
        The file, such as ``fit.json``. Since records in memory have no file, their samples are in it.

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    text = FitResult.of(result).file_text(Path(path).parent)
    try:
        write_file(Path(path), text.encode() + b"\n")
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror or error}") from error
