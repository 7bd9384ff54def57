"""Random systems and their records."""

import numpy as np

from ctid_cli.estimation.optimum.best_model import best_local, best_output_error
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

MODEL = TransferFunction([2.0, 5.0], np.poly([-0.3, -1.0 + 2.0j, -1.0 - 2.0j]).real, 0.37)


def random_poles(rng, n, slowest=0.1, fastest=2.0):
    """Return real poles and pairs, including lightly damped ones."""
    poles = []
    while len(poles) < n:
        w = np.exp(rng.uniform(np.log(slowest), np.log(fastest)))
        zeta = rng.choice([1.0, 0.7, 0.3, 0.05])
        if zeta < 1 and n - len(poles) > 1:
            poles += [w * complex(-zeta, side * np.sqrt(1 - zeta * zeta)) for side in (1, -1)]
        else:
            poles.append(complex(-w))
    return np.array(poles)


def random_model(rng, n, m, delay=0.0):
    """Return a system of unit static gain with the given numbers of poles and zeros."""
    denominator = np.poly(random_poles(rng, n)).real
    zeros = -np.exp(rng.uniform(np.log(0.1), np.log(2.0), m)) * rng.choice([1, 1, -1], m)
    numerator = np.poly(zeros).real if m else np.ones(1)
    return TransferFunction(numerator / abs(numerator[-1]) * denominator[-1], denominator, delay)


def record_of(model, rng, *, samples=300, noise=0.0, regular=True, hold="zoh", offset=0.0):
    """Return the response to random steps, one of them two samples long, every .5 s."""
    t = 0.5 * np.arange(samples) if regular else np.cumsum(rng.uniform(0.2, 0.8, samples))
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 2 + 1), 2)[:samples]
    x = simulate(model, HeldSignal(t, u, hold), t)
    y = x + noise * x.std() * rng.standard_normal(samples) + offset
    return Record.from_arrays(t, u, y, hold=hold)


def problem_of(records, zeros, *, free_response=False, offset=False, periods=None, integrators=0):
    """Lay out records with the treatment of their nuisance parameters."""
    periods = periods or (0.0,) * len(records)
    return Problem(tuple(records), zeros, free_response, (0,) * offset, periods, integrators=integrators)


def best(records, poles, zeros, *, delays=(0.0, 0.0), starts=(), search=best_output_error, **options):
    """Return the minimum output error of records."""
    names = "free_response", "offset", "periods", "integrators"
    problem = problem_of(records, zeros, **{name: options.pop(name) for name in names if name in options})
    return search(problem, poles, delays, starts, **options)


def nearest(records, poles, zeros, **options):
    """Return the minimum output error in the basins of starts."""
    return best(records, poles, zeros, search=best_local, **options)
