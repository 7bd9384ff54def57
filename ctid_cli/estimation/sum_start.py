"""Start for the estimation of a sum of submodels, from the record only."""

import numpy as np

from ctid_cli.estimation.additive_problem import AdditiveProblem
from ctid_cli.estimation.optimum.best_model import best_sum
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.submodels import OPEN_LOOP
from ctid_cli.inference.innovations import sampled
from ctid_cli.inference.noise_model import NO_NOISE, fit_noise_model
from ctid_cli.inference.sensitivities import SumStructure
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record, beginning

#: Number of first samples that are used of longer records: poles need not be exact.
LONGEST = 20_000


def automatic_start(record: Record, problem: AdditiveProblem) -> AdditiveModel:
    """Return the sum with the least output error, submodels added one after the other.

    If the output errors are coloured the search is repeated with innovations: in strong coloured noise the plain output
    error would prefer a mode that fits the noise to a weak mode in low noise. In closed loop the measured input is
    used: the small bias is acceptable for a start.

    The method fails for modes slower than the record or below the noise, and for two modes of nearly equal frequency.
    """
    structure, delays = SumStructure(problem.terms), (problem.delay, problem.delay)
    if not any(term.poles for term in problem.terms):
        # The problem is linear, and the first step of any start leads to the solution.
        return AdditiveModel.from_theta(np.ones(structure.size), problem.terms, problem.delay)
    data = filter_data(beginning(record, LONGEST), problem.delay)
    # The state at the first sample is unknown for a single period, too.
    free = problem.initial_state != "rest"
    search = Problem((data,), structure.zeros, free, (), (0.0,), terms=problem.terms)
    model = best_sum(search, delays, ()).additive
    assert model is not None
    if data.interval > 0.0:
        part = AdditiveProblem(data, problem.terms, problem.delay, OPEN_LOOP, problem.initial_state)
        errors = part.least_errors(model.theta)
        noise = fit_noise_model([errors])
        if noise.order and np.linalg.norm(errors) > NO_NOISE * np.linalg.norm(data.y_used):
            arma = ArmaNoise((1.0,), tuple(noise.coefficients.tolist()), innovation_variance=1.0)
            model = best_sum(search._replace(noises=sampled(arma, [data.use])), delays, ()).additive
            assert model is not None
    return model
