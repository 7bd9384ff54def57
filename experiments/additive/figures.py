"""Figures of the study: 2, 3, 4 and 6 of the paper.

Numbers are those of González, Classens, Rojas, Welsh and Oomen, "Identification of Additive Continuous-time Systems in
Open and Closed-loop" (arXiv:2401.01263). Figures 2 and 6 are computed from the specifications; the others show results.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.reporting.figures.style import DARK, LIGHT, MARK, MIDDLE, Drawing, legend_of, panels_of, ramp
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import find_study
from ctid_cli.signals.record import Record

from .measures import errors_of, parameters

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Styles of up to four estimators, which differ in colour, marker and line.
LOOKS: tuple[dict[str, Any], ...] = (
    {"color": DARK, "marker": "o", "markerfacecolor": DARK, "linestyle": "-"},
    {"color": MARK, "marker": "s", "markerfacecolor": "none", "linestyle": "--"},
    {"color": MIDDLE, "marker": "^", "markerfacecolor": "none", "linestyle": "-."},
    {"color": "#3a7d34", "marker": "x", "linestyle": ":"},
)
#: Estimators of each experiment and their labels: open loop, and closed loop.
OPEN_LOOP = {"additive": "sum of four submodels", "srivc": "SRIVC, 8 poles and 6 zeros, factored"}
CLOSED_LOOP = {
    "additive": "sum of two submodels, closed loop",
    "clsrivc": "CLSRIVC, factored",
    "srivc": "SRIVC (direct), factored",
}


def figure_2() -> bytes:
    """Frequency response of the eighth-order system."""
    model = find_study("additive").plan("open-loop").data_cells[0].source.system
    frequencies = np.geomspace(0.1, 50.0, 1200)
    submodels = []
    for k, (submodel, line) in enumerate(zip(model.submodels, ramp(len(model.submodels)), strict=True), 1):
        style = line | {"linewidth": 0.9}
        response = submodel.frequency_response(frequencies)
        submodels.append(Response(f"submodel {k}", frequencies, response, style, phase=False))
    whole = Response("system", frequencies, model.frequency_response(frequencies), {"color": MARK, "linewidth": 1.5})
    title = "Section 6.1: the eighth-order system and its four submodels"
    return response_svg([*submodels, whole], title, unit="rad/s")


def figure_3(results: Results) -> bytes:
    """Mean-square errors of the static gains in open loop."""
    gains = [f"g{k}_b0" for k in range(1, 5)]
    title = "Section 6.1, open loop, coloured noise: mean-square errors of the static gains"
    return mse_svg(errors_of(results), OPEN_LOOP, gains, 2, title)


def figure_4(results: Results) -> bytes:
    """Mean-square errors of all parameters in closed loop."""
    title = "Section 6.2, closed loop, white noise: mean-square errors of the parameters"
    return mse_svg(errors_of(results), CLOSED_LOOP, parameters(results), 3, title)


def figure_6() -> bytes:
    """Frequency response of a simulated beam: true, estimated, and where the estimation started."""
    plan = find_study("additive").plan("flexible-beam")
    cell = plan.data_cells[0]
    true, data = cell.source.system, cell.dataset(0)
    start = plan.starts[0].draw(cell.content["seed"], 0, true)
    fit = plan.estimators[0].estimator.fit(data.record, start)
    lowest, highest = np.pi, 1000 * np.pi
    tones, measured = empirical_response(data.record, lowest, highest)
    begun = AdditiveModel(start.model.submodels, fit.additive.delay)
    points = {"color": LIGHT, "marker": ".", "markersize": 2.5, "linestyle": "none"}
    curves = [Response("non-parametric estimate, every 0.5 Hz", tones / (2 * np.pi), measured, points)]
    for label, model, style in (
        ("start of the iterations", begun, {"color": MIDDLE, "linestyle": "--", "linewidth": 0.9}),
        ("true simulated system", true, {"color": DARK, "linewidth": 2.4, "alpha": 0.5}),
        ("estimate", fit.additive, {"color": MARK, "linewidth": 0.9}),
    ):
        frequencies = dense_frequencies(model, lowest, highest)
        curves.append(Response(label, frequencies / (2 * np.pi), model.frequency_response(frequencies), style))
    title = "SIMULATED stand-in for the flexible beam of section 7, no measured data: 2 s from rest, 4096 Hz,\n"
    title += f"noise 100 dB below the output, a delay of 4 samples; {fit.iterations} iterations, {fit.status.name}"
    return response_svg(curves, title, unit="Hz", unwrap=False)


def empirical_response(record: Record, lowest: float, highest: float) -> tuple[Array, ComplexArray]:
    r"""Return the frequency response as the quotient of windowed spectra, without a model.

    The record is not periodic, and begins at rest: the Hann window removes the effect of its ends. The spectrum of the
    held input is that of its samples times ``(1 - exp(-jwh))/(jwh)``.
    """
    h = record.interval
    window = np.hanning(record.t.size)
    whole = np.asarray(2 * np.pi * np.fft.rfftfreq(record.t.size, h), dtype=float)
    inside = (whole > lowest * (1 - 1e-9)) & (whole < highest * (1 + 1e-9))
    frequencies = whole[inside]
    outputs, inputs = (np.fft.rfft(window * signal)[inside] for signal in (record.y, record.input.at(record.t)))
    hold = (1 - np.exp(-1j * frequencies * h)) / (1j * frequencies * h)
    return frequencies, np.asarray(outputs / (inputs * hold))


# --- responses ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Response:
    """One curve."""

    label: str
    #: Frequencies, in the unit of the figure, increasing, shape (K,).
    frequencies: Array
    #: Response [output unit/input unit], shape (K,).
    values: ComplexArray
    style: Mapping[str, Any] = field(default_factory=dict)
    phase: bool = True


def response_svg(curves: Sequence[Response], title: str, unit: str, *, unwrap: bool = True) -> bytes:
    """Draw magnitude and phase of frequency responses."""

    def draw(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1])
        for curve in curves:
            above.semilogx(curve.frequencies, 20 * np.log10(np.abs(curve.values)), label=curve.label, **curve.style)
            if curve.phase:
                below.semilogx(curve.frequencies, _phase(curve.values, unwrap), **curve.style)
        above.set_ylabel("magnitude [dB]")
        below.set_ylabel("phase [°]")
        below.set_xlabel(rf"frequency $\omega$ [{unit}]" if unit == "rad/s" else f"frequency [{unit}]")
        if not unwrap:
            below.set_ylim(-190, 190)
            below.set_yticks([-180, -90, 0, 90, 180])
        above.margins(x=0.0)
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        figure.suptitle(title)

    return Drawing(7.5, 5.2, draw).saved()


def _phase(values: ComplexArray, unwrap: bool) -> Array:
    """Return the phase in degrees; the curve is interrupted where it jumps from one end of the range to the other."""
    angle = np.angle(values)
    if unwrap:
        return np.asarray(np.rad2deg(np.unwrap(angle)))
    angle[:-1][np.abs(np.diff(angle)) > np.pi] = np.nan
    return np.asarray(np.rad2deg(angle))


def dense_frequencies(model: AdditiveModel, lowest: float, highest: float) -> Array:
    """Return frequencies that resolve every resonance of a model, however narrow."""
    distances = np.geomspace(1e-6, 0.1, 60)
    around = np.concatenate([1 - distances, [1.0], 1 + distances])
    near = [submodel.natural_frequency * around for submodel in model.submodels]
    every = np.concatenate([np.geomspace(lowest, highest, 600), *near])
    return np.unique(every[(every >= lowest) & (every <= highest)])


# --- mean-square errors ----------------------------------------------------------------------


def symbol(parameter: str) -> str:
    """Return a parameter of a submodel as a formula."""
    return re.sub(r"^g(\d+)_([ab])(\d+)$", r"$\2_{\1,\3}$", parameter)


def mse_svg(errors: pd.DataFrame, methods: Mapping[str, str], names: Sequence[str], columns: int, title: str) -> bytes:
    """Draw mean-square errors over the number of samples, one panel for each parameter."""
    lines = -(-len(names) // columns)

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import NullFormatter

        panels = panels_of(figure, len(names), columns, sharex=True)
        for k, (axes, parameter) in enumerate(zip(panels, names, strict=True)):
            for method, look in zip(methods, LOOKS, strict=False):
                own = errors[(errors["estimator"] == method) & (errors["parameter"] == parameter)]
                N, theory = own["samples"], own["theory"] / own["samples"]
                axes.plot(N, theory, color=look["color"], linestyle=look["linestyle"], linewidth=0.9)
                axes.plot(N, own["mse"], **look | {"linestyle": "none"}, markersize=3.2, markeredgewidth=0.8)
            axes.set(xscale="log", yscale="log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
            axes.set_title(symbol(parameter), loc="left")
            if k % columns == 0:
                axes.set_ylabel("mean-square error")
            if k // columns == lines - 1:
                axes.set_xlabel("number of samples $N$")
        labels = [labelled(label, errors[errors["estimator"] == method]) for method, label in methods.items()]
        wide = max(map(len, labels)) > 40 or len(labels) > 3
        note = "simulated (marker), theory for long records (line)"
        looks = dict(zip(labels, LOOKS, strict=False))
        legend_of(figure, looks, 2 if wide else 3, title=note, title_fontsize=8)
        runs = " to ".join(map(str, sorted({errors["runs"].min(), errors["runs"].max()})))
        several = " a point" if errors["samples"].nunique() > 1 else ""
        figure.suptitle(f"{title} ({runs} data sets{several})")

    return Drawing(7.5, 1.4 + 2.1 * lines, draw).saved()


def labelled(label: str, groups: pd.DataFrame) -> str:
    """Return the label of an estimator, with the number of its unsuccessful estimates."""
    # Every parameter of a group has the same counts.
    sums = groups.drop_duplicates("group")[["runs", "failed", "not_converged", "valueless"]].sum()
    unfinished = sums["failed"] + sums["not_converged"]
    notes = [f"{unfinished} of {sums['runs']} not converged"] if unfinished else []
    notes += [f"{sums['valueless']} without a value"] if sums["valueless"] else []
    return f"{label} ({', '.join(notes)})" if notes else label
