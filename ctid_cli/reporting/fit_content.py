"""Numbers of a fit in the units of its records, and as plain data."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ctid_cli.canonical import plain
from ctid_cli.estimation.optimum.box import Box
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.identification import Identification, Validation
from ctid_cli.estimators.loop_output_error import LoopFit
from ctid_cli.estimators.measured_fit import MeasuredFit, MultiInputFit
from ctid_cli.estimators.measured_submodels import SubmodelsFit
from ctid_cli.inference.derived import GAIN_UNIT, modes_of
from ctid_cli.inference.intervals import BIASED, UncertainValue
from ctid_cli.inference.noise_estimate import NoiseEstimate
from ctid_cli.inference.units import Units
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.reporting.document import Column
from ctid_cli.reporting.estimate import parameter_rows, rows_of
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.records import Records
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Record

#: Reported fields of a derived quantity.
DERIVED = (
    Column("name", "derived"),
    Column("shown", "estimate"),
    Column("standard_error", "std error", ".3g"),
    Column("low", "95 % low"),
    Column("high", "95 % high"),
    Column("unit"),
)
FRACTION = ("numerator", "denominator", "delay")
DERIVED_KEYS = (*(column.key for column in DERIVED), "reason")
TEST_KEYS = ("white", "whiteness_p_value", "uncorrelated", "cross_p_value", "level", "lags", "sentence")


def fit_content(
    fitted: Identification, records: Records, predicted: Sequence[int] = (), units: Units | None = None
) -> dict[str, Any]:
    """Return the fit for ``fit.json`` and ``ctid fit --json``."""
    fit, options, criteria = fitted.fit, fitted.options, fitted.criteria
    profile, validation = fitted.profile, fitted.validation
    measurements, units = records.measurements, units or records.units
    hold = measurements[0].record.hold if measurements else None
    content = {
        "model": _model_object(fitted),
        "parameters": parameter_rows(parameters_of(fitted, units)),
        **picked(fit, ("fit_percent", "r2", "cost")),
        "loss": _loss_object(fit, records.data),
        "noise_model": fit.noise and _noise_object(fit, fit.noise, predicted),
        "status": fit.status.name,
        "message": fit.status.value,
        "starts": fit.starts and fit.starts._asdict(),
        "poles_at_infinity": fit.poles_at_infinity,
        "box": fit.box and _box_object(fit.box, fit.held_poles),
        "initial_state": {"treatment": options.initial_state, "values": fit.initial_states},
        "offset": {"treatment": options.offset, "output": fit.offsets, "input": fit.input_offsets},
        "modes": _modes(fit, units),
        "choices": fitted.choices,
        "warnings": fitted.warnings,
        "notes": [note for measurement in measurements for note in measurement.notes],
        "derived": [rows_of(row, DERIVED_KEYS) for row in derived_of(fitted, units)],
        "marks": fitted.marks(units.time),
        "equivalents": [asdict(each) for each in fit.equivalents],
        "answer": picked(fitted.answer, ("seen", "p_value", "explained", "by_chance")),
        "covariance": _covariance_object(fitted),
        "delay_interval": "profile likelihood" if fitted.delay_interval is not None else "quadratic",
        "criteria": {
            **picked(criteria, ("aic", "aicc", "bic", "fpe")),
            "yic": fitted.yic,
            "r_t_squared": fitted.r_t_squared,
            "samples": criteria.count,
            "parameters": criteria.parameters,
        },
        "condition_number": fit.condition_number,
        "conditions": picked(fit, ("consistency", "sampling", "two_stage")) if isinstance(fit, SubmodelsFit) else None,
        "iterations": fit.iterations,
        "residual_tests": [picked(test, TEST_KEYS) for test in fitted.tests],
        "profile": profile and {**profile._asdict(), "cutoff": None},
        "validation": validation and _validation_object(validation, records.validation, fit.noise, predicted),
        "records": [_record_object(item, use) for item, use in zip(measurements, fit.used, strict=False)],
        "units": asdict(units),
        "settings": asdict(options) | {"kind": options.kind, "hold": hold},
    }
    return dict(plain(content))


def _model_object(fitted: Identification) -> dict[str, Any]:
    """Return the model; for several inputs a transfer function for each."""
    fit, additive = fitted.fit, additive_of(fitted.fit)
    if isinstance(fit, MultiInputFit):
        parts = {name: picked(part, FRACTION) for name, part in fit.model.parts.items()}
        return {"inputs": parts, "common_denominator": fit.model.common}
    numerator = [item.estimate for item in fitted.estimates if item.name.startswith("b")]
    found = picked(fit.model, FRACTION) | ({"numerator": numerator} if numerator else {})
    return found if additive is None else {**found, "submodels": [asdict(part) for part in additive.submodels]}


def parameters_of(result: Identification, units: Units) -> list[UncertainValue]:
    """Return the parameters with the units of the records."""
    if isinstance(result.fit, MultiInputFit):
        return [replace(item, unit=_unit_of_input(item.name, result.fit, units)) for item in result.estimates]
    additive, poles, zeros = additive_of(result.fit), result.fit.model.order, result.options.zeros
    monic = isinstance(result.options, AdditiveOutputError)
    # The states of a loop are those of plant and controller, with different units.
    nameless = isinstance(result.fit, LoopFit)

    def unit(name: str) -> str:
        if additive is not None:
            return units.in_sum(name, additive, monic)
        return "" if nameless and name.startswith("x") else units.of(name, poles, zeros)

    return [replace(item, unit=unit(item.name)) for item in result.estimates]


def _unit_of_input(name: str, fit: MultiInputFit, units: Units) -> str:
    """Return the unit of a parameter of a model with several inputs."""
    for k, (own, model) in enumerate(fit.model.parts.items()):
        if name.startswith(f"{own}_"):
            bare = name.removeprefix(f"{own}_")
            zeros = sum(re.fullmatch(rf"{re.escape(own)}_b\d+", each) is not None for each in fit.parameter_names) - 1
            return units.of_input(k).of(bare, model.order, zeros)
    return units.of(name, fit.model.order, 0)


def additive_of(fit: MeasuredFit) -> AdditiveModel | None:
    """Return the submodels of a fit, None for a fit of one transfer function."""
    return fit.additive if isinstance(fit, SubmodelsFit) else None


def derived_of(result: Identification, units: Units) -> list[UncertainValue]:
    """Return derived quantities in the units of the records; names that end in Hz have values in Hz."""
    names = {"s": units.time, "rad/s": f"rad/{units.time}", GAIN_UNIT: units.gain}
    found = []
    for row in result.derived:
        if row.unit != "Hz":
            unit = names.get(row.unit, row.unit)
            if row.unit == GAIN_UNIT and isinstance(result.fit, MultiInputFit):
                place = list(result.fit.model.parts).index(row.name.removesuffix("_static_gain"))
                unit = units.of_input(place).gain
            found.append(replace(row, unit=unit))
        elif (seconds := units.seconds) is not None:
            scaled = {name: getattr(row, name) / seconds for name in ("estimate", "standard_error", "low", "high")}
            found.append(replace(row, **scaled))
    return found


def _covariance_object(result: Identification) -> dict[str, Any]:
    uncertainty, draws = result.uncertainty, result.uncertainty.bootstrap
    return {
        "kind": uncertainty.kind,
        "names": result.fit.parameter_names,
        "values": uncertainty.covariance,
        "effective_samples": uncertainty.effective_count,
        "degrees_of_freedom": uncertainty.degrees_of_freedom if uncertainty.kind in ("white", "robust") else None,
        "reason": BIASED if uncertainty.kind == "biased" else None,
        "bootstrap_draws": 0 if draws is None else len(draws.errors),
    }


def _box_object(box: Box, held: Iterable[complex]) -> dict[str, Any]:
    """Return the set of admissible models, null for no bound, and the bounds that poles met."""
    return {
        "poles": (box.slowest, box.fastest),
        "imaginary_part": box.imaginary if np.isfinite(box.imaginary) else None,
        "damping": box.least_damping,
        "delay": box.delays if box.several_delays else box.each_delay[0],
        "met": [
            {"limit": name, "what": limit.what, "value": value, "meaning": limit.meaning, "reason": limit.reason}
            for name, limit, value in box.limits_met(held)
        ],
    }


def _modes(fit: MeasuredFit, units: Units) -> list[dict[str, float | None]]:
    """Return natural frequency and damping of every real pole and every pair; an integrator has no damping."""
    seconds = units.seconds
    return [
        {"frequency_hz": None if seconds is None else frequency / seconds, "damping": damping}
        for frequency, damping in modes_of((additive_of(fit) or fit.model).poles)
    ]


def _validation_object(
    outcome: Validation, validation: Measurement | None, noise: NoiseEstimate | None, predicted: Sequence[int]
) -> dict[str, Any]:
    fits = None if noise is None else {str(k): outcome.prediction_fit(noise, k) for k in predicted}
    return {
        "file": outcome.name,
        **picked(outcome, ("fit_percent", "r2")),
        "samples": outcome.count,
        "prediction_fits": fits,
        "initial_state": outcome.applied.initial_states[0],
        "offset": outcome.applied.offsets[0],
        "notes": () if validation is None else validation.notes,
    }


def _record_object(measurement: Measurement, use: Any) -> dict[str, Any]:
    record = measurement.record
    return {
        "file": record.name,
        "samples": record.n_samples,
        "used": int(np.count_nonzero(use)),
        "start": float(record.t[0]),
        "stop": float(record.t[-1]),
        "regular": record.interval is not None,
        "columns": {"time": measurement.time, "input": measurement.columns, "output": measurement.output},
    }


def _noise_object(fit: MeasuredFit, estimate: NoiseEstimate, predicted: Sequence[int]) -> dict[str, Any]:
    """Return the noise model for JSON, with the output-error fit."""
    errors = estimate.output_error_errors
    return {
        **picked(estimate.noise, ("numerator", "denominator", "innovation_variance")),
        **picked(estimate, ("covariance", "deviance", "chosen")),
        "prediction_fits": {str(k): fit.prediction_fit(k) for k in predicted},
        "output_error": {
            "values": estimate.output_error,
            "standard_errors": errors,
            "fit_percent": estimate.output_error_fit,
        },
        "hausman": estimate.test._asdict(),
    }


def _loss_object(fit: MeasuredFit, records: Sequence[Record]) -> dict[str, Any]:
    """Return the loss for JSON."""
    if fit.weighting is None:
        return {"kind": "squares", "scales": None, "outliers": [[] for _ in records], "fit_percent": None}
    return {
        "kind": fit.weighting.kind,
        "scales": [loss.scale for loss in fit.weighting.losses],
        "outliers": fit.weighting.outlier_times(records, fit.used),
        "fit_percent": fit.weighting.fit_percent(records, fit.used, fit.residuals),
    }
