"""Contribution of each start, stage and special case to the search for the optimum.

    python benchmarks/bench_ablation.py [--systems 100] [--seed 1] [--records FOLDER] [--configs] [--only NAME ...]
        [--costs FILE]

Every problem is solved with the whole optimiser and once without each of its parts. The benefit of a part is the number
of problems that end above the least cost of all variants by more than a millionth without it; its price is the time
saved without it. ``--costs`` keeps the least costs in a file, so that later runs with less code are compared with them.

Random systems have a regular or an irregular clock, an input of random steps or of one narrow band, and a delay that is
known, or searched within 12 or 100 sampling intervals. Two kinds of search alternate: that of a fit (``fit``, 1 to 4
poles), and the one for orders (``orders``, 1 to 6). A part is left out only where it applies, and problems to which
none of the parts of ``--only`` applies are left out.
``--records`` adds measured records (see bench_optimum.py), ``--configs`` data sets of the useful-redundancy study.
"""

import argparse
import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from _timing import cpu

import numpy as np
from bench_optimum import OTHERWISE, STRUCTURES, TREATMENTS, measured
from scipy.optimize import least_squares

from ctid_cli import DataError, DelayProfile, HeldSignal, Record, TransferFunction
from ctid_cli.estimation.optimum import best_model, box, search, starts
from ctid_cli.estimation.optimum.best_model import best_of_orders
from ctid_cli.estimation.optimum.search import Descent
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch
from ctid_cli.filtering.simulate import simulate
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "useful_redundancy"
TOLERANCE = 1e-6
#: Most samples of a measured record.
MOST = 500


# --- problems ----------------------------------------------------------------------------------------


def random_poles(rng, count, slowest, fastest):
    poles = []
    while len(poles) < count:
        w = np.exp(rng.uniform(np.log(slowest), np.log(fastest)))
        if rng.random() < 0.6 and count - len(poles) > 1:
            zeta = 10.0 ** rng.uniform(-2.0, -0.1)
            poles += [w * complex(-zeta, side * np.sqrt(1 - zeta * zeta)) for side in (1, -1)]
        else:
            poles.append(complex(-w))
    return np.array(poles)


def random_problem(rng, way):
    """Return an estimator and a record to fit."""
    most = int(rng.integers(1, 5)) if way == "fit" else 6
    n, samples, latest = int(rng.integers(1, most + 1)), int(rng.integers(200, 400)), int(rng.choice([0, 12, 100]))
    m = int(rng.integers(0, min(n, 4)))
    before = 100
    steps = np.ones(samples + before) if rng.random() < 0.6 else rng.uniform(0.3, 1.7, samples + before)
    t = np.cumsum(steps) - steps[0]
    poles = random_poles(rng, n, 6.0 / samples, 1.5)
    b = np.atleast_1d(np.poly(-np.exp(rng.uniform(-4.0, 1.0, m)) * rng.choice([1, 1, -1], m)))
    a = np.poly(poles).real
    model = TransferFunction(b / b[-1] * a[-1], a, float(rng.uniform(0.0, 0.8 * latest)) if latest else 0.0)
    if rng.random() < 0.5:
        hold = int(rng.integers(1, 20))
        u = np.repeat(rng.choice([-1.0, 1.0], t.size // hold + 1), hold)[: t.size]
    else:
        middle = np.exp(rng.uniform(np.log(0.05), np.log(1.0)))
        lines = middle * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, 8))
        u = np.cos(np.outer(t, lines) + rng.uniform(0.0, 2.0 * np.pi, 8)).sum(axis=1)
    state = str(rng.choice(["rest", "estimate"]))
    if state == "rest":
        t, u = t[:samples], u[:samples]
    x = simulate(model, HeldSignal(t, u), t)
    kept = slice(-samples, None)
    offset = "estimate" if rng.random() < 0.3 else "none"
    noise = rng.standard_normal(samples) * x.std() * 10.0 ** (-rng.uniform(5.0, 35.0) / 20.0)
    y = x[kept] + noise + (offset == "estimate") * x.std()
    asked = int(np.clip(n + rng.choice([-1, 0, 0, 1]), 1, most))
    options = DelayProfile(
        asked, min(m, asked - 1), (0.0, float(latest)), initial_state=state, offset=offset, covariance="white"
    )
    return options, Record.from_arrays(t[kept] - t[-samples], u[kept], y)


