"""Results of fits and tracks as text, as tables of pandas and as figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctid_cli.estimators.identification import Identification
from ctid_cli.frequency.record_track import RecordTrack
from ctid_cli.frequency.tracking import FrequencyTrack
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.uncertain_value import UncertainValue
from ctid_cli.reporting.estimate import Units, parameter_object, parameter_table
from ctid_cli.reporting.identification_plot import identification_svg
from ctid_cli.reporting.identification_report import derived_of, derived_table, parameters_of
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.measures import parameter_unit
from ctid_cli.reporting.track_plot import track_svg
from ctid_cli.reporting.track_report import track_table
from ctid_cli.signals.measurement import Measurement
from ctid_cli.text import warning_lines, wrapped

if TYPE_CHECKING:
    import pandas as pd


def summary(result: Fit | Identification) -> str:
    """A fit for people: parameters with their standard errors and 95 % intervals, and what to know of them.

    Parameters
    ----------
    result : Fit or Identification
        What an estimator, or :func:`~ctid_cli.estimators.identification.identify`, found.

    Returns
    -------
    str
        The tables of ``ctid fit``, within 100 columns; of an identification with derived quantities and warnings.

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
    fit = result.fit if isinstance(result, Identification) else result
    parts = [parameter_table(_parameters(result))]
    if isinstance(result, Identification):
        parts.append(derived_table(derived_of(result, Units())))
    parts.append(wrapped(f"fit {number(fit.fit_percent, 5)} % of {fit.count} samples: {fit.status.value}"))
    if isinstance(result, Identification) and result.warnings:
        parts.append("\n".join(warning_lines(result.warnings)))
    return "\n\n".join(parts)


def to_frame(result: Fit | Identification | FrequencyTrack) -> pd.DataFrame:
    """A result as a table.

    Parameters
    ----------
    result : Fit, Identification or FrequencyTrack
        What was found.

    Returns
    -------
    pandas.DataFrame
        Of a fit one row for each parameter: ``estimate``, ``standard_error``, ``relative_percent``, ``low``, ``high``,
        ``unit``, ``status``; of a track one row for each instant, with the columns of ``track.csv``.
    """
    import pandas as pd

    if isinstance(result, FrequencyTrack):
        return pd.DataFrame(track_table(result, 0.0)).set_index("t")
    return pd.DataFrame([parameter_object(item) for item in _parameters(result)]).set_index("name")


class Picture(bytes):
    """An SVG file, which a notebook shows."""

    def _repr_svg_(self) -> str:
        return self.decode()


def plot(result: Identification | RecordTrack) -> Picture:
    """The figure of a result, as ``ctid fit`` and ``ctid track`` draw it.

    Parameters
    ----------
    result : Identification or RecordTrack
        What was found; a single fit does not hold the record that it would be drawn with,
        :func:`~ctid_cli.estimators.identification.identify` does.

    Returns
    -------
    Picture
        The bytes of an SVG file, such as for ``Path("fit.svg").write_bytes``; a notebook shows it.
    """
    if isinstance(result, RecordTrack):
        return Picture(track_svg(result, 0.0, None, "frequencies"))
    measured = [Measurement(record, None, None, None, "t", "u", "y") for record in result.records]
    return Picture(identification_svg(result, measured, Units()))


def _parameters(result: Fit | Identification) -> list[UncertainValue]:
    """Parameters with their units."""
    if isinstance(result, Identification):
        return parameters_of(result, Units())
    values, errors = result.parameters, result.standard_errors
    units = {name: parameter_unit(name, list(values)) for name in values}
    return [UncertainValue.symmetric(name, value, errors[name], units[name]) for name, value in values.items()]
