"""Printed intervals against the truth for kinds of records in which numbers are easily wrong.

Usage: ``python benchmarks/bench_kinds.py [RECORDS] [SEED] [KIND ...]``. Each record is fitted with several options, one
row of the table each. For gain, delay and poles (time constants, natural frequencies, damping) the columns are in %:

- cover: given intervals that contain the truth;
- far: of all, intervals that miss it by more than two lengths;
- held: without an interval;
- well: without one, although least squares about the true model gives 95 % half-widths below a quarter of the value (of
  the sampling interval, for a shorter delay);
- sign: intervals of a gain that contain only values of the wrong sign.

A known delay is not counted; a chosen one has an interval of length 0, which may miss by .1 %. Poles are counted if
their number is right. Where a fit states that a repeating input has equivalent models, gain and delay are compared with
the equivalent of nearest delay. Warnings of NumPy count as failures.
"""

import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from dataclasses import dataclass, field

import _timing  # noqa: F401  (one thread for linear algebra)

import numpy as np
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from ctid_cli import DelayProfile, Given, HeldSignal, Record, TransferFunction, identify, simulate
from ctid_cli.errors import CtidError

#: Number of records of each kind, and seed.
DEFAULTS = ["20", "6301"]
#: Half-width of a well determined value, relative to it.
WELL = 0.25
#: Lengths of an interval from which the truth is far, and relative error if the length is zero.
FAR, EXACT = 2.0, 1e-3
#: Printed columns by group.
COLUMNS = {
    "gain": ("cover", "far", "held", "well", "sign"),
    "delay": ("cover", "far", "held", "well"),
    "poles": ("cover", "far", "held", "well"),
}


# --- records -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """Data with their true models by input, and the 95 % half-widths of their quantities; "" is a single input."""

    data: object
    systems: dict
    half_widths: dict
    #: Whether the input repeats, so that other gains and delays are equivalent.
    repeats: bool = False
    #: Options by the names of their rows.
    variants: dict = field(default_factory=dict)

    def fitted_with(self, **variants):
        return Case(self.data, self.systems, self.half_widths, self.repeats, variants)


def first_order(gain, time_constant, delay=0.0):
    return TransferFunction([gain], [time_constant, 1.0], delay)


def square(t, half, low=-1.0, high=1.0):
    """Return a square wave of given half period [s] that begins with the high level at time 0."""
    return np.where(np.floor(t / half + 1e-9) % 2 == 0, high, low)


