"""Figures of the study: 2, 3, 4 and 6 of the paper.

Numbers are those of González, Classens, Rojas, Welsh and Oomen, "Identification of Additive Continuous-time Systems in
Open and Closed-loop" (arXiv:2401.01263). Figures 2 and 6 are computed from the specifications; the others show results.
"""

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.reporting.figures.style import DARK, LIGHT, MARK, MIDDLE, ramp
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import find_study
from ctid_cli.signals.record import Record

from .frequency_plot import Response, dense_frequencies, response_svg
from .measures import errors_of, parameters
from .parameter_plot import mse_svg

#: Estimators of each experiment, and what they are called: those in open loop, and in closed loop.
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
    r"""Frequency response as the quotient of windowed spectra, without a model.

    The system does not repeat itself within the record, least of all from rest: the Hann window takes the ends of the
    record out. The spectrum of the held input is that of its samples times ``(1 - exp(-jwh))/(jwh)``.
    """
    h = record.interval
    window = np.hanning(record.t.size)
    whole = np.asarray(2 * np.pi * np.fft.rfftfreq(record.t.size, h), dtype=float)
    inside = (whole > lowest * (1 - 1e-9)) & (whole < highest * (1 + 1e-9))
    frequencies = whole[inside]
    outputs, inputs = (np.fft.rfft(window * signal)[inside] for signal in (record.y, record.input.at(record.t)))
    hold = (1 - np.exp(-1j * frequencies * h)) / (1j * frequencies * h)
    return frequencies, np.asarray(outputs / (inputs * hold))
