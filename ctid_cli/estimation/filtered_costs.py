"""Output-error costs of low-pass-filtered data as functions of the delay, for searches that evaluate many of them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import DelayCost, Minimum, best_minimum
from ctid_cli.estimation.iteration import GUARDED, Steps
from ctid_cli.estimation.sampled_problem import SampledProblem, at_known_delay, least_squares_starts
from ctid_cli.estimation.spectral_problem import (
    SpectralProblem,
    enough_bins,
    spectral_least_squares_start,
    spectral_problem,
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


#: Cost of a filter in which nothing can be computed [%].
NOTHING = 100.0
#: How hard to work at each delay, unless a search asks for something else.
EFFORT = Steps(max_iterations=10, tolerance=1e-2, rule=GUARDED, halvings=3)


class FilteredCost(DelayCost, ABC):
    """A cost of filtered data, minimised by the compiled guarded iteration, that offers starts of its own.

    ``spread`` is the sum of squared deviations of the filtered output from its mean [output unit^2], or its equivalent;
    ``mean_factor`` turns a squared error of this cost into a mean square over the used part of the record.
    """

    spread: float
    mean_factor: float
    #: Whether the gradient in the coefficients is projected out of the delay's step.
    project_gradient: bool

    def __init__(self, structure: Structure, svf_cutoff: float, effort: Steps) -> None:
        self.structure = structure
        self.svf_cutoff = svf_cutoff
        self.effort = effort

    @abstractmethod
    def problem(self, delay: float) -> SampledProblem | SpectralProblem:
        """The coefficients at one delay."""

    @abstractmethod
    def starts(self, delay: float) -> list[Array]:
        """Least-squares start at a delay, if there is one."""

    def percent(self, minimum: Minimum | None) -> float:
        """``100 ||y - x|| / ||y - mean y||`` of the filtered data [%]; 100 where nothing can be computed."""
        return NOTHING if minimum is None else 100.0 * float(np.sqrt(minimum.squared_error / self.spread))

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts, each (a_1 … a_n, b_0 … b_m, any delay)."""
        return best_minimum(
            self.problem(delay), delay, starts, self.structure.poles, self.effort, self.project_gradient
        )

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """Minimise over the coefficients at one delay."""
        return self.minimise_from(delay, self.starts(delay) if theta is None else [theta])


class SampledCost(FilteredCost):
    """Cost of the samples of a filtered record."""

    project_gradient = True

    def __init__(self, data: FilterData, structure: Structure, svf_cutoff: float, effort: Steps = EFFORT) -> None:
        super().__init__(structure, svf_cutoff, effort)
        self.data = data
        y = data.y_used
        self.spread = float(np.sum((y - y.mean()) ** 2))
        self.mean_factor = 1.0 / max(data.count, 1)

    def problem(self, delay: float) -> SampledProblem:
        """The coefficients at one delay."""
        return at_known_delay(self.data, self.structure)

    def starts(self, delay: float) -> list[Array]:
        """Least-squares start at a delay, if there is one."""
        return least_squares_starts(self.data, self.structure, delay, [self.svf_cutoff])


class SpectralCost(FilteredCost):
    """Cost of a record's spectra behind a low-pass filter, the initial and the final state projected out."""

    mean_factor = 1.0
    project_gradient = False

    def __init__(
        self, spectra: RecordSpectra, lowpass: Lowpass, structure: Structure, svf_cutoff: float, effort: Steps = EFFORT
    ) -> None:
        super().__init__(structure, svf_cutoff, effort)
        self.spectra = spectra
        self.weight = lowpass_weight(spectra.frequencies, lowpass)
        sides = np.where(spectra.frequencies > 0, 2.0, 0.0)
        self.spread = float(np.sum(sides * self.weight * np.abs(spectra.outputs) ** 2))

    def problem(self, delay: float) -> SpectralProblem:
        """The coefficients at one delay."""
        return spectral_problem(self.spectra, self.structure, delay, self.weight)

    def starts(self, delay: float) -> list[Array]:
        """Least-squares start at a delay, if there is one."""
        start = spectral_least_squares_start(self.problem(delay), delay, self.svf_cutoff)
        return [] if start is None else [start]


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
    effort: Steps = EFFORT,
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
            costs.append(SpectralCost(spectra, lowpass, structure, cutoff, effort))
        else:
            data = filter_data(lowpass.resample(record), start, hold_output)
            enough = data.count >= SAMPLES_PER_PARAMETER * joint.size and np.ptp(data.y_used) > 0.0
            costs.append(SampledCost(data, structure, cutoff, effort) if enough else None)
    return costs
