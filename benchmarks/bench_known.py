"""Fits with known coefficients: distance from the optimum. Random systems against SLSQP from 200 random starts.

    python benchmarks/bench_known.py [--systems 300] [--seed 1] [--starts 200] [--refined 30] [--all-refined 30]

Systems of order 1 to 4 (300 to 600 samples, a third of them irregular, with and without offset, initial state and
delay) have one or two coefficients fixed, at their true values or off by 20 %. The least output error of
``DelayProfile(fixed=...)``, and of the same fit with nothing fixed, is compared with the least that
``scipy.optimize.minimize(method="SLSQP")`` reaches in the same box of admissible poles and delays: from random starts
moved onto the constraint (the best of them are refined, all of them for every tenth system), from the free optimum
moved there, and from the true poles. The peer shares no code with ctid: responses are sums over poles, gradients exact,
numerator, free response and offset are eliminated by dense least squares. A line is printed for each fit above the peer
by more than a millionth, and a summary at the end.
"""

import argparse
import warnings
from collections import Counter

from _timing import cpu

import numpy as np
from bench_optimum import modal_responses
from numba import njit
from scipy.optimize import minimize

from ctid_cli import DataError, DelayProfile, Fixed, HeldSignal, Record, TransferFunction

TOLERANCE = 1e-6
#: Largest error in ln(a_i) of a peer's model that counts as having the known coefficients.
FEASIBLE = 1e-12


# --- the peer ----------------------------------------------------------------------------------------


@njit(cache=True)
def modal_slopes(poles, tu, u, t, delay, delayed):
    """Return the responses of 1/(s - p) to a held input from rest, and their derivatives to p and to the delay."""
    out = np.zeros((3, t.size, poles.size), np.complex128)
    edges = tu + delay
    for k in range(poles.size):
        p, v, dv = poles[k], 0.0 + 0.0j, 0.0 + 0.0j
        now, j, held = edges[0], -1, 0.0
        for i in range(t.size):
            while True:
                following = edges[j + 1] if j + 1 < tu.size else np.inf
                target = min(following, t[i])
                if target > now:
                    step = target - now
                    e = np.exp(p * step)
                    dv = e * (dv + step * v) + held * (step * e / p - (e - 1.0) / (p * p))
                    v = e * v + (e - 1.0) / p * held
                    now = target
                if following > t[i]:
                    break
                j += 1
                held = u[j]
            out[0, i, k], out[1, i, k] = v, dv
            # x(t - tau): its derivative to tau is -x'.
            out[2, i, k] = -(p * v + held)
    return out