def binary(rng, n, held):
    """Return a random binary signal, constant for a number of samples."""
    return np.repeat(rng.choice([-1.0, 1.0], n // held + 1), held)[:n]


def step_at(t, start, size=1.0):
    return size * (t >= start - 1e-9)


def irregular(rng, n, interval=1.0):
    return interval * np.append(0.0, np.cumsum(rng.uniform(0.5, 1.5, n - 1)))


def coloured_noise(rng, n, pole=0.0):
    """Return AR(1) noise of deviation 1, after its transient."""
    return lfilter([1.0], [1.0, -pole], np.sqrt(1 - pole**2) * rng.standard_normal(n + 200))[200:]


def simulated(
    rng, systems, t, inputs, *, first=0, db=20.0, colour=0.0, offset=0.0, drift=0.0, moving=None, repeats=False
):
    """Return the case of a record that begins with sample ``first`` of a simulation from rest.

    Offset and drift are relative to the deviation of the response. By default the system is moving at the beginning of
    a record that is cut from a simulation: then the bounds include an estimated state and leave out the samples before
    the delay, whose input is not recorded.
    """
    systems = systems if isinstance(systems, dict) else {"": systems}
    inputs = inputs if isinstance(inputs, dict) else {"": inputs}
    signals = {name: HeldSignal(t, u) for name, u in inputs.items()}
    own, moving = t[first:], first > 0 if moving is None else moving

    def output(theta):
        parts = unpacked(theta, systems)
        return sum(simulate(TransferFunction(b, a), signals[name], own - tau) for name, (b, a, tau) in parts.items())

    x = output(packed(systems))
    ramp = (own - own[0]) / (own[-1] - own[0])
    deviation = 10 ** (-db / 20) * x.std()
    y = x + (offset + drift * ramp) * x.std() + deviation * coloured_noise(rng, own.size, colour)
    held = {name: HeldSignal(own, u[first:]) for name, u in inputs.items()}
    extra, used = [np.ones(own.size)] + [ramp] * bool(drift), np.ones(own.size, dtype=bool)
    if moving:
        used = own >= own[0] + max(each.delay for each in systems.values())
        for pole in (pole for each in systems.values() for pole in each.poles if pole.imag >= 0):
            free = np.exp(pole * (own - own[0]))
            extra += [free.real] + [free.imag] * bool(pole.imag)
    psi = np.column_stack([differences(output, systems, np.diff(own).min()), *extra])[used]
    noise = deviation**2 * toeplitz(colour ** np.arange(used.sum()))
    record = Record(own, y, held.get("", held))
    return Case(record, systems, half_widths(systems, psi, noise), repeats)


def packed(systems):
    """Return the parameters of models: numerator, denominator and delay of each."""
    return np.concatenate([np.r_[each.numerator, each.denominator[1:], each.delay] for each in systems.values()])


def unpacked(theta, like):
    """Return numerator, denominator and delay by input."""
    found, rest = {}, theta
    for name, each in like.items():
        b, size = each.numerator.size, each.numerator.size + each.order + 1
        found[name], rest = (rest[:b], np.r_[1.0, rest[b : size - 1]], rest[size - 1]), rest[size:]
    return found


def quantities(parts):
    """Return static gain, delay, time constants, natural frequencies and damping under their printed names."""
    found = {}
    for name, (b, a, delay) in parts.items():
        prefix = f"{name}_" if name else ""
        found |= {f"{prefix}static_gain": b[-1] / a[-1], f"{prefix}delay": delay}
        poles = np.roots(a)
        upper = sorted((pole for pole in poles if pole.imag >= 0), key=abs, reverse=True)
        for k, pole in enumerate(upper, 1):
            if pole.imag:
                found |= {f"{prefix}natural_frequency_{k}": abs(pole), f"{prefix}damping_{k}": -pole.real / abs(pole)}
            else:
                found[f"{prefix}time_constant_{k}"] = -1.0 / pole.real
        if a.size == 3:  # a pair may be printed for two real poles
            found |= {f"{prefix}natural_frequency_1": a[2] ** 0.5, f"{prefix}damping_1": 0.5 * a[1] * a[2] ** -0.5}
    return found


def differences(function, systems, interval):
    """Return the derivatives of a function by the parameters of the models, by central differences."""
    theta, columns = packed(systems), []
    delays = np.cumsum([each.numerator.size + each.order + 1 for each in systems.values()]) - 1
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = 1e-4 * interval if k in delays else 1e-6 * abs(theta[k])
        columns.append((function(theta + step) - function(theta - step)) / (2 * step[k]))
    return np.column_stack(columns)


def half_widths(systems, psi, noise):
    """Return 95 % half-widths of all quantities by least squares, linear about the true models, for the true noise."""
    scale = np.maximum(np.linalg.norm(psi, axis=0), 1e-300)
    left, size, right = np.linalg.svd(psi / scale, full_matrices=False)
    inverse = (right.T / np.maximum(size, 1e-9 * size[0])) @ left.T
    count = packed(systems).size
    covariance = (inverse @ noise @ inverse.T)[:count, :count] / np.outer(scale[:count], scale[:count])
    names = list(quantities(unpacked(packed(systems), systems)))

    def values(theta):
        return np.array([*quantities(unpacked(theta, systems)).values()])

    gradient = differences(values, systems, 1.0)
    errors = np.sqrt(np.maximum(np.einsum("ik,kl,il->i", gradient, covariance, gradient), 0.0))
    return dict(zip(names, 1.96 * errors, strict=True))


# --- kinds ---------------------------------------------------------------------------------------------


def drawn_gain(rng):
    return rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 4.0)


def drawn_system(rng, poles, slowest, delay, zeros=0):
    """Return a random system with its slowest time constant given [s]."""
    roots, speed = [], 1 / slowest
    while len(roots) < poles:
        if poles - len(roots) > 1 and rng.random() < 0.4:
            damping = rng.uniform(0.2, 0.9)
            pair = speed * complex(-damping, np.sqrt(1 - damping**2))
            roots += [pair, pair.conjugate()]
        else:
            roots.append(-speed)
        speed *= rng.uniform(1.6, 5.0)
    a = np.poly(roots).real
    b = np.atleast_1d(np.poly(rng.choice([-1.0, -1.0, 1.0], zeros) * rng.uniform(0.5, 4.0, zeros) / slowest))
    return TransferFunction(b * drawn_gain(rng) * a[-1] / b[-1], a, delay)


def drawn_offset(rng):
    return rng.choice([0.0, rng.uniform(-3.0, 3.0)])


def drawn_noise(rng):
    return {"db": rng.uniform(10, 30), "offset": drawn_offset(rng)}


def square_wave(rng, number):
    interval, each, n = 0.1, int(rng.integers(8, 31)), int(rng.integers(150, 401))
    half, poles = interval * each, int(rng.integers(1, 3))
    system = drawn_system(rng, poles, half * rng.uniform(0.1, 1.0), half * rng.uniform(0.0, 1.9))
    start = ("cut", "rest", "quiet")[number % 3]
    low = rng.choice([-1.0, 0.0])
    before = {"cut": 20 * each + int(rng.integers(0, 2 * each)), "rest": 0, "quiet": 20 * each}[start]
    quiet = int(rng.integers(5, 2 * each)) if start == "quiet" else 0
    t = interval * np.arange(-before, n)
    u = square(t - interval * quiet, half, low)
    if start == "quiet":
        u[: before + quiet] = low
    case = simulated(rng, system, t, u, first=before, moving=start == "cut", repeats=start == "cut", **drawn_noise(rng))
    reach = (0.0, 3.0 * half)
    state = {"cut": {"initial_state": "estimate"}, "rest": {}, "quiet": {"input_before": "first"}}[start]
    return case.fitted_with(
        **{
            f"{start}, typed": Given(poles=poles, zeros=0),
            f"{start}, range": Given(poles=poles, zeros=0, delay_bounds=reach),
            f"{start}, class": DelayProfile(poles, 0, reach, offset="estimate", **state),
            f"{start}, chosen": Given(),
        }
    )


def one_sine(rng, number):
    n, constant = int(rng.integers(150, 401)), 8.0 * rng.choice([1.0, rng.uniform(0.5, 2.0)])
    period = rng.uniform(15.0, 60.0)
    t = np.arange(-400.0, n)
    system = first_order(rng.choice([-2.0, 2.0, drawn_gain(rng)]), constant, rng.uniform(0.0, 9.0))
    case = simulated(rng, system, t, np.sin(2 * np.pi * t / period), first=400, **drawn_noise(rng))
    class_ = DelayProfile(1, 0, (0.0, 10.0), initial_state="estimate", offset="estimate")
    return case.fitted_with(range=Given(poles=1, zeros=0, delay_bounds=(0.0, 10.0)), **{"class": class_})


def one_step(rng, number):
    n, poles = int(rng.integers(300, 601)), 1 + number % 2
    system = drawn_system(rng, poles, n * rng.uniform(0.03, 0.15), 0.0)
    t = np.arange(-1.0, n)
    u = step_at(t, rng.integers(6, 0.15 * n), rng.choice([-1.0, 4.0]))
    case = simulated(rng, system, t, u, first=1, db=rng.uniform(20, 50), offset=rng.uniform(-8, 8), moving=False)
    typed = {f"{p}/{z}": Given(poles=p, zeros=z, delay_bounds=(0.0, 0.0)) for p, z in ((1, 0), (2, 0), (2, 1))}
    right = {name: each for name, each in typed.items() if each.poles >= poles}
    return case.fitted_with(**right, chosen=Given())


def regular(rng, number):
    n, poles = int(rng.integers(250, 401)), 1 + number % 3
    slowest = rng.uniform(3.0, n / 20)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 8.0))
    t = irregular(rng, n) if number % 4 == 3 else np.arange(float(n))
    u = binary(rng, n, max(1, round(0.7 * slowest)))
    case = simulated(rng, system, t, u, colour=0.7 * (number % 4 == 1), **drawn_noise(rng))
    typed = Given(poles=poles, zeros=0, delay_bounds=(0.0, 10.0))
    return case.fitted_with(range=typed, **{"class": DelayProfile(poles, 0, (0.0, 10.0), offset="estimate")})


