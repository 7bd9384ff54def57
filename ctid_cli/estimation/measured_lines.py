"""A frequency response laid out for estimation, as records are."""

from dataclasses import replace

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.measured_records import Layout, MeasuredRecords, Treatment
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.sensitivities import Structure


class MeasuredLines(MeasuredRecords):
    """A frequency response of a system at rest, and its least-squares cost over all parameters.

    The parts of the values, real ones first and weighted, stand where records have their samples.
    """

    def __init__(
        self,
        lines: FrequencyLines,
        structure: Structure,
        delay_bounds: tuple[float, float],
        integrators: int = 0,
        known: KnownCoefficients = NOTHING,
        name: str = "",
        *,
        check: bool = True,
    ) -> None:
        self.lines, self.structure, self.known = lines, structure, known
        self.treatment = Treatment(delay_bounds, "rest", "none", "foh", integrators=integrators)
        self.layout = Layout(structure, integrators=integrators)
        self.records, self.input_offsets, self.offsets = [], [0.0], [0.0]
        self.outputs = [lines.y_used]
        self._problem = Problem((lines,), structure.zeros, False, (), (0.0,), integrators=integrators)
        what = f"{name}: " if name else ""
        if check and lines.count <= structure.size:
            raise DataError(
                f"{what}{lines.count} real equations are too few for {structure.size} parameters; give more "
                "frequencies, or fit a smaller model"
            )
        if integrators and lines.frequencies[0] == 0.0:
            raise DataError(
                f"{what}a system with integrators has no value at frequency 0; leave that line out, or fit without "
                "integrators"
            )

    @property
    def problem(self) -> Problem:  # type: ignore[override]
        """The lines, and that nothing but the numerator is eliminated with them."""
        return self._problem

    @property
    def spread(self) -> float:
        """Sum of the squares of the weighted values."""
        return float(self.outputs[0] @ self.outputs[0])

    @property
    def regular(self) -> bool:
        """Whether lags counted in values are lags in frequency."""
        return True

    def used(self) -> tuple[BoolArray, ...]:
        """Which real and imaginary parts are equations."""
        return (self.lines.use,)

    def with_structure(self, structure: Structure) -> "MeasuredLines":
        """The same lines for another model."""
        bounds, integrators = self.treatment.delay_bounds, self.treatment.integrators
        return MeasuredLines(self.lines, structure, bounds, integrators)