class Peer:
    """Squared error and its gradient over poles and delay, with all linear parameters eliminated."""

    def __init__(self, record, options, box, fixed):
        self.record, self.options, self.box = record, options, box
        estimated = options.initial_state == "estimate"
        self.use = record.t >= record.input.t[0] + (options.delay_bounds[1] if estimated else 0.0) - 1e-9
        self.free_delay = options.delay_bounds[0] < options.delay_bounds[1]
        n = options.poles
        self.known_a = {int(name[1:]) - 1: value for name, value in fixed.items() if name[0] == "a"}
        self.known_b = {int(name[1:]): value for name, value in fixed.items() if name[0] == "b"}
        self.n, self.m = n, options.zeros
        self.evaluations = 0

    def value(self, poles, delay, slopes=True):
        """Return the squared error, its derivatives to the poles (complex) and to the delay."""
        self.evaluations += 1
        t, u = self.record.t, self.record.input
        v, dv, rate = (part[self.use] for part in modal_slopes(poles, u.t, u.values, t, delay, slopes))
        # Residues of p^k/A, k = m ... 0, and differences of poles.
        gaps = poles[:, None] - poles[None, :]
        np.fill_diagonal(gaps, 1.0)
        weights = 1.0 / np.prod(gaps, axis=1)
        powers = poles[:, None] ** np.arange(self.m, -1, -1)
        residues = powers * weights[:, None]
        forced = (v @ residues).real
        free_b = [k for k in range(self.m + 1) if k not in self.known_b]
        target = self.record.y[self.use] - sum(
            (value * forced[:, k] for k, value in self.known_b.items()), np.zeros(forced.shape[0])
        )
        columns = [forced[:, free_b]]
        used = t[self.use]
        decay = np.exp(np.outer(used - used[0], poles))
        middle = np.exp(np.mean(np.log(np.abs(poles))))
        own = (poles[:, None] / middle) ** np.arange(self.n) * weights[:, None]
        estimated = self.options.initial_state == "estimate"
        if estimated:
            columns.append((decay @ own).real)
        if self.options.offset == "estimate":
            columns.append(np.ones((used.size, 1)))
        phi = np.hstack(columns)
        lengths = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
        if not np.isfinite(phi).all():
            return np.inf, np.zeros(self.n), 0.0
        solution = np.linalg.lstsq(phi / lengths, target, rcond=1e-13)[0] / lengths if phi.shape[1] else np.zeros(0)
        residual = target - phi @ solution
        b = np.zeros(self.m + 1)
        b[free_b] = solution[: len(free_b)]
        for k, coefficient in self.known_b.items():
            b[k] = coefficient
        # Derivatives of sum_k R_k v_k with R_k = B(p_k)/prod(p_k - p_l), at a fixed B.
        gradient = np.zeros(self.n, complex)
        parts = [(b, np.polyval(b, poles), np.polyval(np.polyder(b), poles), v, dv)]
        if estimated:
            c = (solution[len(free_b) : len(free_b) + self.n] / middle ** np.arange(self.n))[::-1]
            lag = used - used[0]
            parts.append((c, np.polyval(c, poles), np.polyval(np.polyder(c), poles), decay, lag[:, None] * decay))
        inverse = 1.0 / gaps
        np.fill_diagonal(inverse, 0.0)
        for _, at, slope, response, changed in parts:
            residue = at * weights
            along, moving = residual @ response, residual @ changed
            own_slope = slope * weights - residue * inverse.sum(axis=1)
            gradient += residue * moving + own_slope * along + (residue * along) @ inverse
        # At relative degree one x' contains b0 u, which jumps with u: between the jumps this is its derivative.
        shift = residual @ (rate @ (np.polyval(b, poles) * weights)).real
        return float(residual @ residual), -2.0 * gradient, -2.0 * float(shift)

    def roots_of(self, x, pairs):
        """Return the poles from ln w and ln zeta of the pairs and ln p of the others, and their derivatives."""
        n = self.n
        w, zeta, reals = np.exp(x[:pairs]), np.exp(x[pairs : 2 * pairs]), np.exp(x[2 * pairs : n])
        swing = np.sqrt(np.maximum(1.0 - zeta**2, 1e-12))
        upper = w * (-zeta + 1j * swing)
        poles = np.concatenate((upper, upper.conj(), -reals)).astype(complex)
        slopes = np.zeros((n, n), complex)
        for k in range(pairs):
            turn = w[k] * (-zeta[k] - 1j * zeta[k] ** 2 / swing[k])
            slopes[k, k], slopes[pairs + k, k] = upper[k], upper[k].conj()
            slopes[k, pairs + k], slopes[pairs + k, pairs + k] = turn, turn.conj()
        for k in range(2 * pairs, n):
            slopes[k, k] = poles[k]
        return poles, slopes

    def constraint(self, x, pairs):
        """Return ln(a_i/v_i) of the known a_i, and its derivatives."""
        places = sorted(self.known_a)
        values = np.array([self.known_a[place] for place in places])
        poles, slopes = self.roots_of(x, pairs)
        a = np.real(np.poly(poles))[1:]
        turned = np.column_stack([-np.poly(np.delete(poles, k)) for k in range(self.n)])
        to_x = np.zeros((len(places), x.size))
        to_x[:, : self.n] = (turned @ slopes).real[places] / a[places, None]
        with np.errstate(all="ignore"):
            return np.log(a[places] / values), to_x

    def limits(self, pairs):
        box, reals = self.box, self.n - 2 * pairs
        low = [np.log(box.slowest)] * pairs + [np.log(box.least_damping)] * pairs + [np.log(box.slowest)] * reals
        high = [np.log(box.fastest)] * pairs + [np.log(1.0 - 1e-9)] * pairs + [np.log(box.fastest)] * reals
        if self.free_delay:
            low.append(self.options.delay_bounds[0] / self.box.quarter)
            high.append(self.options.delay_bounds[1] / self.box.quarter)
        return np.array(low), np.array(high)

    def moved(self, x, pairs):
        """Return the point moved onto the constraint within the limits by Newton's steps; None if they fail."""
        low, high = self.limits(pairs)
        x = np.clip(x, low, high)
        if not self.known_a:
            return x
        for _ in range(100):
            error, slopes = self.constraint(x, pairs)
            if not np.isfinite(error).all():
                return None
            if np.abs(error).max() < FEASIBLE:
                return x
            step = -np.linalg.lstsq(slopes, error, rcond=None)[0]
            x = np.clip(x + step / max(1.0, np.abs(step).max()), low, high)
        return None

    def delay(self, x):
        return float(x[-1]) * self.box.quarter if self.free_delay else self.options.delay_bounds[0]

    def objective(self, x, pairs):
        """Return ln of the squared error, and its gradient."""
        poles, slopes = self.roots_of(x, pairs)
        squared, to_poles, to_delay = self.value(poles, self.delay(x))
        if not np.isfinite(squared):
            return 1e3, np.zeros(x.size)
        gradient = np.zeros(x.size)
        gradient[: self.n] = (to_poles @ slopes).real
        if self.free_delay:
            gradient[-1] = to_delay * self.box.quarter
        return np.log(squared), gradient / squared

    def polished(self, x, pairs):
        """Return the least squared error from a point, by SLSQP."""
        low, high = self.limits(pairs)
        conditions = []
        if self.known_a:
            conditions.append(
                {
                    "type": "eq",
                    "fun": lambda x: self.constraint(x, pairs)[0],
                    "jac": lambda x: self.constraint(x, pairs)[1],
                }
            )
        if np.isfinite(self.box.imaginary) and pairs:
            conditions.append({"type": "ineq", "fun": lambda x: self.below_nyquist(x, pairs)})
        best = np.inf
        for _ in range(2):
            found = minimize(
                self.objective,
                x,
                args=(pairs,),
                jac=True,
                method="SLSQP",
                bounds=list(zip(low, high, strict=True)),
                constraints=conditions,
                options={"maxiter": 200, "ftol": 1e-13},
            )
            x = self.moved(found.x, pairs) if np.isfinite(found.x).all() else None
            if x is None or (pairs and np.isfinite(self.box.imaginary) and self.below_nyquist(x, pairs).min() < -1e-9):
                break
            best = min(best, self.squared(x, pairs))
        return best

    def below_nyquist(self, x, pairs):
        """Return ln of the greatest imaginary part over that of each pair."""
        w, zeta = x[:pairs], np.exp(x[pairs : 2 * pairs])
        return np.log(self.box.imaginary) - w - 0.5 * np.log(np.maximum(1.0 - zeta**2, 1e-12))

    def squared(self, x, pairs):
        return self.value(self.roots_of(x, pairs)[0], self.delay(x), False)[0]

    def coordinates(self, poles, delay):
        # Poles at infinity are moved to the edge of the box.
        poles = np.append(poles, np.full(self.n - poles.size, -self.box.fastest))
        pairs, reals = poles[poles.imag > 0], -poles[poles.imag == 0].real
        x = [np.log(np.abs(pairs)), np.log(-pairs.real / np.abs(pairs)), np.log(reals)]
        if self.free_delay:
            x.append([delay / self.box.quarter])
        return np.concatenate(x), pairs.size

    def random(self, rng):
        pairs = int(rng.integers(0, self.n // 2 + 1))
        low, high = self.limits(pairs)
        return rng.uniform(low, high), pairs


# --- systems -----------------------------------------------------------------------------------------


def random_system(rng, n, slowest, fastest):
    """Return n poles between two speeds [rad/s], and the numerator, with fewer zeros, and denominator of a system."""
    poles = []
    while len(poles) < n:
        w = np.exp(rng.uniform(np.log(slowest), np.log(fastest)))
        if n - len(poles) >= 2 and rng.random() < 0.5:
            zeta = float(np.exp(rng.uniform(np.log(0.05), np.log(0.95))))
            poles += [w * complex(-zeta, sign * np.sqrt(1 - zeta**2)) for sign in (1, -1)]
        else:
            poles.append(complex(-w))
    poles = np.array(poles)
    m = int(rng.integers(0, n))
    middle = np.exp(np.mean(np.log(np.abs(poles))))
    b = np.atleast_1d(np.poly(-middle * np.exp(rng.uniform(-1.0, 1.0, m)) * rng.choice([1, -1], m)))
    a = np.real(np.poly(poles))
    b = b / b[-1] * a[-1] * rng.uniform(0.5, 3.0)
    return poles, b, a


def random_case(rng):
    """Return a record, its true model, options without known coefficients, and with them."""
    n = int(rng.integers(1, 5))
    samples, h = int(rng.integers(300, 601)), 10.0 ** rng.uniform(-2, 0)
    initial_state = str(rng.choice(["rest", "estimate"]))
    offset = str(rng.choice(["none", "estimate"]))
    poles, b, a = random_system(rng, n, 12 / (samples * h), 0.6 / h)
    kind = str(rng.choice(["none", "known", "searched"]))
    delay = 0.0 if kind == "none" else float(rng.uniform(0, 8 * h))
    bounds = (delay, delay) if kind != "searched" else (0.0, 12 * h)
    t = h * np.arange(samples)
    if rng.random() < 1 / 3:
        t = np.concatenate(([0.0], np.cumsum(h * rng.uniform(0.3, 1.7, samples - 1))))
    hold = int(rng.integers(1, 16))
    u = np.repeat(rng.choice([-1.0, 1.0], samples // hold + 1), hold)[:samples]
    weights = np.array([1 / np.prod(np.delete(p - poles, k)) for k, p in enumerate(poles)])
    x = (modal_responses(poles, t, u, t, delay, 0.0) @ (np.polyval(b, poles) * weights)).real
    if initial_state == "estimate":
        free = (np.exp(np.outer(t, poles)) @ weights).real
        x = x + rng.standard_normal() * np.std(x) * free / np.abs(free).max()
    x = x + (rng.uniform(-2, 2) * np.std(x) if offset == "estimate" else 0.0)
    y = x + rng.standard_normal(samples) * x.std() * 10 ** (-rng.uniform(5, 30) / 20)
    m = b.size - 1
    names = [f"a{k}" for k in range(1, n + 1)] + [f"b{k}" for k in range(m + 1)]
    count = int(rng.integers(1, min(2, len(names) - 1) + 1))
    chosen = rng.choice(len(names), count, replace=False)
    right = bool(rng.random() < 0.5)
    truth = np.concatenate((a[1:], b))
    fixed = {names[k]: float(truth[k] * (1.0 if right else rng.choice([0.8, 1.2]))) for k in sorted(chosen)}
    options = {"poles": n, "zeros": m, "delay_bounds": bounds, "initial_state": initial_state, "offset": offset}
    return Record(t, y, HeldSignal(t, u)), TransferFunction(b, a, delay), options, fixed, right


def reached(peer, rng, starts, refined, own):
    """Return the least squared errors of the peer by its start."""
    trials = []
    for _ in range(starts):
        x, pairs = peer.random(rng)
        x = peer.moved(x, pairs)
        if x is not None:
            trials.append((peer.squared(x, pairs), pairs, x))
    trials.sort(key=lambda trial: trial[0])
    found = {"random": min((peer.polished(x, pairs) for _, pairs, x in trials[:refined]), default=np.inf)}
    for name, (poles, delay) in own.items():
        x, pairs = peer.coordinates(poles, delay)
        x = peer.moved(x, pairs)
        found[name] = np.inf if x is None else min(peer.squared(x, pairs), peer.polished(x, pairs))
    return found


def compared(number, asked):
    """Return the lines of one system, free and with known coefficients: statuses and the peer's error over ctid's."""
    rng = np.random.default_rng([asked.seed, number])
    record, truth, options, fixed, right = random_case(rng)
    refined = asked.starts if number % 10 == 0 and number // 10 < asked.all_refined else asked.refined
    results, free = [], None
    for known in ({}, fixed):
        own = {}
        if free is not None:
            own["the free optimum"] = free.model.poles, free.model.delay
        if not known or right:
            own["the truth"] = truth.poles, truth.delay
        estimator = DelayProfile(**options, fixed=tuple(Fixed(*pair) for pair in known.items()))
        spent, fit = cpu(estimator.fit, record)
        free = free or fit
        own["the fit itself"] = fit.model.poles, fit.model.delay
        ours, peer = fit.cost * fit.count, Peer(record, estimator, fit.box, known)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ends = {name: end / ours - 1 for name, end in reached(peer, rng, asked.starts, refined, own).items()}
        least = min(ends, key=ends.get)
        clock = "regular" if record.interval else "irregular"
        said = (
            f"{number}: {options['poles']}/{options['zeros']}, {record.n_samples} samples, {clock}, delay "
            f"{options['delay_bounds']}, state {options['initial_state']}, offset {options['offset']}, known "
            f"{', '.join(known) or 'nothing'}{' (wrong)' * (bool(known) and not right)}: {fit.status.name}, "
            f"{fit.starts.agree} of {fit.starts.tried} starts, {spent:.2f} s; peer {ends[least]:+.1e} from {least}; "
            + ", ".join(f"{name} {end:+.1e}" for name, end in ends.items())
        )
        results.append((fit.status.name, ends[least], spent, said))
    return results


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="number of the first system")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--starts", type=int, default=200, help="random starts of the peer")
    parser.add_argument("--refined", type=int, default=30, help="how many of them are refined")
    parser.add_argument("--all-refined", type=int, default=30, help="systems of which all starts are refined")
    parser.add_argument("--verbose", action="store_true", help="a line for each fit")
    asked = parser.parse_args()
    warnings.simplefilter("error")
    kinds = "nothing known", "known coefficients"
    counts = {kind: Counter() for kind in kinds}
    above, below, seconds = ({kind: Counter() for kind in kinds} for _ in range(3))
    for number in range(asked.first, asked.first + asked.systems):
        try:
            results = compared(number, asked)
        except DataError as error:
            print(f"{number}: refused: {error}", flush=True)
            counts[kinds[1]]["refused"] += 1
            continue
        for kind, (status, end, spent, said) in zip(kinds, results, strict=True):
            counts[kind][status] += 1
            above[kind][status] += end < -TOLERANCE
            below[kind][status] += end > TOLERANCE
            seconds[kind][status] += spent
            if end < -TOLERANCE or asked.verbose:
                print(f"{'ABOVE ' if end < -TOLERANCE else ''}{said}", flush=True)
    for kind in kinds:
        print(
            f"{kind}: {asked.systems} systems, {dict(counts[kind])}; above the peer {dict(+above[kind])}, below all "
            f"that it reached {dict(+below[kind])}; {seconds[kind].total():.0f} CPU s"
        )


if __name__ == "__main__":
    main()
