"""Distance of estimates from the optimum: random systems against an independent optimiser in the same box.

    python benchmarks/bench_optimum.py [--systems 100] [--seed 1] [--starts 3] [--likes] [--records FOLDER]
    python benchmarks/bench_optimum.py --two-inputs 300 --starts 200

For each system the least output error of ``DelayProfile`` is compared with what ``scipy.optimize`` reaches
from the true poles, from random ones, and from ctid's own estimate: variable projection on columns of modal responses,
Jacobians by differences. The peer knows the truth and ctid does not. A line is printed for each system with ctid above
the peer by more than a millionth, and a summary at the end.

``--likes`` adds two kinds of systems at the border of the admissible models, a lightly damped mode in a periodic record
and an integrating drive at rest: their cost is also compared with that in a set without such bounds. ``--records`` adds
measured records, CSV files with columns t, u and y named in YAML files next to them, with four structures each.

``--two-inputs`` has systems with two inputs, each of order 1 or 2 with a delay of 0 to 20 samples, PRBS, 15 dB, both
delays searched. The peer consists of ctid's descents from random poles and delays in the same box, and from the truth:
each until a step promises less than a thousandth, and those within a tenth of ctid's squared error to the end.
"""

import argparse
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

from _timing import cpu

import numpy as np
import yaml
from numba import njit
from scipy.optimize import least_squares

from ctid_cli import DataError, DelayProfile, HeldSignal, InputModel, Prbs, Record, TransferFunction, simulate
from ctid_cli.estimation.optimum.box import point_of
from ctid_cli.estimation.optimum.search import Descent
from ctid_cli.signals.measurement import read_measurement

TOLERANCE = 1e-6
#: Poles whose distances, as fractions of their magnitudes, have a smaller product are left out by the peer.
CLOSE = 3e-4
#: Slowest pole times the record's length, and least damping, of a set without effective bounds.
NEARLY_ZERO = 1e-6
#: Descents of the peer end first if a step promises this relative decrease, and go on if their squared error is below
#: this multiple of that of ctid.
NEARLY, COMPETITIVE = 1e-3, 1.1
#: Poles and zeros tried on measured records, most of their samples, and the treatment of each: state, offset, delays.
STRUCTURES, MOST = ((1, 0), (2, 1), (3, 2), (4, 3)), 4000
OTHERWISE = ("estimate", "estimate", (0.0, 0.0))
TREATMENTS = {
    "case1_seed0": ("rest", "none", (7.5, 8.5)),
    "daisy_dryer": ("estimate", "estimate", (0.0, 0.5)),
    "daisy_heating": ("estimate", "estimate", (0.0, 10.0)),
    "gas_furnace": ("estimate", "estimate", (0.0, 45.0)),
    "pt326_est": ("estimate", "none", (0.0, 1.0)),
    "pt326_val": ("rest", "none", (0.5, 0.5)),
    "tclab_step_100": ("estimate", "none", (0.0, 0.0)),
    "tclab_step_irregular": ("rest", "estimate", (0.0, 0.0)),
}


# --- the peer ----------------------------------------------------------------------------------------


@njit(cache=True)
def grown(p, length):
    """Return (exp(p t) - 1)/p, also for poles at the origin."""
    z = p * length
    if abs(z) < 1e-3:
        return length * (1 + z / 2 * (1 + z / 3 * (1 + z / 4 * (1 + z / 5))))
    return (np.exp(z) - 1.0) / p