def study_problems(count):
    """Return the first data sets of the useful-redundancy study."""
    for name in ("case1_regular", "case1_irregular", "case2_regular", "case2_irregular"):
        plan = build_plan(load_spec(CONFIGS / f"{name}.yaml"))
        estimator = next(cell.estimator for cell in plan.estimators if cell.name == "delay_profile")
        for cell in plan.data_cells:
            for k in range(count):
                yield f"{name} {cell.swept['snr_db']} dB {k}", estimator, cell.dataset(k).record, "fit"


def problems(asked):
    """Return names, estimators, records and kinds of search."""
    if asked.configs:
        yield from study_problems(2)
    for name, record in measured(asked.records) if asked.records else ():
        state, offset, delays = TREATMENTS.get(name, OTHERWISE)
        t, u, y = record.t[:MOST], record.input.values[:MOST], record.y[:MOST]
        for number, (n, m) in enumerate(STRUCTURES):
            options = DelayProfile(n, m, delays, initial_state=state, offset=offset, covariance="white")
            way = ("fit", "fit", "orders", "orders")[number]
            yield f"{name} {n}/{m}", options, Record.from_arrays(t, u, y), way
    for number in range(asked.systems):
        way = ("fit", "orders")[number % 2]
        yield f"{asked.seed} {number}", *random_problem(np.random.default_rng([asked.seed, number]), way), way


def solved(options, record, way):
    """Return the least squared error found."""
    if way == "orders":
        problem = options.prepare(record).laid_out.problem
        searched = StructureSearch(problem, box.box_of(problem, options.delay_bounds), effort=QUICK)
        return best_of_orders(searched, options.poles, options.zeros).squared_error
    fit = options.fit(record)
    return fit.cost * fit.count


# --- variants ----------------------------------------------------------------------------------------


def nothing(*_, **__):
    return []


def otherwise(owner, name, changed):
    """Return a patch whose function gets the original as its first argument."""
    original = getattr(owner, name)
    return patch.object(owner, name, lambda *given, **named: changed(original, *given, **named))


def without_edges():
    """Give pairs at the greatest imaginary part the coordinates of the others."""

    def changed(original, *given):
        point = original(*given)
        return replace(point, edge=np.zeros_like(point.edge))

    return [otherwise(module, "point_of", changed) for module in (box, best_model, search, starts)]


def by_scipy(descent, start, known=(), near=search.NEAR, most_steps=search.MOST_STEPS, to_end=False):
    """Refine by ``scipy.optimize.least_squares`` within the box of the logarithmic coordinates."""
    for _ in range(3):
        begin, seen = descent.local(start), {}

        def factors(x, begin=begin, seen=seen):
            key = x.tobytes()
            if key not in seen:
                here = descent.local(box.moved_by(begin.point, x, descent.box))
                # A few rows with the same cost, gradient and curvature as the residuals.
                values, vectors = np.linalg.eigh(here.curvature)
                roots = np.sqrt(np.maximum(values, 1e-14 * max(values.max(initial=0.0), 1e-300)))
                along = vectors.T @ here.gradient / roots
                rest = np.sqrt(max(here.squared_error - along @ along, 0.0))
                rows = np.vstack((roots[:, None] * vectors.T, np.zeros((1, x.size))))
                seen[key] = np.append(along, rest), rows, here
            return seen[key]

        size = begin.gradient.size
        if not size:
            return begin
        speed, real = begin.point.speed, begin.point.damping < 0
        low, high = [], []
        for w, alone, zeta in zip(speed, real, begin.point.damping, strict=True):
            low += [np.log(descent.box.slowest / w)] + ([] if alone else [np.log(descent.box.least_damping / zeta)])
            high += [np.log(descent.box.fastest / w)] + ([] if alone else [10.0])
        if descent.box.delay_free:
            tau, bounds = begin.point.delay.seconds, np.array(descent.box.delays)
            low, high = (
                [*side, (end - tau) / descent.box.quarter] for side, end in zip((low, high), bounds, strict=True)
            )
        low, high = np.minimum(low, -1e-9), np.maximum(high, 1e-9)
        found = least_squares(
            lambda x: factors(x)[0],
            np.zeros(size),
            lambda x: factors(x)[1],
            (low, high),
            "trf",
            1e-9,
            1e-9,
            1e-10,
            "jac",
            max_nfev=most_steps,
        )
        end = factors(found.x)[2]
        if np.array_equal(end.point.damping < 0, real) and end.squared_error > begin.squared_error * (1 - 1e-6):
            break
        start = end.point
    return end