KINDS = {
    "square": square_wave,
    "sine": one_sine,
    "one-step": one_step,
    "regular": regular,
}


# --- counts --------------------------------------------------------------------------------------------


def intervals_of(item):
    """Return the printed intervals of a quantity; none if it is withheld."""
    if item.status == "fixed":
        return [(item.estimate, item.estimate)]
    if item.status == "undetermined" or item.reason:
        return []
    found = getattr(item, "intervals", None) or ((item.low, item.high),)
    return [each for each in found if np.isfinite(each).all()]


def misses(intervals, truth):
    """Return whether intervals miss the truth, and by more than two lengths."""
    length = sum(high - low for low, high in intervals)
    distance = min(max(low - truth, truth - high, 0.0) for low, high in intervals)
    if length == 0:
        wrong = distance > EXACT * abs(truth) + 1e-12
        return wrong, wrong
    return distance > 1e-12, distance > FAR * length + 1e-12


def equivalent(truth, found, printed):
    """Return the true quantities of a repeating input's equivalent model with the delay nearest the printed one."""
    repetition = getattr(found, "repetition", None)
    if repetition is None:
        return truth
    changed = dict(truth)
    for name in [name for name in truth if name.endswith("delay")]:
        prefix = getattr(repetition, "input", "")
        if prefix and not name.startswith(f"{prefix}_"):
            continue
        times = round((printed[name].estimate - truth[name]) / repetition.shift)
        changed[name] = truth[name] + times * repetition.shift
        changed[name.removesuffix("delay") + "static_gain"] *= repetition.sign ** abs(times)
    return changed


