"""Problems in the coefficients alone or with their delay, as tests state them, on what the package computes."""

from types import SimpleNamespace

import numpy as np

from ctid_cli.estimation import delay_search, iteration, sampled_problem, spectral_problem
from ctid_cli.estimation.iteration import GAUSS_NEWTON, HALVINGS, RULES, Equations, Steps, inadmissible
from ctid_cli.estimation.stability import with_stable_denominator


def steps(*, max_iterations, tolerance, variant="guarded", halvings=HALVINGS):
    return Steps(max_iterations, tolerance, {**RULES, "gauss_newton": GAUSS_NEWTON}[variant], halvings)


def delay_step(equations, least_curvature=delay_search.LEAST_CURVATURE):
    """The step where the coefficients are at their minimum, or None."""
    step = delay_search.delay_step(equations, least_curvature)
    return None if np.isnan(step) else step


class Coefficients:
    """A problem at a held delay, seen as one of its coefficients; no equations are None."""

    def __init__(self, inner, delay):
        self.inner, self.delay = inner, float(delay)

    def extended(self, theta):
        return np.append(theta, self.delay)

    def equations(self, theta):
        found = self.inner.equations(self.extended(theta))
        if not np.isfinite(found.squared_error):
            return None
        p = theta.size
        return found._replace(
            instrument_regressor=found.instrument_regressor[:p, :p].copy(),
            instrument_error=found.instrument_error[:p].copy(),
            hessian=found.hessian[:p, :p].copy(),
        )

    def admissible(self, theta):
        return with_stable_denominator(theta, self.inner.poles)


class CoefficientProblem(Coefficients):
    """Coefficients from samples at a delay."""

    def __init__(self, data, structure, delay):
        super().__init__(sampled_problem.at_known_delay(data, structure), delay)
        self.data = data


def spectral_at(spectra, structure, delay, weight):
    """The coefficients of a record's spectra at a delay."""
    inputs = spectra.inputs(delay)
    return spectral_problem.SpectralProblem(
        spectra.frequencies, spectra.outputs, inputs, weight, structure.poles, structure.zeros
    )


class SpectralCoefficientProblem(Coefficients):
    """Coefficients from spectra at a delay."""

    def __init__(self, spectra, structure, delay, weight):
        super().__init__(spectral_at(spectra, structure, delay, weight), delay)


class DelayProblem:
    """Coefficients and delay from samples; no equations are None."""

    def __init__(self, data, structure, bounds):
        self.inner = sampled_problem.SampledProblem(data, structure.poles, structure.zeros, True, *map(float, bounds))

    def equations(self, theta):
        found = self.inner.equations(theta)
        return found if np.isfinite(found.squared_error) else None


class SpectralDelayProblem:
    """Coefficients and delay from spectra; no equations are None."""

    def __init__(self, spectra, structure, bounds, weight):
        self.spectra, self.structure, self.bounds, self.weight = spectra, structure, bounds, weight

    def equations(self, theta):
        if not self.bounds[0] <= theta[-1] <= self.bounds[1]:
            return None
        found = spectral_at(self.spectra, self.structure, float(theta[-1]), self.weight).equations(theta)
        return found if np.isfinite(found.squared_error) else None

    def admissible(self, theta):
        return with_stable_denominator(theta, self.structure.poles)


class Interpreted:
    """Any problem whose missing equations are None."""

    def __init__(self, problem, size):
        self.problem, self.free = problem, size

    def equations(self, theta):
        found = self.problem.equations(theta)
        return inadmissible(self.free) if found is None else Equations(*found)

    def admissible(self, theta):
        return self.problem.admissible(theta)


def iterate(problem, theta, *, on_step=None, **options):
    """The iteration of the package, seen from these problems."""
    theta = np.asarray(theta, dtype=float)
    size = theta.size
    if isinstance(problem, Coefficients):
        inner, start = problem.inner, problem.extended(theta)
    elif isinstance(problem, DelayProblem):
        inner, start = problem.inner, theta
    elif hasattr(problem, "free"):
        inner, start = problem, theta
    else:
        inner, start = Interpreted(problem, size), theta
    result = iteration.iterate(inner, start, steps(**options))
    if result is None:
        return None
    for row in result.path if on_step else ():
        on_step(row[:size], SimpleNamespace(squared_error=row[-1]))
    equations = problem.equations(result.theta[:size]) if isinstance(problem, Coefficients) else result.equations
    return SimpleNamespace(
        theta=result.theta[:size], equations=equations, status=result.status, iterations=result.iterations
    )


def best_coefficients(data, structure, delay, starts, *, gauss_newton=False, **effort):
    """Coefficients, squared error and step of the delay, or None."""
    starts = np.array([np.append(start, float(delay)) for start in np.atleast_2d(starts)])
    rule = "gauss_newton" if gauss_newton else "guarded"
    problem = sampled_problem.at_known_delay(data, structure)
    found = delay_search.best_of(problem, starts, structure.poles, steps(variant=rule, **effort))
    if np.isinf(found.squared_error):
        return None
    return found.theta[:-1], found.squared_error, None if np.isnan(found.step) else found.step


def _refitted(problem, structure, theta, delay):
    n, m = structure.poles, structure.zeros
    return iteration.with_best(problem, np.append(theta, float(delay)), n, n + m + 1)[:-1]


def refit_numerator(data, structure, theta, delay):
    return _refitted(sampled_problem.at_known_delay(data, structure), structure, theta, delay)


def spectral_refit_numerator(spectra, structure, theta, delay, weight):
    problem = spectral_at(spectra, structure, delay, weight)
    return _refitted(problem, structure, theta, delay)


def least_squares_start(data, structure, delay, svf_cutoff):
    theta = sampled_problem.least_squares_start(data, structure, delay, svf_cutoff)
    return None if theta is None else theta[:-1]


def spectral_least_squares_start(spectra, structure, delay, svf_cutoff, weight):
    problem = spectral_at(spectra, structure, delay, weight)
    solved, theta = spectral_problem.spectral_least_squares_start(problem, svf_cutoff)
    return theta[:-1] if solved else None
