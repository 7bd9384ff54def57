"""Fits of many structures to the same records in one treatment, each started from smaller structures it contains."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import best_near, best_of_orders
from ctid_cli.estimation.optimum.box import Point, box_of, point_of
from ctid_cli.estimation.optimum.search import Local
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.estimators.measured_fit import MeasuredFit, fitted
from ctid_cli.inference.criteria import PENALTY
from ctid_cli.models.several_inputs import AnyModel, delays_of
from ctid_cli.signals.record import Record

#: Fewest samples for each parameter of a structure.
SAMPLES_PER_PARAMETER = 3
#: A zero whose removal costs this many penalties of a parameter at the delays found is not tried at others.
FAR_BEHIND = 10.0
#: Options, fit, and number of parameters with those of each record.
StructureFit = tuple[DelayProfile, MeasuredFit, int]


class StructureFits:
    """Fits of structures with one number of integrators, in the treatment, range and holds of given options.

    Options ``alone``, known parameters for example, give each structure its own search. Searches of several inputs
    start from ``first_delays``, and each input may have ``fewer_zeros``. Searches start only from models ``near`` if
    these are given.
    """

    def __init__(
        self,
        records: Sequence[Record],
        treated: DelayProfile,
        alone: Mapping[str, Any] | None = None,
        first_delays: tuple[float, ...] | None = None,
        *,
        fewer_zeros: bool = False,
        near: Callable[[int, int], AnyModel | None] | None = None,
    ) -> None:
        self.records, self.treated, self.alone = records, treated, alone or {}
        self.near = near or (lambda *_: None)
        self.first_delays, self.fewer_zeros = first_delays, fewer_zeros
        self.found: dict[tuple[int, int], StructureFit | None] = {}

    @cached_property
    def measured(self) -> MeasuredRecords:
        """Prepared records, with the smallest structure."""
        smallest = replace(self.treated, poles=int(not self.treated.integrators), zeros=0)
        return smallest.prepare(self.records).laid_out

    @cached_property
    def search(self) -> StructureSearch:
        """Search that all structures share."""
        box = box_of(self.measured.problem, self.measured.treatment.delay_bounds)
        return StructureSearch(self.measured.problem, box, effort=QUICK, first_delays=self.first_delays)

    def fit(self, poles: int, zeros: int) -> StructureFit | None:
        """Fit a structure; return None if there are too few samples, or it lacks a known parameter."""
        key = poles, zeros
        if key not in self.found:
            self.found[key] = self._fitted_alone(*key) if self.alone else self._searched(*key)
        return self.found[key]

    def model(self, poles: int, zeros: int) -> AnyModel | None:
        """Return the model of a structure; None if it has no fit."""
        found = self.fit(poles, zeros)
        return None if found is None else found[1].model

    def _searched(self, poles: int, zeros: int) -> StructureFit | None:
        options, measured = replace(self.treated, poles=poles, zeros=zeros), self.measured
        laid_out = measured.with_degrees(options.order, [zeros] * len(measured.degrees.inputs))
        size = laid_out.layout.size - options.integrators
        if _too_few(laid_out, size):
            return None
        near = self.near(poles, zeros)
        if near is None:
            optimum = best_of_orders(self.search, poles, zeros)
        else:
            optimum = best_near(self.search, zeros, self._point(near))
        found = options, fitted(laid_out, optimum, None), size
        return self._with_fewer_zeros(*found) if self.fewer_zeros else found

    def _fitted_alone(self, poles: int, zeros: int) -> StructureFit | None:
        """Fit a structure with known or bounded parameters, or with degrees of single inputs."""
        try:
            options = replace(self.treated, poles=poles, zeros=zeros, **self.alone)
            laid_out = options.prepare(self.records).laid_out
        except OptionError:
            return None
        size = laid_out.layout.size - int(np.count_nonzero(laid_out.given))
        if _too_few(laid_out, size):
            return None
        near = None if options.bounds else self.near(poles, zeros)
        try:
            if near is None:
                return options, options._minimum(laid_out, None), size
            return options, fitted(laid_out, laid_out.local(laid_out.begin(near)), None), size
        except DataError:
            # No model with the known parameters lies in the admissible set.
            return None

    def _with_fewer_zeros(self, options: DelayProfile, fit: MeasuredFit, size: int) -> StructureFit:
        """Remove the zeros of each input that do not lower the criterion in white noise."""
        names = self.measured.degrees.inputs
        zeros = [options.zeros] * len(names)
        if fit.poles_at_infinity or len(names) < 2:
            return options, fit, size
        point = self._point(fit.model)
        error, penalty = fit.cost * fit.count, PENALTY * float(np.log(fit.count)) / fit.count
        for k in range(len(names)):
            while zeros[k] > 0:
                fewer = [*zeros[:k], zeros[k] - 1, *zeros[k + 1 :]]
                found = self._without_zero(fewer, point, error, penalty)
                if np.log(found.squared_error / error) > penalty:
                    break
                zeros, point, error = fewer, found.point, found.squared_error
        if min(zeros) == options.zeros:
            return options, fit, size
        own = {one.name: one for one in options.inputs or ()}
        inputs = tuple(replace(own.get(name, InputModel(name)), zeros=m) for name, m in zip(names, zeros, strict=True))
        laid_out, search = self._quick(zeros, point)
        found_fit = fitted(laid_out, best_near(search, max(zeros), point), None)
        return replace(options, inputs=inputs), found_fit, laid_out.layout.size - options.integrators

    def _without_zero(self, zeros: Sequence[int], point: Point, error: float, penalty: float) -> Local:
        """Return a minimum with numerators of other degrees, near one with this squared error."""
        poles, most = point.poles.size, max(zeros)
        _, search = self._quick(zeros, point)
        found = search.descent(most).descend(point)
        if penalty < np.log(found.squared_error / error) < FAR_BEHIND * penalty:
            # There may be a lower minimum at other delays.
            search.refine(poles, most, [found.point])
            return search.minima(poles, most)[0]
        return found

    def _quick(self, zeros: Sequence[int], point: Point) -> tuple[MeasuredRecords, StructureSearch]:
        """Prepare numerators of other degrees, with the number of poles of a point, and their search."""
        laid_out = self.measured.with_degrees(point.poles.size + self.treated.integrators, zeros)
        return laid_out, StructureSearch(laid_out.problem, self.search.box, effort=QUICK)

    def _point(self, model: AnyModel) -> Point:
        """Return the poles of a model, without integrators, and its delays."""
        return point_of(self.measured.free_poles(model), delays_of(model), self.search.box)


def _too_few(laid_out: MeasuredRecords, size: int) -> bool:
    return SAMPLES_PER_PARAMETER * size > sum(data.count for data in laid_out.data)
