"""Figures of the study: 1 to 4 of the paper, with errors and with more estimators.

Signals and tuning are those of Vediakova, Vedyakov, Pyrkin, Bobtsov and Gromov, "Frequency estimation of
multi-sinusoidal signals in finite-time" (2020). Two of its four estimators are not available in print: their
replacements are derived, as every figure states.
"""

from collections.abc import Mapping

import numpy as np

from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import data_folder
from ctid_cli.running.job import DataCell, EstimatorCell
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.specification.load import spec_from_canonical

from .error_plot import Curve, Row, errors_svg

#: Labels of replaced estimators of the paper.
DERIVED = "derived, not the published algorithm"
#: Columns of every figure: common property of the estimators, and their labels by name in the specification.
GROUPS: Mapping[str, Mapping[str, str]] = {
    "the paper's estimators": {"finite_time": "finite time", "gradient": "gradient"},
    "finite time after every change": {
        "window": "finite time, sliding window",
        "restarting": "restarting least squares",
        "restarting_prefiltered": "the same with a prefilter",
    },
    DERIVED: {"observer": "adaptive observer", "filter": "filter regression", "filter_gradient": "the same, gradient"},
}
#: Interval between the rows of drawn tracks [s], finer than the width of a line.
DRAWN_INTERVAL = 0.1


def figure_1(results: Results) -> bytes:
    """Two tones without noise."""
    title = r"Section VI-A: $\sin 2t + \cos 3t$, no noise"
    return errors_svg([_row(results)], (1.0, 5.5), (1e-17, 20.0), title)


def figure_2(results: Results) -> bytes:
    """Two tones and a third one that the estimators do not know of."""
    title = r"Section VI-B: $\sin 2t + \sin 3t$ disturbed by $0.25 \sin 15t$"
    return errors_svg([_row(results, reference=True)], (0.5, 5.5), (5e-8, 20.0), title)


def figure_3(results: Results) -> bytes:
    """Two tones in random noise."""
    title = r"Section VI-B: $\sin 2t + \sin 3t$, noise uniform in $\pm 0.2$, first data set"
    return errors_svg([_row(results, reference=True)], (0.5, 5.5), (2e-6, 20.0), title)


def figure_4(results: Results) -> bytes:
    """A step of both frequencies, with the phase as printed, and with one that goes on."""
    readings = {"jump": "phase jumps", "continuous": "phase goes on"}
    rows = [_row(results, title, phase_at_steps=reading) for reading, title in readings.items()]
    title = r"Section VI-C: both frequencies step at 30 s, no noise"
    return errors_svg(rows, (1.4, 4.2), (1e-17, 20.0), title)


def plan_of(results: Results) -> Plan:
    """Return the plan of stored results; paths of kinds are relative to the folder of the specifications."""
    folder = data_folder("configs") / "finite_time_frequency"
    return build_plan(spec_from_canonical(dict(results.settings), folder))


def _row(results: Results, title: str = "", *, reference: bool = False, **swept: str) -> Row:
    """Return the tracks of the first data set, with the truth."""
    plan = plan_of(results)
    cell = next(cell for cell in plan.data_cells if cell.swept.items() >= swept.items())
    parts, source = {part.name: part for part in plan.estimators}, cell.source
    groups: dict[str, list[Curve]] = {}
    for group, labels in GROUPS.items():
        tracks = {name: track_of(cell, 0, parts[name], DRAWN_INTERVAL) for name in labels if name in parts}
        groups[group] = [
            Curve(labels[name], track, source.signal.frequencies_at(track.t)) for name, track in tracks.items()
        ]
    options = parts["finite_time"].estimator.options
    exact_from = options.tones * (2 * options.h + options.d)
    whole = _whole_record_error(results) if reference else None
    return Row(title, groups, source.sampling.samples * source.sampling.interval, exact_from, whole)


def track_of(cell: DataCell, replicate: int, part: EstimatorCell, interval: float) -> FrequencyTrack:
    """Return the track of an estimator on a data set, with rows at an interval [s]."""
    record = cell.dataset(replicate).record
    track = part.estimator.prepare(record).fit().track
    every = max(1, round(interval / record.interval))
    return FrequencyTrack(track.t[::every], track.frequencies[::every], track.flags[::every])


def _whole_record_error(results: Results) -> float:
    """Return the RMS error of nonlinear least squares over all data sets, of the worse tone [rad/s]."""
    stored = results.stored
    measures = dict(zip(stored.export.parts("measures"), stored.column("measures").T, strict=True))
    own = stored.column("estimator") == b"nonlinear_least_squares"
    return max(float(np.sqrt(np.mean(measures[name][own] ** 2))) for name in ("rms_1", "rms_2"))