def variants():
    """Return what is left out: the properties of a problem for which it matters, and the patches."""
    return {
        "nothing": (set(), []),
        "poles by themselves": (
            set(),
            [otherwise(StructureSearch, "_alone", lambda f, s, m, n: f(s, m, n) if n == 1 else [])],
        ),
        "poles added": (set(), [patch.object(StructureSearch, "_grown", nothing)]),
        "delays of the best start": (
            {"delay"},
            [patch.object(StructureSearch, "along_delay", lambda _, __, points, *___: points)],
        ),
        "resonances": ({"fit"}, [patch.object(StructureSearch, "resonances", nothing)]),
        "close delays": ({"fit", "delay", "irregular"}, [patch.object(StructureSearch, "close_delays", nothing)]),
        "cells beside": ({"delay", "regular"}, [patch.object(StructureSearch, "_in_adjacent_cells", nothing)]),
        "random points": (set(), [patch.object(StructureSearch, "random_points", nothing)]),
        "fewer poles": (
            set(),
            [otherwise(best_model, "_least", lambda f, nest, n, m, *_, **__: f(nest, n, m, False))],
        ),
        "coordinates at Nyquist": ({"regular"}, without_edges()),
        "stop where hopeless": (set(), [patch.object(search, "_hopeless", lambda *_: False)]),
        "stop at known minima": (set(), [patch.object(search, "_close", lambda *_: False)]),
        "other side of a sample": ({"delay", "regular"}, [patch.object(Descent, "_faced", lambda _, here: here)]),
        "steps to a sample": (
            {"delay", "regular"},
            [patch.object(Descent, "_whole_and_to_edge", lambda _, __, step: [step])],
        ),
        "our descent (SciPy's instead)": (set(), [patch.object(Descent, "descend", by_scipy)]),
    }


def properties(options, record, way):
    """Return the properties of a problem to which some parts apply."""
    has = {way, "regular" if record.interval else "irregular"}
    low, high = options.delay_bounds
    return has | ({"delay"} if low < high else set())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--records", metavar="FOLDER", help="measured records")
    parser.add_argument("--configs", action="store_true", help="data sets of the useful-redundancy study")
    parser.add_argument("--only", nargs="*", metavar="NAME", help="leave out only these")
    parser.add_argument("--costs", metavar="FILE", type=Path, help="least costs of earlier runs, and of this one")
    parser.add_argument("--seconds", type=float, default=600.0, help="CPU time after which no problem is begun")
    asked = parser.parse_args()
    chosen = {
        name: patches for name, patches in variants().items() if not asked.only or name in ["nothing", *asked.only]
    }
    known = json.loads(asked.costs.read_text()) if asked.costs and asked.costs.exists() else {}
    costs, spent, ways, times = {}, dict.fromkeys(chosen, 0.0), {}, {}
    for name, options, record, way in problems(asked):
        if sum(spent.values()) > asked.seconds:
            break
        has = properties(options, record, way)
        met = {variant: patches for variant, (needs, patches) in chosen.items() if needs <= has}
        if len(met) == 1:
            continue
        costs[name], ways[name] = {}, way
        for variant, patches in met.items():
            with ExitStack() as stack:
                for each in patches:
                    stack.enter_context(each)
                try:
                    seconds, costs[name][variant] = cpu(solved, options, record, way)
                except (DataError, np.linalg.LinAlgError, ValueError, IndexError) as error:
                    seconds, costs[name][variant] = 0.0, np.inf
                    print(f"{name} without {variant}: {error!r}", flush=True)
            spent[variant] += seconds
            times.setdefault(name, seconds)
        least = min(known.get(name, np.inf), *costs[name].values())
        known[name] = least
        above = [f"{v} {c / least - 1:.1e}" for v, c in costs[name].items() if c > least * (1 + TOLERANCE)]
        if above:
            print(
                f"{name} {way} {options.poles}/{options.zeros} {options.delay_bounds}: {'; '.join(above)}", flush=True
            )
    print("| without | problems | above the optimum (fit, orders) | CPU s | with all |\n|---|--:|--:|--:|--:|")
    for variant, seconds in spent.items():
        above = [name for name, each in costs.items() if each.get(variant, 0.0) > known[name] * (1 + TOLERANCE)]
        split = ", ".join(str(sum(ways[name] == way for name in above)) for way in ("fit", "orders"))
        met = [name for name, each in costs.items() if variant in each]
        whole = sum(times[name] for name in met)
        print(f"| {variant} | {len(met)} | {len(above)} ({split}) | {seconds:.1f} | {whole:.1f} |")
    if asked.costs:
        asked.costs.write_text(json.dumps(known))


if __name__ == "__main__":
    main()
