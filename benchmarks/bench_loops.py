"""Plants in closed loops, also unstable ones: convergence and errors. Simulated records, known controller.

    python benchmarks/bench_loops.py [--runs 17] [--seed 1] [--samples 4000] [--paper 60] [--unknown 60]
    python benchmarks/bench_loops.py --unknown-controller [--colour .9 --noise-model arma:1,0] [--runs 17] [--seed 1]
    python benchmarks/bench_loops.py --known controller [--records 300] [--length 600] [--snr-db 15] [--seed 1]

With ``--known`` the plant ``4 exp(-.537 s)/(s^2 + 2.8 s + 4)``, sampled every .1 s in a loop with a PI controller, by
the known part of the loop: ``controller`` and reference (the delay searched in 0 to 2 s, white noise), the
``reference`` (the delay known), or ``nothing`` (the direct method, the delay searched, noise (1 + .5 q^-1)/(1 - 1.5
q^-1 + .7 q^-2) e, which ``--noise-model`` estimates: true, chosen, or too small orders). Errors are in standard
deviations by theory, from the sensitivities at the truth with the record's own signals. Each record is printed to
stderr when it is done.

Without it, first 4/(p^2 - 1) in six loops with PD controllers kp (1 + td (1 - q^-1)/h), at two levels of white output
noise: ``runs`` records of each of the twelve, by ``LoopOutputError``: the number that end CONVERGED with errors, the
coverage of their intervals, and the number of others with an error. With ``--unknown-controller`` the estimator knows
neither reference nor controller, and the noise is first-order autoregressive with the coefficient ``--colour``; that is
all that is printed. Then two modes in the loop of section 6.2 of A.
González et al., *Identification of additive continuous-time systems in open and closed loop*, Automatica (2025),
arXiv:2401.01263, with a delay of .12 s that is searched in 0 to .5 s: errors of the delay and of the modes'
frequencies, compared with CLSRIVC with the known delay. Last the same loop with noise e/(1 - .9 q^-1) of the same
variance, by the known part of the loop: reference and controller, the reference alone, or nothing (the direct method).
"""

import argparse
import sys
from collections import Counter
from dataclasses import replace

from _timing import cpu

import numpy as np
from _table import print_errors
from scipy.signal import lfilter

from ctid_cli import (
    AdditiveModel,
    DataError,
    DelayProfile,
    DiscreteController,
    HeldSignal,
    Loop,
    LoopOutputError,
    Record,
    Rivc,
    Srivc,
    Status,
    Submodel,
    TransferFunction,
    simulate_loop,
)
from ctid_cli.estimation.additive_problem import predicted_from
from ctid_cli.inference.innovations import SampledNoise, steps_of
from ctid_cli.inference.sensitivities import sensitivities
from ctid_cli.models.factoring import unfactored
from ctid_cli.signals.noise import ArmaNoise, stream

LOOPS = ((0.05, 1, 0.5, 1), (0.1, 1, 0.3, 1), (0.05, 1, 0.5, 10), (0.01, 2, 0.3, 10), (0.05, 0.5, 0.6, 1))
LOOPS += ((0.02, 1, 0.5, 10),)
UNSTABLE = TransferFunction([4.0], [1.0, 0.0, -1.0])
MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])], 0.12)
PID, INTERVAL = DiscreteController([0.02329, -0.02058, 0.00454], [1.0, -1.0, 0.0]), 0.05
#: Loop of the campaigns: plant, its parameters, controller and sampling interval; C and D of the coloured noise.
LATE, DELAYS = TransferFunction([4.0], [1.0, 2.8, 4.0], 0.537), (0.0, 2.0)
TRUE = np.array([2.8, 4.0, 4.0, 0.537])
PI, STEP, HELD = DiscreteController([0.5, -0.47], [1.0, -1.0]), 0.1, 5
COLOURED = (1.0, 0.5), (1.0, -1.5, 0.7)


def looped(plant, law, r, v, interval):
    u, x = simulate_loop(plant, law, r, v, interval)
    t = interval * np.arange(r.size)
    return Record(t, x + v, HeldSignal(t, u), loop=Loop(r, law))


