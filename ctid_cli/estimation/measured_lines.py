"""Frequency response prepared for estimation like records."""

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.measured_records import MeasuredRecords, Treatment
from ctid_cli.estimation.optimum.box import each_bounds
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.parameter_layout import Degrees, Layout, SumDegrees
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.repetition import Repetition, repetitions_of_lines
from ctid_cli.signals.frequency_data import FrequencyData


class MeasuredLines(MeasuredRecords):
    """Frequency response of a system at rest, and its least-squares cost over all parameters.

    The weighted real, then imaginary, parts take the place of the samples of a record.
    """

    def __init__(
        self,
        source: FrequencyData,
        degrees: Degrees | SumDegrees,
        delay_bounds: tuple[float, float],
        known: KnownCoefficients = NOTHING,
    ) -> None:
        self.source, self.known = source, known
        self.records, self.input_offsets, self.offsets = [], [0.0], [0.0]
        self.lines = lines_of(source)
        self.outputs = [self.lines.y_used]
        arguments = dict(degrees.search_arguments)
        self.problem = Problem((self.lines,), arguments.pop("zeros"), False, (), (0.0,), **arguments)
        integrators = (sum(self.problem.each_integrators),)
        self.treatment = Treatment(delay_bounds, "rest", "none", "foh", integrators=integrators)
        self.layout = Layout(degrees)

    @property
    def repetitions(self) -> tuple[tuple[Repetition, ...], ...]:
        """Shifts by which the delay changes no line, or only the sign of all."""
        low, high = each_bounds(self.treatment.delay_bounds)[0]
        return (repetitions_of_lines(self.lines.frequencies) if low < high else (),)

    def check(self) -> None:
        """Raise DataError if the structure cannot be estimated from the data."""
        what, size = f"{self.source.name}: " if self.source.name else "", self.structure.size
        count = min(self.lines.count, 2 * np.unique(self.lines.frequencies).size)
        if count <= size:
            raise DataError(
                f"{what}{count} real equations are too few for {size} parameters; give more frequencies, or fit a "
                "smaller model"
            )
        if any(self.treatment.integrators) and self.lines.frequencies[0] == 0.0:
            raise DataError(
                f"{what}a system with integrators has no value at frequency 0; leave that line out, or fit without "
                "integrators"
            )

    @property
    def spread(self) -> float:
        """Sum of the squares of the weighted values."""
        return float(self.outputs[0] @ self.outputs[0])

    @property
    def regular(self) -> bool:
        """Whether lags in values are lags in frequency."""
        return True

    def used(self) -> tuple[BoolArray, ...]:
        """Mask of the real and imaginary parts that are equations."""
        return (self.lines.use,)


def lines_of(data: FrequencyData) -> FrequencyLines:
    """Return the lines of a frequency response with their weights.

    With standard errors the real and the imaginary part of each error have the variance one.
    """
    w, size = data.frequencies, data.frequencies.size
    even = FrequencyLines(w, data.response, np.ones(size), data.interval)
    if data.standard_error is not None:
        both = even.use[size:]
        return FrequencyLines(w, data.response, np.sqrt(1.0 + both) / data.standard_error, data.interval)
    if data.weight == "none":
        return even
    gain = np.abs(data.response)
    if not gain.all():
        what = f"the value at {w[int(np.argmin(gain))]:g} rad/{data.units[0]} is 0, which has no weight {data.weight}"
        raise DataError(f"{data.name}: {what}; use none" if data.name else f"{what}; use none")
    weights = 1.0 / (gain if data.weight == "inverse" else np.sqrt(gain))
    return FrequencyLines(w, data.response, weights, data.interval)