@njit(cache=True)
def modal_responses(poles, tu, u, t, delay, period):
    """Return the responses of 1/(s - p) to a held input at the samples, at rest before or periodic."""
    out = np.empty((t.size, poles.size), np.complex128)
    edges = tu + delay
    for k in range(poles.size):
        p, v = poles[k], 0.0 + 0.0j
        for lap in range(2 if period > 0 else 1):
            if period > 0:
                # Up to the first sample, the last input of the previous period is still held.
                begin = t[0]
                j = -1
                shift = 0.0
                while edges[0] + shift > begin:
                    shift -= period
                while j + 1 < tu.size and edges[j + 1] + shift <= begin:
                    j += 1
            else:
                begin, j, shift = edges[0], 0, 0.0
                if edges[0] > t[0]:
                    begin, j = t[0], -1
            now, i = begin, 0
            start = v
            last = t[0] + period if period > 0 else t[-1]
            while True:
                following = edges[j + 1] + shift if j + 1 < tu.size else np.inf
                if j + 1 == tu.size and period > 0:
                    following = edges[0] + shift + period
                target = min(following, t[i] if i < t.size else np.inf)
                target = min(target, last)
                held = u[j] if j >= 0 else 0.0
                e = np.exp(p * (target - now))
                v = e * v + grown(p, target - now) * held
                now = target
                if i < t.size and now == t[i]:
                    out[i, k] = v
                    i += 1
                if now == following:
                    j += 1
                    if j == tu.size:
                        j, shift = 0, shift + period
                if (period > 0 and now >= last) or (period == 0.0 and i == t.size):
                    break
            if period > 0 and lap == 0:
                v = (v - start * np.exp(p * period)) / (-p * grown(p, period))
    return out


class Peer:
    """Squared error over poles and delay, with all linear parameters eliminated."""

    def __init__(self, record, options, box):
        self.record, self.options, self.box = record, options, box
        first = record.input.t[0] + (options.delay_bounds[1] if options.initial_state == "estimate" else 0.0)
        self.use = record.t >= first - 1e-9
        periodic = options.initial_state == "periodic"
        self.period = record.duration + (record.interval or float(np.median(np.diff(record.t)))) if periodic else 0.0
        low, high = options.delay_bounds
        self.free_delay = low < high

    def residual(self, poles, delay):
        t, u = self.record.t, self.record.input
        middle = np.exp(np.mean(np.log(np.abs(poles)))) if poles.size else 1.0
        poles = np.append(poles, np.zeros(self.options.integrators))
        v = modal_responses(poles, u.t, u.values, t, delay, self.period)[self.use]
        columns = []
        slopes = np.array([np.prod(np.delete(p - poles, k)) for k, p in enumerate(poles)])
        for power in range(self.options.zeros + 1):
            columns.append((v @ ((poles / middle) ** power / slopes)).real)
        used = t[self.use]
        if self.options.initial_state == "estimate":
            free = np.exp(np.outer(used - used[0], poles))
            columns += [(free @ ((poles / middle) ** k / slopes)).real for k in range(poles.size)]
        if self.options.offset == "estimate":
            columns.append(np.ones(used.size))
        phi, y = np.column_stack(columns), self.record.y[self.use]
        phi = phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
        apart = np.abs(poles[:, None] - poles) / (np.abs(poles[:, None]) + np.abs(poles) + 1e-300)
        np.fill_diagonal(apart, 1.0)
        if not np.isfinite(phi).all() or apart.prod(axis=1).min() < CLOSE:
            # Coinciding poles have no separate modal responses, and those of close ones are rounding.
            return y
        return y - phi @ np.linalg.lstsq(phi, y, rcond=1e-13)[0]

    def polished(self, poles, delay):
        """Return the least squared error from given poles and delay, within the box."""
        pairs, reals = poles[poles.imag > 0], -poles[poles.imag == 0].real
        n, r, box = pairs.size, reals.size, self.box
        frequencies = np.log(np.concatenate((np.abs(pairs), reals)))
        start, low, high = [frequencies], [np.full(n + r, np.log(box.slowest))], [np.full(n + r, np.log(box.fastest))]
        start.append(np.log(-pairs.real / np.abs(pairs)))
        low.append(np.full(n, np.log(box.least_damping)))
        high.append(np.zeros(n))
        scale = np.ones(2 * n + r + self.free_delay)
        if self.free_delay:
            start.append(np.array([delay]))
            low.append(self.options.delay_bounds[:1])
            high.append(self.options.delay_bounds[1:])
            scale[-1] = box.quarter
        low, high = np.concatenate(low), np.concatenate(high)

        def residual(x):
            w, zeta = np.exp(x[:n]), np.minimum(np.exp(x[n + r : 2 * n + r]), 1 - 1e-9)
            upper = w * (-zeta + 1j * np.minimum(np.sqrt(1 - zeta**2), box.imaginary / w))
            roots = np.concatenate((upper, upper.conj(), -np.exp(x[n : n + r]))).astype(complex)
            return self.residual(roots, float(x[-1]) if self.free_delay else delay)

        begin = np.clip(np.concatenate(start), low + 1e-12, high - 1e-12)
        ends = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-14, "max_nfev": 150}
        return 2.0 * least_squares(residual, begin, bounds=(low, high), x_scale=scale, **ends).cost