def unstable_record(loop, noise, samples, rng, colour=0.0):
    h, kp, td, hold = loop
    law = DiscreteController.from_pid(kp, 0.0, kp * td / h)
    r = np.repeat(rng.standard_normal(samples // hold), hold)
    v = np.sqrt(1.0 - colour**2) * lfilter([1.0], [1.0, -colour], rng.standard_normal(r.size))
    return looped(UNSTABLE, law, r, noise * v, h)


def covered(fit, truth):
    names = [name for name in truth if name in fit.parameters]
    return [abs(fit.parameters[n] - truth[n]) <= fit.quantiles[n] * fit.standard_errors[n] for n in names]


def six_loops(runs, samples, seed, unknown=False, noise_model="white", colour=0.0):
    truth, estimator = {"a1": 0.0, "a2": -1.0, "b0": 4.0}, LoopOutputError(2, 0, noise_model=noise_model)
    print("4/(p^2 - 1)                       converged  other with error  a1, a2, b0 covered [%]  CPU s a record")
    total, wrong, hits, time, scaled = 0, 0, [], 0.0, []
    for noise in (0.02, 0.1):
        for k, loop in enumerate(LOOPS):
            rng, own, others = np.random.default_rng([seed, k, int(1000 * noise)]), [], 0
            spent = 0.0
            for _ in range(runs):
                record = unstable_record(loop, noise, samples, rng, colour)
                if unknown:
                    record = replace(record, loop=None, feedback=True)
                taken, fit = cpu(estimator.fit, record)
                spent += taken
                errors = np.array(list(fit.standard_errors.values()))
                if fit.status is Status.CONVERGED and np.isfinite(errors).all():
                    own.append(covered(fit, truth))
                    scaled.append([(fit.parameters[n] - value) / fit.standard_errors[n] for n, value in truth.items()])
                else:
                    others += bool(np.isfinite(errors).any())
            shares = " ".join(f"{100 * share:5.1f}" for share in np.mean(own, axis=0))
            counts = f"{len(own):4} of {runs:3} {others:10}"
            print(f"{loop!s:24} noise {noise:<5} {counts}          {shares} {spent / runs:15.2f}")
            total, wrong, hits, time = total + len(own), wrong + others, hits + own, time + spent
    shares = " ".join(f"{100 * share:.1f}" for share in np.mean(hits, axis=0))
    print(f"all: {total} of {12 * runs} converged, {wrong} others with an error, {shares} % covered, {time:.0f} CPU s")
    bias, scatter = np.mean(scaled, axis=0) * np.sqrt(total), np.std(scaled, axis=0)
    print(f"bias in Monte Carlo errors {bias.round(2)}, deviation over standard error {scatter.round(2)}")


def frequencies(model):
    """Return the natural frequencies of the two pairs, or NaN if there are not two."""
    upper = np.sort(np.abs([pole for pole in model.poles if pole.imag > 0]))
    return upper if upper.size == 2 else np.full(2, np.nan)


def paper_loop(runs, seed, coloured):
    truth = np.array([MODES.delay, *frequencies(unfactored(MODES))])
    ways = {
        "loop, delay 0:.5": lambda record: LoopOutputError(4, 2, (0.0, 0.5)).fit(record),
        "CLSRIVC, known delay": lambda record: Srivc(4, 2, MODES.delay, instruments="closed_loop").fit(record),
    }
    if coloured:
        ways = {
            "reference and controller": lambda record: LoopOutputError(4, 2, (MODES.delay,) * 2).fit(record),
            "reference": lambda record: Srivc(4, 2, MODES.delay, instruments="reference").fit(record),
            "nothing: direct": lambda record: DelayProfile(4, 2, (MODES.delay,) * 2).fit(record),
        }
    found, converged, times = {way: [] for way in ways}, dict.fromkeys(ways, 0), dict.fromkeys(ways, 0.0)
    rng = np.random.default_rng([seed, coloured])
    for _ in range(runs):
        r, e = rng.standard_normal((2, 3140))
        if coloured:
            for k in range(1, e.size):
                e[k] += 0.9 * e[k - 1]
            e *= np.sqrt(1 - 0.81)
        record = looped(MODES, PID, r, 0.1 * e, INTERVAL)
        for way, fit in ways.items():
            try:
                taken, one = cpu(fit, record)
            except DataError:
                continue
            times[way] += taken
            if one.status is Status.CONVERGED:
                converged[way] += 1
                found[way].append([one.model.delay, *frequencies(one.model)])
    title = "noise e/(1 - .9 q^-1)" if coloured else "white noise"
    print(f"\nloop of section 6.2, {title}, N 3140: bias and deviation of the delay [s], both frequencies [rad/s]")
    for way, values in found.items():
        errors = np.array(values) - truth
        errors = errors[np.isfinite(errors).all(axis=1)]
        bias, spread = errors.mean(axis=0), errors.std(axis=0)
        text = "  ".join(f"{b:9.5f} {s:8.5f}" for b, s in zip(bias, spread, strict=True))
        counts = f"{converged[way]:4} of {runs} converged, {len(errors):4} with two pairs"
        print(f"{way:25} {counts}: {text}  {times[way] / runs:.2f} CPU s")


def theory_with_controller(record, variance, v):
    """Return the covariance for the criterion ``y - T r``: the noise passes through the loop, ``S v``."""
    problem = LoopOutputError(2, 0, DELAYS).prepare(record).laid_out.problem
    psi = problem.response.rows(TRUE, TRUE.size, problem.cell_of(TRUE[-1])).slopes * problem.data.use[:, None]
    # The transposed loop runs backwards in time.
    zero = np.zeros(len(psi))
    back = [(simulate_loop(LATE, PI, zero, column, STEP).x + column)[::-1] for column in psi[::-1].T]
    inverse = np.linalg.inv(psi.T @ psi)
    return variance * inverse @ np.inner(back, back) @ inverse


def theory_with_reference(record, variance, v):
    """Return the covariance of instrumental variables made of the part of the input that follows the reference."""
    predicted = predicted_from(record.loop.reference, record.input.values)
    psi, instruments = (
        sensitivities(LATE, HeldSignal(record.t, u), record.t)[record.t >= LATE.delay]
        for u in (record.input.values, predicted)
    )
    inverse = np.linalg.inv(instruments.T @ psi)
    return variance * inverse @ (instruments.T @ instruments) @ inverse.T


def theory_of_the_direct_method(record, variance, v):
    """Return the plant's Cramér-Rao bound with unknown noise coefficients, which in a loop are not independent."""
    used, free = record.t >= DELAYS[1], np.array([*COLOURED[0][1:], *COLOURED[1][1:]])
    split, steps = len(COLOURED[0]) - 1, steps_of(used)

    def whitened(coefficients, columns):
        c, d = ((1.0, *part) for part in np.split(coefficients, [split]))
        return SampledNoise(ArmaNoise(c, d, innovation_variance=1.0), steps).whitened(columns)

    of_plant = whitened(free, sensitivities(LATE, record.input, record.t, estimate_delay=True)[used])
    units = 1e-5 * np.eye(free.size)
    of_noise = [(whitened(free - unit, v[used]) - whitened(free + unit, v[used])) / 2e-5 for unit in units]
    J = np.column_stack((of_plant, *of_noise))
    return variance * np.linalg.inv(J.T @ J)[: TRUE.size, : TRUE.size]


def campaign(given):
    """Print the table of one known part of the loop."""
    coloured, names = given.known == "nothing", ("a1", "a2", "b0", "delay")[: 3 if given.known == "reference" else 4]
    truth = dict(zip(names, TRUE, strict=False))
    estimator, theory = {
        "controller": (LoopOutputError(2, 0, DELAYS), theory_with_controller),
        "reference": (Srivc(2, 0, LATE.delay, instruments="reference"), theory_with_reference),
        "nothing": (Rivc(2, 0, DELAYS, noise_model=given.noise_model), theory_of_the_direct_method),
    }[given.known]
    law = ArmaNoise(*(COLOURED if coloured else ((1.0,), (1.0,))), snr_db=given.snr_db)
    errors, hits, ends, orders, spent = [], [], Counter(), Counter(), 0.0
    for k in range(given.records):
        r = np.repeat(stream(given.seed, "input", k).choice([-1.0, 1.0], given.length // HELD + 1), HELD)[
            : given.length
        ]
        noise_free = simulate_loop(LATE, PI, r, 0.0, STEP).x
        v = law.generate(noise_free, stream(given.seed, "noise", k))
        record = looped(LATE, PI, r, v, STEP)
        if given.known == "reference":
            record = Record(record.t, record.y, record.input, loop=Loop(r, None))
        elif coloured:
            record = Record(record.t, record.y, record.input, feedback=True)
        taken, fit = cpu(estimator.fit, record)
        deviations = np.sqrt(np.diag(theory(record, law.innovation_variance_of(noise_free), v)))
        found = np.array([fit.parameters[name] - value for name, value in truth.items()])
        errors.append(found / deviations[: found.size])
        # A fit whose residuals are not white has no intervals with the direct method.
        if np.isfinite(list(fit.standard_errors.values())).all():
            hits.append(np.array(covered(fit, truth)))
        ends[fit.status.name] += 1
        orders[getattr(getattr(fit, "noise", None), "orders", None)] += 1
        spent += taken
        print(k, f"{taken:.2f}", *errors[-1], file=sys.stderr, flush=True)
    print(" ".join(f"{name}={value}" for name, value in vars(given).items()))
    print_errors(names, errors, hits)
    ending = f"{len(errors) - len(hits)} without intervals, ends {dict(ends)}, noise {dict(orders.most_common(4))}"
    print(f"{ending}, {spent / given.records:.2f} CPU s a record")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--known", choices=("controller", "reference", "nothing"))
    parser.add_argument("--snr-db", type=float, default=15.0)
    parser.add_argument("--noise-model", default="arma:2,1")
    parser.add_argument("--unknown-controller", action="store_true")
    parser.add_argument("--colour", type=float, default=0.0)
    for name, value in (("records", 300), ("length", 600)):
        parser.add_argument(f"--{name}", type=int, default=value)
    for name, value in (("runs", 17), ("seed", 1), ("samples", 4000), ("paper", 60), ("unknown", 60)):
        parser.add_argument(f"--{name}", type=int, default=value)
    given = parser.parse_args()
    if given.known:
        campaign(given)
        raise SystemExit
    if given.unknown_controller:
        noise_model = given.noise_model if given.colour else "white"
        six_loops(given.runs, given.samples, given.seed, True, noise_model, given.colour)
        raise SystemExit
    six_loops(given.runs, given.samples, given.seed)
    for count, coloured in ((given.paper, False), (given.unknown, True)):
        if count:
            paper_loop(count, given.seed, coloured)