def count(case, options, found, rows):
    """Count each quantity of a fit in the rows of gain, delay and poles."""
    truth = quantities(unpacked(packed(case.systems), case.systems))
    printed = {item.name: item for item in (*found.estimates, *found.derived)}
    interval = 0.0 if not isinstance(case.data, Record) else float(np.diff(case.data.t).min())
    bounds = getattr(options, "delay_bounds", None)
    right = found.fit.model.order == sum(each.order for each in case.systems.values())
    for name, value in equivalent(truth, found, printed).items():
        group = next((each for each in ("gain", "delay") if name.endswith(each)), "poles")
        if name not in printed or (group == "poles" and not right):
            continue
        if group == "delay" and bounds is not None and bounds[0] == bounds[1]:
            continue
        row, intervals = rows[group], intervals_of(printed[name])
        row["n"] += 1
        if intervals:
            missed, far = misses(intervals, value)
            row["given"] += 1
            row["cover"] += not missed
            row["far"] += far
            row["sign"] += group == "gain" and all(low * value < 0 > high * value for low, high in intervals)
        else:
            size = max(abs(value), interval if group == "delay" else 0.0)
            well = case.half_widths[name] < WELL * size and not (case.repeats and group != "poles")
            row["held"] += 1
            row["well"] += well


def fit_of(case, options):
    """Return a fit, with NumPy's warnings as errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return identify(case.data, options)


def reason_of(error):
    """Return an error with its place in the source."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = "" if isinstance(error, CtidError) else f" ({last.filename.rpartition('/')[2]}, line {last.lineno})"
    return f"{type(error).__name__}: {str(error)[:150]}{place}"


def percent(row, columns):
    """Return the columns of one group of quantities [%], after their number."""
    total = {"cover": row["given"], "sign": row["given"]}
    shares = ((row[name], total.get(name, row["n"])) for name in columns)
    return f"{row['n']:5d}" + "".join(f"{100 * part / whole:6.0f}" if whole else "     -" for part, whole in shares)


def print_kind(kind, records, seed):
    """Fit the records of a kind and print a row for each variant, and the errors of failed fits."""
    fitted, failed, spent = Counter(), defaultdict(Counter), Counter()
    rows = defaultdict(lambda: defaultdict(Counter))
    for number in range(records):
        case = KINDS[kind](np.random.default_rng([seed, number, *kind.encode()]), number)
        for variant, options in case.variants.items():
            begin = time.process_time()
            fitted[variant] += 1
            try:
                found = fit_of(case, options)
            except Exception as error:
                failed[variant][reason_of(error)] += 1
            else:
                count(case, options, found, rows[variant])
            spent[variant] += time.process_time() - begin
    for variant in sorted(fitted):
        parts = " |".join(percent(rows[variant][group], columns) for group, columns in COLUMNS.items())
        label, number = f"{kind}: {variant}", fitted[variant]
        print(
            f"{label:26}{number:4d}{failed[variant].total():5d} |{parts} | {spent[variant] / number:5.2f}", flush=True
        )
    for variant, reasons in failed.items():
        for reason, times in reasons.items():
            print(f"    {variant}: {times} x {reason}", flush=True)


def main(records, seed, kinds):
    warm = regular(np.random.default_rng(0), 0)
    fit_of(warm, warm.variants["range"])  # compiles, or loads the compiled functions
    heads = ["    n" + "".join(f"{name:>6}" for name in columns) for columns in COLUMNS.values()]
    print(" " * 35 + " |" + " |".join(f"{group:>{len(head)}}" for group, head in zip(COLUMNS, heads, strict=True)))
    print(f"{'kind: variant':26}   n fail |{' |'.join(heads)} | CPU s", flush=True)
    for kind in kinds:
        print_kind(kind, records, seed)


if __name__ == "__main__":
    given = sys.argv[1:] + DEFAULTS[len(sys.argv) - 1 :]
    main(int(given[0]), int(given[1]), given[2:] or [*KINDS])
