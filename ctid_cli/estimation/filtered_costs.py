"""Output-error costs of low-pass-filtered data as functions of the delay, for searches that evaluate many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.compiled_iteration import best_coefficients
from ctid_cli.estimation.delay_search import DelayCost, Minimum, delay_step
from ctid_cli.estimation.problems import least_squares_start
from ctid_cli.estimation.refined_iv import Equations, Iterated, iterate
from ctid_cli.estimation.spectral_problem import (
    SpectralCoefficientProblem,
    SpectralDelayProblem,
    enough_bins,
    spectral_least_squares_start,
    spectral_refit_numerator,
)
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import RecordSpectra, lowpass_weight, record_spectra
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record

Search = Literal["time", "spectral"]

#: Highest frequency of a spectral search, as a multiple of the highest cut-off: a filter of order 10 passes 3e-4 of the
#: power there.
HIGHEST = 1.5
#: A cost of fewer samples for each parameter says nothing about the delay.
SAMPLES_PER_PARAMETER = 3


@dataclass(frozen=True)
class Effort:
    """How hard to work at each delay."""

    max_iterations: int = 10
    #: Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    tolerance: float = 1e-2
    halvings: int = 3
    gauss_newton: bool = False


class FilteredCost(DelayCost, Protocol):
    """A cost of filtered data that offers starts of its own.

    ``spread`` is the sum of squared deviations of the filtered output from its mean [output unit^2], or its equivalent;
    ``mean_factor`` turns a squared error of this cost into a mean square over the used part of the record.
    """

    spread: float
    mean_factor: float

    def start(self, delay: float) -> Array | None:
        """Least-squares start at a delay."""

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts."""

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """Minimise over the coefficients at one delay."""
        start = self.start(delay) if theta is None else theta
        return None if start is None else self.minimise_from(delay, [start])


class SampledCost(FilteredCost):
    """Cost of the samples of a filtered record, minimised by the compiled guarded iteration."""

    def __init__(self, data: FilterData, structure: Structure, svf_cutoff: float, effort: Effort | None = None) -> None:
        self.data = data
        self.structure = structure
        self.svf_cutoff = svf_cutoff
        self.effort = effort or Effort()
        y = data.y_used
        self.spread = float(np.sum((y - y.mean()) ** 2))
        self.mean_factor = 1.0 / max(data.count, 1)

    def start(self, delay: float) -> Array | None:
        """Least-squares start at a delay."""
        return least_squares_start(self.data, self.structure, delay, self.svf_cutoff)

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts."""
        if not starts:
            return None
        effort = self.effort
        found = best_coefficients(
            self.data,
            self.structure,
            delay,
            np.array(starts),
            max_iterations=effort.max_iterations,
            tolerance=effort.tolerance,
            halvings=effort.halvings,
            gauss_newton=effort.gauss_newton,
        )
        return None if found is None else Minimum(delay, *found)

    def step(self, minimum: Minimum) -> float | None:
        """Gauss-Newton step of the delay from a minimum of this cost."""
        return minimum.step


class SpectralCost(FilteredCost):
    """Cost of a record's spectra behind a low-pass filter, the initial and the final state projected out."""

    mean_factor = 1.0

    def __init__(
        self,
        spectra: RecordSpectra,
        lowpass: Lowpass,
        structure: Structure,
        bounds: tuple[float, float],
        svf_cutoff: float,
        effort: Effort | None = None,
    ) -> None:
        self.spectra = spectra
        self.weight = lowpass_weight(spectra.frequencies, lowpass)
        self.structure = structure
        self.svf_cutoff = svf_cutoff
        self.effort = effort or Effort()
        self.joint = SpectralDelayProblem(spectra, structure, bounds, self.weight)
        sides = np.where(spectra.frequencies > 0, 2.0, 0.0)
        self.spread = float(np.sum(sides * self.weight * np.abs(spectra.outputs) ** 2))

    def start(self, delay: float) -> Array | None:
        """Least-squares start at a delay."""
        return spectral_least_squares_start(self.spectra, self.structure, delay, self.svf_cutoff, self.weight)

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts."""
        effort = self.effort
        problem = (_SpectralSearch if effort.gauss_newton else SpectralCoefficientProblem)(
            self.spectra, self.structure, delay, self.weight
        )
        best: Iterated | None = None
        for theta in starts:
            found = iterate(
                problem,
                spectral_refit_numerator(self.spectra, self.structure, theta, delay, self.weight),
                max_iterations=effort.max_iterations,
                tolerance=effort.tolerance,
                variant="guarded",
                halvings=effort.halvings,
            )
            if found is not None and (best is None or found.equations.squared_error < best.equations.squared_error):
                best = found
        return None if best is None else Minimum(delay, best.theta, best.equations.squared_error)

    def step(self, minimum: Minimum) -> float | None:
        """Gauss-Newton step of the delay from a minimum of this cost."""
        equations = self.joint.equations(np.concatenate((minimum.theta, [minimum.delay])))
        return None if equations is None else delay_step(equations)


class _SpectralSearch(SpectralCoefficientProblem):
    """Gauss-Newton steps only."""

    def equations(self, theta: Array) -> Equations | None:
        equations = super().equations(theta)
        return None if equations is None else replace(equations, instrument_regressor=equations.hessian)


def filtered_costs(
    record: Record,
    lowpasses: Sequence[Lowpass],
    structure: Structure,
    bounds: tuple[float, float],
    *,
    search: Search,
    start: float,
    svf_cutoff: float | Sequence[float],
    hold_output: Hold = "foh",
    effort: Effort | None = None,
) -> list[FilteredCost | None]:
    """Costs of one record behind several filters."""
    cutoffs = np.broadcast_to(np.asarray(svf_cutoff, dtype=float), (len(lowpasses),)).tolist()
    spectra: RecordSpectra | None = None
    if search == "spectral":
        highest = HIGHEST * max(lowpass.cutoff for lowpass in lowpasses)
        spectra = record_spectra(record, start, highest, bounds[1])
    joint = replace(structure, delay=True)
    costs: list[FilteredCost | None] = []
    for lowpass, cutoff in zip(lowpasses, cutoffs, strict=True):
        if spectra is not None and enough_bins(lowpass_weight(spectra.frequencies, lowpass), joint):
            costs.append(SpectralCost(spectra, lowpass, structure, bounds, cutoff, effort))
        else:
            data = filter_data(lowpass.resample(record), start, hold_output)
            enough = data.count >= SAMPLES_PER_PARAMETER * joint.size and np.ptp(data.y_used) > 0.0
            costs.append(SampledCost(data, structure, cutoff, effort) if enough else None)
    return costs
