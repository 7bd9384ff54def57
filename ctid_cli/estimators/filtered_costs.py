"""Output-error costs of low-pass-filtered data as functions of the delay, for searches that evaluate many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ctid_cli.estimators.compiled_iteration import best_coefficients
from ctid_cli.estimators.delay_search import DelayCost, Minimum
from ctid_cli.estimators.problems import least_squares_start
from ctid_cli.filtering.bank import FilterData, filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.signals.record import Record

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Effort:
    """How hard to work at each delay.

    Parameters
    ----------
    max_iterations : int
        Largest number of steps from each start.
    tolerance : float
        Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    halvings : int
        Trials of a step before a direction is given up: far from the true delay a pole may run to infinity, where no
        number of them helps.
    """

    max_iterations: int = 10
    tolerance: float = 1e-2
    halvings: int = 3


class FilteredCost(DelayCost, Protocol):
    """A cost of filtered data that offers starts of its own."""

    @property
    def spread(self) -> float:
        """Sum of squared deviations of the filtered output from its mean [output unit^2], or its equivalent."""

    def start(self, delay: float) -> Array | None:
        """Least-squares start at a delay.

        Parameters
        ----------
        delay : float
            Delay [s].

        Returns
        -------
        ndarray, shape (n + m + 1,) or None
            Coefficients of a stable model; None where the equations are singular.
        """

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts.

        Parameters
        ----------
        delay : float
            Delay [s].
        starts : sequence of ndarray, each of shape (n + m + 1,)
            Coefficients to start from.

        Returns
        -------
        Minimum or None
            The lowest minimum; None where no start leads anywhere.
        """


class SampledCost:
    """Cost of the samples of a filtered record, minimised by the compiled guarded iteration.

    Parameters
    ----------
    data : FilterData
        The filtered record.
    structure : Structure
        Degrees.
    svf_cutoff : float
        Cut-off of the state-variable filter of the starts [rad/s].
    effort : Effort, optional
        How hard to work at each delay.
    """

    def __init__(self, data: FilterData, structure: Structure, svf_cutoff: float, effort: Effort | None = None) -> None:
        self.data = data
        self.structure = structure
        self.svf_cutoff = svf_cutoff
        self.effort = effort or Effort()
        y = data.y_used
        self.spread = float(np.sum((y - y.mean()) ** 2))

    def start(self, delay: float) -> Array | None:
        """Least-squares start at a delay.

        Parameters
        ----------
        delay : float
            Delay [s].

        Returns
        -------
        ndarray, shape (n + m + 1,) or None
            Coefficients of a stable model; None where the equations are singular.
        """
        return least_squares_start(self.data, self.structure, delay, self.svf_cutoff)

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts.

        Parameters
        ----------
        delay : float
            Delay [s].
        starts : sequence of ndarray, each of shape (n + m + 1,)
            Coefficients to start from.

        Returns
        -------
        Minimum or None
            The lowest minimum; None where no start leads anywhere.
        """
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
        )
        return None if found is None else Minimum(delay, *found)

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """Minimise over the coefficients at one delay.

        Parameters
        ----------
        delay : float
            Delay [s].
        theta : ndarray, shape (n + m + 1,) or None
            Coefficients to start from; None for the least-squares start.

        Returns
        -------
        Minimum or None
            The minimum; None where the equations are singular.
        """
        start = self.start(delay) if theta is None else theta
        return None if start is None else self.minimise_from(delay, [start])

    def step(self, minimum: Minimum) -> float | None:
        """Gauss-Newton step of the delay from a minimum of this cost.

        Parameters
        ----------
        minimum : Minimum
            As :meth:`minimise` returned it.

        Returns
        -------
        float or None
            Step [s]; None if the data do not determine the delay.
        """
        return minimum.step


def sampled_costs(
    record: Record, lowpasses: Sequence[Lowpass], structure: Structure, greatest_delay: float, svf_cutoff: float
) -> list[SampledCost]:
    """Costs of one record behind several filters, in the time domain.

    Parameters
    ----------
    record : Record
        The record.
    lowpasses : sequence of Lowpass
        The filters.
    structure : Structure
        Degrees.
    greatest_delay : float
        Samples earlier than this after the first input [s] do not enter the costs.
    svf_cutoff : float
        Cut-off of the state-variable filter of the starts [rad/s].

    Returns
    -------
    list of SampledCost
        One for each filter.
    """
    return [
        SampledCost(filter_data(lowpass.resample(record), greatest_delay), structure, svf_cutoff)
        for lowpass in lowpasses
    ]