# --- systems -----------------------------------------------------------------------------------------


def random_case(rng):
    """Return a record, its true model, and the options for it."""
    n = int(rng.integers(1, 9))
    samples = int(np.exp(rng.uniform(np.log(80), np.log(20000) if rng.random() < 0.15 else np.log(2500))))
    treatment = str(rng.choice(["rest", "estimate", "periodic"], p=[0.5, 0.3, 0.2]))
    offset = "estimate" if rng.random() < 0.3 else "none"
    n = min(n, max(1, (samples // 10 - 3) // (3 if treatment == "estimate" else 2)))
    h = 10.0 ** rng.uniform(-3, 1)
    poles = []
    while len(poles) < n:
        w = np.exp(rng.uniform(np.log(6 / (samples * h)), np.log(1.0 / h)))
        kind = rng.choice(["real", "pair", "light", "close"])
        if kind in ("pair", "light") and n - len(poles) >= 2:
            zeta = rng.uniform(0.1, 0.95) if kind == "pair" else 10 ** rng.uniform(-2, -1)
            poles += [w * complex(-zeta, s * np.sqrt(1 - zeta**2)) for s in (1, -1)]
        elif kind == "close" and n - len(poles) >= 2:
            poles += [complex(-w), complex(-w * 1.1)]
        else:
            poles.append(complex(-w))
    poles = np.array(poles)
    zeros = int(rng.integers(0, min(n, 4)))
    middle = np.exp(np.mean(np.log(np.abs(poles))))
    b = np.atleast_1d(np.poly(-middle * np.exp(rng.uniform(-1.5, 1.5, zeros)) * rng.choice([1, -1], zeros)))
    a = np.real(np.poly(poles))
    b = b / b[-1] * a[-1]
    kind = rng.choice(["none", "known", "searched"])
    delay = 0.0 if kind == "none" else float(rng.uniform(0, 8 * h))
    bounds = (delay, delay) if kind != "searched" else (0.0, 12 * h)
    t = h * np.arange(samples)
    if rng.random() < 0.3 and treatment != "periodic":
        t = np.concatenate(([0.0], np.cumsum(h * rng.uniform(0.3, 1.7, samples - 1))))
    hold = int(rng.integers(1, max(2, samples // 20)))
    u = np.repeat(rng.choice([-1.0, 1.0], samples // hold + 1), hold)[:samples]
    held = HeldSignal(t, u)
    model = TransferFunction(b, a, delay)
    period = samples * h if treatment == "periodic" else 0.0
    v = modal_responses(poles, t, u, t, delay, period)
    slopes = np.array([np.prod(np.delete(p - poles, k)) for k, p in enumerate(poles)])
    x = (v @ (np.polyval(b, poles) / slopes)).real
    if treatment == "estimate":
        size = rng.standard_normal() * np.std(x) / np.abs(1 / slopes).sum()
        x = x + size * (np.exp(np.outer(t, poles)) @ (1 / slopes)).real
    x = x + (rng.uniform(-2, 2) * np.std(x) if offset == "estimate" else 0.0)
    e = rng.standard_normal(samples)
    if rng.random() < 0.3:
        for k in range(1, samples):
            e[k] += 0.8 * e[k - 1]
    y = x + e / e.std() * x.std() * 10 ** (-rng.uniform(5, 40) / 20)
    options = DelayProfile(n, zeros, bounds, initial_state=treatment, offset=offset)
    return Record(t, y, held), model, options


def random_poles(rng, n, slowest, fastest, least_damping):
    pairs = int(rng.integers(0, n // 2 + 1))
    w = np.exp(rng.uniform(np.log(slowest), np.log(fastest), n - pairs))
    zeta = np.exp(rng.uniform(np.log(least_damping), np.log(0.95), pairs))
    upper = w[:pairs] * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return np.concatenate((upper, upper.conj(), -w[pairs:])).astype(complex)


def lightly_damped(rng):
    """Return a periodic record of a mode with a damping of .0005, one sixth of the samples per radian."""
    samples, w, zeta = 2000, 0.6, 5e-4
    t, lines = np.arange(float(samples)), np.arange(1, samples // 3)
    angles = 2 * np.pi / samples * np.outer(t, lines) + rng.uniform(0, 2 * np.pi, lines.size)
    poles = w * np.array([complex(-zeta, side * np.sqrt(1 - zeta**2)) for side in (1, -1)])
    return finished(rng, np.cos(angles).sum(axis=1), poles, 20.0, "periodic")


def integrating(rng):
    """Return a record of a drive from rest: an integrator behind a lag of eight samples, under random steps."""
    u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
    return finished(rng, u, np.array([-0.125, 0.0], dtype=complex), 40.0, "rest")


def finished(rng, u, poles, snr_db, state):
    t = np.arange(float(u.size))
    slopes = np.array([np.prod(np.delete(p - poles, k)) for k, p in enumerate(poles)])
    x = (modal_responses(poles, t, u, t, 0.0, float(u.size) * (state == "periodic")) @ (1 / slopes)).real
    y = x + x.std() * 10 ** (-snr_db / 20) * rng.standard_normal(u.size)
    return Record(t, y, HeldSignal(t, u)), TransferFunction([1.0], np.poly(poles).real), state


def measured(folder):
    """Return names and records that the YAML files of a folder describe."""
    for described in sorted(Path(folder).glob("*.yaml")):
        about = yaml.safe_load(described.read_text())
        if "file" not in about or "u" not in about.get("columns", "tuy"):
            continue
        columns = {"time": "t", "input": "u", "output": "y"}
        whole = read_measurement(described.parent / about["file"], **columns, hold="zoh").record
        t, u, y = (values[:MOST] for values in (whole.t - whole.t[0], whole.input.values, whole.y))
        yield described.stem, Record.from_arrays(t, u, y)


# --- comparisons -------------------------------------------------------------------------------------


def reached_from(peer, starts, ours):
    """Return the peer's least squared errors over ours, less one, by start."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {name: peer.polished(*start) / ours - 1 for name, start in starts.items()}


def starts_of(rng, record, options, fit, count):
    """Return ctid's own estimate, and random starts, alternately from the well determined and from the whole set."""
    starts, box = {"ctid's own": (fit.model.poles, fit.model.delay)}, fit.box
    for k in range(count):
        slowest, damping = (box.slowest, box.least_damping) if k % 2 else (1.0 / record.duration, 0.01)
        delay = float(rng.uniform(*options.delay_bounds))
        poles = random_poles(rng, options.poles, slowest, min(box.fastest, box.imaginary), damping)
        starts[f"random start {k}"] = (poles, delay)
    return starts


def compared(number, rng, peer_starts):
    """Return the status of ctid's estimate for one system, its squared error over the peer's, and remarks."""
    record, truth, options = random_case(rng)
    spent, fit = cpu(options.fit, record)
    ours, peer = fit.cost * fit.count, Peer(record, options, fit.box)
    here = peer.residual(fit.model.poles, fit.model.delay)
    starts = {"the truth": (truth.poles, truth.delay)} | starts_of(rng, record, options, fit, peer_starts)
    reached = reached_from(peer, starts, ours)
    least = min(reached, key=reached.get)
    clock = "regular" if record.interval else "irregular"
    said = (
        f"{number}: {options.poles}/{options.zeros}, {record.n_samples} samples, {clock}, "
        f"delay {options.delay_bounds}, state {options.initial_state}, offset {options.offset}: {fit.status.name}, "
        f"{fit.starts.agree} of {fit.starts.tried} starts, {spent:.1f} s; best of the peer {reached[least]:+.1e} from "
        f"{least}, truth {reached['the truth']:+.1e}, the same model {float(here @ here) / ours - 1:+.1e}"
    )
    return fit.status.name, reached, spent, said


def tabulated(name, record, options, rng, count, truth=None):
    """Return a line of the table: one structure on one record."""
    spent, fit = cpu(options.fit, record)
    ours, peer = fit.cost * fit.count, Peer(record, options, fit.box)
    reached = reached_from(peer, starts_of(rng, record, options, fit, count), ours)
    least = min(reached, key=reached.get)
    text = f"{name:22}{options.poles}/{options.zeros}  {options.initial_state:9}{options.offset:9}"
    text += f"{fit.status.name:15}{fit.cost:14.8g}{-reached[least]:+11.1e} {least:15}{spent:8.2f}"
    if truth is not None:
        # Bounds that do not act near the truth.
        wide = replace(fit.box, slowest=NEARLY_ZERO / record.duration, least_damping=NEARLY_ZERO)
        peer = Peer(record, options, wide)
        text += f"{1 / (1 + reached_from(peer, {'': (truth.poles, truth.delay)}, ours)['']):12.5g}"
    print(text, flush=True)
    return reached[least] < -TOLERANCE


def two_inputs(rng):
    """Return a record with two inputs, and their true models."""
    orders, h, samples = rng.integers(1, 3, 2), 0.1, 600
    t, models, inputs = h * np.arange(samples), [], {}
    for k, n in enumerate(orders):
        w = np.exp(rng.uniform(np.log(0.3), np.log(5.0), n))
        zeta = rng.uniform(0.1, 1.0)
        a = [1.0, w[0]] if n == 1 else [1.0, 2 * zeta * w[0], w[0] ** 2]
        models.append(
            TransferFunction([rng.choice([-1, 1]) * rng.uniform(0.5, 2.0) * a[-1]], a, rng.uniform(0, 20 * h))
        )
        signal = Prbs(10 + k, h * int(rng.integers(2, 8))).generate(t, rng)
        inputs[f"u{k + 1}"] = HeldSignal(t, signal.at(t))
    x = sum(simulate(model, signal, t) for model, signal in zip(models, inputs.values(), strict=True))
    return Record(t, x + x.std() * 10 ** (-15 / 20) * rng.standard_normal(samples), inputs), models


def two_inputs_compared(number, rng, count):
    """Return CPU time of a fit with two inputs, and the differences of the least descent and of that from the truth."""
    record, models = two_inputs(rng)
    own = tuple(InputModel(name, poles=m.order) for name, m in zip(record.held, models, strict=True))
    prepared = DelayProfile(max(m.order for m in models), 0, (0.0, 2.0), inputs=own).prepare(record)
    spent, fit = cpu(prepared.fit)
    problem = prepared.laid_out.problem
    starts = [(np.concatenate([m.poles for m in models]), [m.delay for m in models])]
    for _ in range(count):
        poles = [random_poles(rng, m.order, fit.box.spread[0], fit.box.fastest, fit.box.spread[1]) for m in models]
        starts.append((np.concatenate(poles), rng.uniform(0.0, 2.0, 2).tolist()))
    descent, ours = Descent(problem, fit.box), fit.cost * fit.count
    ends = []
    for poles, delays in starts:
        local = descent.descend(point_of(poles, delays, fit.box), (), NEARLY)
        if local.squared_error < COMPETITIVE * ours:
            local = descent.descend(local.point)
        ends.append(local.squared_error)
    return spent, min(ends) / ours - 1.0, ends[0] / min(ends) - 1.0


def table(asked):
    """Print the records at the border of the set and the measured ones; return how many are above the peer."""
    print(
        f"{'record':22}{'p/z':5}{'state':9}{'offset':9}{'status':15}{'cost':>14}{'above peer':>11} "
        f"{'peer best from':15}{'CPU s':>8}{'over open':>12}"
    )
    above = []
    if asked.likes:
        for name, like in (("lightly damped mode", lightly_damped), ("integrating drive", integrating)):
            for zeros in (0, 1):
                rng = np.random.default_rng([asked.seed, zeros])
                record, truth, state = like(rng)
                options = DelayProfile(2, zeros, (0.0, 0.0), initial_state=state)
                above.append(tabulated(name, record, options, rng, asked.starts, truth))
    for name, record in measured(asked.records) if asked.records else ():
        state, offset, delays = TREATMENTS.get(name, OTHERWISE)
        for n, m in STRUCTURES:
            options = DelayProfile(n, m, delays, initial_state=state, offset=offset)
            try:
                above.append(tabulated(name, record, options, np.random.default_rng([asked.seed, n]), asked.starts))
            except DataError as error:
                print(f"{name:22}{n}/{m}  refused: {error}", flush=True)
    print(f"{len(above)} fits: above the peer in {sum(above)}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first system")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--starts", type=int, default=3, help="random starts of the peer")
    parser.add_argument("--verbose", action="store_true", help="a line for each system")
    parser.add_argument("--two-inputs", type=int, default=0, help="systems with two inputs, in place of the others")
    parser.add_argument("--likes", action="store_true", help="systems at the border of the admissible models")
    parser.add_argument("--records", metavar="FOLDER", help="measured records")
    asked = parser.parse_args()
    warnings.simplefilter("error")
    if asked.likes or asked.records:
        table(asked)
    above = 0
    for number in range(asked.first, asked.first + asked.two_inputs):
        spent, least, truth = two_inputs_compared(number, np.random.default_rng([asked.seed, number]), asked.starts)
        above += least < -TOLERANCE
        print(
            f"two inputs {number}: {spent:.1f} CPU s, best descent {least:+.1e}, truth above it {truth:+.1e}",
            flush=True,
        )
    if asked.two_inputs:
        print(f"{asked.two_inputs} systems with two inputs: above the best descent in {above}")
        return
    if not asked.systems:
        return
    statuses, above, truth_missed, seconds = Counter(), 0, 0, 0.0
    for number in range(asked.first, asked.first + asked.systems):
        try:
            status, reached, spent, said = compared(number, np.random.default_rng([asked.seed, number]), asked.starts)
        except DataError as error:
            statuses["refused"] += 1
            print(f"{number}: refused: {error}", flush=True)
            continue
        statuses[status] += 1
        seconds += spent
        beaten = min(reached.values()) < -TOLERANCE
        above += beaten
        truth_missed += reached["the truth"] > TOLERANCE
        if beaten or asked.verbose:
            print(f"{'ABOVE ' if beaten else ''}{said}", flush=True)
    print(
        f"{asked.systems} systems: above the peer in {above}; below what the peer reaches from the truth in "
        f"{truth_missed}; {dict(statuses)}; {seconds:.0f} CPU s"
    )


if __name__ == "__main__":
    main()
