"""Results as text, as tables of pandas and as figures, whichever kind of result it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, get_args

import numpy as np

from ctid_cli.errors import UsageError
from ctid_cli.estimators.identification import Identification
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.reporting import identification_plot
from ctid_cli.reporting.estimate import Units, parameter_object, parameter_table
from ctid_cli.reporting.figures.style import Picture, require_kind
from ctid_cli.reporting.identification_report import derived_block, derived_of, parameters_of
from ctid_cli.reporting.layout import Report, Table, number
from ctid_cli.reporting.measures import parameter_unit
from ctid_cli.reporting.track_result import TrackResult, flag_names
from ctid_cli.signals.measurement import Measurement
from ctid_cli.text import warning_lines
from ctid_cli.tones.track import Track

if TYPE_CHECKING:
    import pandas as pd

    from ctid_cli.reporting.experiment import ExperimentResults

    Result: TypeAlias = Fit | Identification | FrequencyTrack | ExperimentResults


def summary(result: Result) -> str:
    """A result for people: parameters or tones with their uncertainty, or the table of an experiment.

    Parameters
    ----------
    result : Fit, Identification, FrequencyTrack or ExperimentResults
        What an estimator, :func:`~ctid_cli.estimators.identification.identify`, a tracker or an experiment found.

    Returns
    -------
    str
        The tables of ``ctid fit``, ``ctid track`` or ``ctid table``, within 100 columns where they fit; of an
        identification with derived quantities, and with warnings. A notebook shows the same without being asked.

    Raises
    ------
    UsageError
        If it is no result.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, Record, Svf, TransferFunction, simulate, summary
    >>> t = 0.1 * np.arange(200)
    >>> u = HeldSignal(t, np.sign(np.sin(t)))
    >>> y = simulate(TransferFunction([2], [1, 1]), u, t)
    >>> print(summary(Svf(poles=1, zeros=0, svf_cutoff=2.0).fit(Record(t, y, u), None)).splitlines()[0])
    parameter  estimate  standard error  relative %  95 % low  95 % high  unit      status
    """
    return _track_result(result).summary() if isinstance(result, FrequencyTrack) else _report(result).draw()


def html(result: Any) -> str:
    """The same as tables of a notebook."""
    if isinstance(result, FrequencyTrack):
        return _track_result(result).write("html")
    return _report(result).draw("html")


def to_frame(result: Result) -> pd.DataFrame:
    """A result as a table.

    Parameters
    ----------
    result : Fit, Identification, FrequencyTrack or ExperimentResults
        What was found.

    Returns
    -------
    pandas.DataFrame
        Of a fit one row for each parameter: ``estimate``, ``standard_error``, ``relative_percent``, ``low``, ``high``,
        ``unit``, ``status``; of a track one row for each instant ``t``, with ``omega_1`` ..., ``frequency_1_hz`` ...,
        ``valid`` and ``flags``, in words; of an experiment one row for each estimate, what ``ctid export`` writes.

    Raises
    ------
    UsageError
        If it is no result.
    """
    import pandas as pd

    if isinstance(result, FrequencyTrack):
        return _frame_of_track(result)
    if isinstance(result, Fit | Identification):
        return pd.DataFrame([parameter_object(item) for item in _parameters(result)]).set_index("name")
    return _of_experiment(result).estimates


def plot(result: Identification | FrequencyTrack | ExperimentResults, kind: str | None = None) -> Picture:
    """A figure of a result, as ``ctid fit``, ``ctid track`` and ``ctid figure`` draw it.

    Parameters
    ----------
    result : Identification, FrequencyTrack or ExperimentResults
        What was found; a single fit does not hold the record that it would be drawn with,
        :func:`~ctid_cli.estimators.identification.identify` does.
    kind : str, optional
        Which figure. Of an identification ``"all"`` (the default) or one part of it: ``"overlay"`` of the measured and
        the simulated output, ``"residuals"``, ``"correlation"`` of these with themselves and with the input,
        ``"profile"`` of the cost over the delay. Of a track ``"tones"``, the default, or ``"frequencies"``: the same.
        Of an experiment ``"measure"``, ``"box"``, ``"errors"``, ``"delays"`` or ``"convergence"``, by default what
        tells most; its method ``figure`` has more options.

    Returns
    -------
    Picture
        The bytes of an SVG file, such as for ``Path("fit.svg").write_bytes``; a notebook shows it.

    Raises
    ------
    UsageError
        If the result has no figure of this kind.
    """
    if isinstance(result, Identification):
        require_kind(kind, get_args(identification_plot.Kind))
        measured = [Measurement.of(record) for record in result.records]
        shown: Any = kind
        return identification_plot.identification_drawing(result, measured, Units(), shown).picture()
    if isinstance(result, FrequencyTrack):
        require_kind(kind, ("tones", "frequencies"))
        return _track_result(result).drawing().picture()
    if isinstance(result, Fit):
        what = f"a single {type(result).__name__} does not hold the record that it would be drawn with"
        raise UsageError(f"{what}; plot(identify(DelayProfile(...), [record])) does")
    return _of_experiment(result).figure(kind)


def _report(result: Any) -> Report:
    """What is said of a result."""
    if not isinstance(result, Fit | Identification):
        return _of_experiment(result).report
    fit = result.fit if isinstance(result, Identification) else result
    blocks: list[list[str | Table]] = [[parameter_table(_parameters(result))]]
    if isinstance(result, Identification):
        blocks.append(derived_block(derived_of(result, Units())))
    blocks.append([f"fit {number(fit.fit_percent, 5)} % of {fit.count} samples: {fit.status.value}"])
    if isinstance(result, Identification):
        blocks.append([*warning_lines(result.warnings)[1:]])
    return Report(blocks)


def _track_result(track: FrequencyTrack) -> TrackResult:
    """Return a track as those of records are."""
    every = float(track.t[1] - track.t[0]) if track.t.size > 1 else 0.0
    return TrackResult(Track.of(track.t, track.frequencies, track.flags, every))


def _frame_of_track(track: FrequencyTrack) -> pd.DataFrame:
    import pandas as pd

    tones = range(track.frequencies.shape[1])
    columns: dict[str, Any] = {"t": track.t, **{f"omega_{k + 1}": track.frequencies[:, k] for k in tones}}
    columns |= {f"frequency_{k + 1}_hz": track.frequencies[:, k] / (2.0 * np.pi) for k in tones}
    columns |= {"valid": track.valid, "flags": flag_names(track.flags)}
    return pd.DataFrame(columns).set_index("t")


def _of_experiment(result: Any) -> ExperimentResults:
    from ctid_cli.reporting.experiment import ExperimentResults

    if not isinstance(result, ExperimentResults):
        results = "a fit, an identification, a track of frequencies, or the results of an experiment"
        raise UsageError(f"{type(result).__name__!r} is no result; what can be shown is {results}")
    return result


def _parameters(result: Fit | Identification) -> list[UncertainValue]:
    """Parameters with their units."""
    if isinstance(result, Identification):
        return parameters_of(result, Units())
    values, errors, reach = result.parameters, result.standard_errors, result.quantiles
    units = {name: parameter_unit(name, list(values)) for name in values}
    return [
        UncertainValue.symmetric(name, value, errors[name], units[name], reach[name]) for name, value in values.items()
    ]
