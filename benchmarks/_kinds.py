"""Simulated records of kinds in which printed intervals are easily wrong, with the accuracy that they allow.

The makers take all properties but the noise; the kinds draw these and the options of the fits.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_triangular, toeplitz
from scipy.signal import lfilter

from ctid_cli import (
    DelayProfile,
    Fixed,
    FrequencyData,
    FrequencyDomain,
    Given,
    HeldSignal,
    InputModel,
    Record,
    Rivc,
    TransferFunction,
    simulate,
)
from ctid_cli.inference.fitted_model import STEP

#: Number of instants of a step response.
INSTANTS = 13

# --- cases ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """Data with their true models by input; "" is a single input."""

    data: object
    systems: dict
    #: Derivatives of the response by the parameters of the models, and true covariance of the output errors.
    psi: np.ndarray
    noise: np.ndarray
    #: 95 % half-widths of the quantities for the true noise and the treatment that the record needs.
    half_widths: dict
    #: Names of the inputs that repeat, so that other gains and delays are equivalent.
    repeats: tuple = ()
    #: Whether all inputs have one denominator.
    common: bool = False
    #: Options by the names of their rows.
    variants: dict = field(default_factory=dict)

    def fitted_with(self, **variants):
        return replace(self, variants=variants)

    @property
    def truth(self):
        return quantities(unpacked(packed(self.systems), self.systems), self.systems, self.common)

    def reference(self, options, used):
        """Return the 95 % half-widths of an estimator with these options that knows the noise covariance."""
        known = {each.name for each in getattr(options, "fixed", None) or ()}
        own = {each.name: each.delay_bounds for each in getattr(options, "inputs", None) or () if each.delay_bounds}
        for name in self.systems:
            low, high = own.get(name, options.delay_bounds)
            known |= {f"{name}_delay" if name else "delay"} if low == high else set()
        extra = []
        if isinstance(self.data, Record):
            since = self.data.t - self.data.t[0]
            extra += [np.ones(since.size)] * (options.offset != "none") + [since] * (options.offset == "drift")
            extra += free_responses(self.systems, since) if options.initial_state == "estimate" else []
        psi, noise = np.column_stack([self.psi, *extra])[used], self.noise[np.ix_(used, used)]
        weighted = getattr(options, "noise_model", "white") != "white"
        return half_widths(self.systems, psi, noise, known, self.common, weighted)


def first_order(gain, time_constant, delay=0.0):
    return TransferFunction([gain], [time_constant, 1.0], delay)


def square(k, half, low=-1.0, high=1.0):
    """Return a square wave of given half period [samples] that begins with the high level at sample 0."""
    return np.where(k // half % 2 == 0, high, low)


def binary(rng, n, held):
    """Return a random binary signal, constant for a number of samples."""
    return np.repeat(rng.choice([-1.0, 1.0], n // held + 1), held)[:n]


def irregular(rng, n, interval=1.0):
    return interval * np.append(0.0, np.cumsum(rng.uniform(0.5, 1.5, n - 1)))


def impulse_response(colour):
    """Return the impulse response of autoregressive noise of deviation 1 from its real roots."""
    roots = np.atleast_1d(colour)
    response = lfilter([1.0], np.poly(roots), np.eye(1, 200 if roots.max() < 0.9 else 5000)[0])
    return response / np.linalg.norm(response)


def coloured_noise(rng, n, colour=0.0):
    """Return autoregressive noise of deviation 1 from its real roots, after its transient."""
    before = impulse_response(colour)
    drawn = rng.standard_normal(n + before.size)
    return lfilter(before[:1], np.poly(np.atleast_1d(colour)), drawn)[before.size :]


def correlation(n, colour=0.0):
    """Return the correlation matrix of autoregressive noise."""
    response = impulse_response(colour)
    return toeplitz([response[k:] @ response[: max(response.size - k, 0)] for k in range(n)])


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


def names_of(systems, common=False):
    """Return the printed names of the packed parameters; those of a common denominator repeat."""
    found = []
    for name, each in systems.items():
        prefix = f"{name}_" if name else ""
        found += [f"{prefix}b{k}" for k in range(each.numerator.size)]
        found += [f"{'' if common else prefix}a{k}" for k in range(1, each.order + 1)] + [f"{prefix}delay"]
    return found


def instants(system):
    """Return instants of a step response, to four slowest time constants after the delay."""
    return np.linspace(0.0, system.delay + 4.0 / np.abs(system.poles.real).min(), INSTANTS)


def quantities(parts, systems, common=False):
    """Return coefficients, delay, step response, static gain, time constants, natural frequencies and damping.

    They have their printed names; the step response is that at the instants of the true models.
    """
    found = {}
    for (name, (b, a, delay)), system in zip(parts.items(), systems.values(), strict=True):
        prefix = f"{name}_" if name else ""
        found |= dict(zip(names_of({name: system}, common), np.r_[b, a[1:], delay].tolist(), strict=True))
        step = simulate(TransferFunction(b, a), STEP, instants(system) - delay)
        found |= {f"{prefix}step {k}": value for k, value in enumerate(step)}
        found |= {f"{prefix}static_gain": b[-1] / a[-1]}
        prefix = "" if common else prefix
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
        below = step if k not in delays or theta[k] >= step[k] else 0.0 * step
        columns.append((function(theta + step) - function(theta - below)) / (step + below)[k])
    return np.column_stack(columns)


def half_widths(systems, psi, noise, known=(), common=False, weighted=False):
    """Return 95 % half-widths of all quantities by least squares, linear about the true models, for the true noise.

    Columns of ``psi`` after the parameters are those of further ones. Squares are weighted by the inverse of the noise
    covariance if wanted.
    """
    names = names_of(systems, common)
    free = [name for name in dict.fromkeys(names) if name not in known]
    joined = np.array([[name == each for each in free] for name in names], dtype=float)
    psi = np.column_stack([psi[:, : len(names)] @ joined, psi[:, len(names) :]])
    if weighted:
        psi, noise = solve_triangular(np.linalg.cholesky(noise), psi, lower=True), np.eye(len(psi))
    scale = np.maximum(np.linalg.norm(psi, axis=0), 1e-300)
    left, size, right = np.linalg.svd(psi / scale, full_matrices=False)
    inverse = (right.T / np.maximum(size, 1e-9 * size[0])) @ left.T / scale[:, None]
    inverse = inverse[: len(free)]
    covariance = inverse @ noise @ inverse.T

    def values(theta):
        return np.array([*quantities(unpacked(theta, systems), systems, common).values()])

    gradient = differences(values, systems, 1.0) @ joined
    errors = np.sqrt(np.maximum(np.einsum("ik,kl,il->i", gradient, covariance, gradient), 0.0))
    return dict(zip(quantities(unpacked(packed(systems), systems), systems, common), 1.96 * errors, strict=True))


def free_responses(systems, since):
    """Return the free responses of all modes."""
    modes = dict.fromkeys(pole for each in systems.values() for pole in each.poles if pole.imag >= 0)
    responses = [np.exp(pole * since) for pole in modes]
    return [part for each in responses for part in (each.real, each.imag) if part.any()]


def rounding_covariance(x, quantum, deviation):
    """Return the covariance of the errors of rounding outputs plus white noise, for a random offset.

    The error of rounding has the Fourier coefficients ``q/(pi k)``, which noise damps between different samples.
    """
    k = np.arange(1, 200)
    k = k[np.exp(-((2 * np.pi * k * deviation / quantum) ** 2)) > 1e-9]
    phase = 2 * np.pi / quantum * np.subtract.outer(x, x)
    damped = quantum**2 / (2 * np.pi**2 * k**2) * np.exp(-((2 * np.pi * k * deviation / quantum) ** 2))
    found = sum(size * np.cos(each * phase) for each, size in zip(k, damped, strict=True))
    np.fill_diagonal(found, quantum**2 / 12)
    return found


# --- makers --------------------------------------------------------------------------------------------


def simulated(
    rng,
    systems,
    t,
    inputs,
    *,
    first=0,
    moving=False,
    repeats=(),
    common=False,
    known=(),
    db=20.0,
    colour=0.0,
    offset=0.0,
    drift=0.0,
    plus=0.0,
    quantum=0.0,
    proportional=False,
):
    """Return the case of a record that begins with sample ``first`` of a simulation from rest.

    Offset, drift and quantum are relative to the deviation of the response; ``plus`` is a part of it outside the model.
    If the system is moving at the beginning of the record, the bounds include an estimated state and leave out the
    samples before the delay, whose input is not recorded. Proportional noise has a deviation relative to the magnitude
    of the response. An input may be a signal, of which the record has the samples.
    """
    systems = systems if isinstance(systems, dict) else {"": systems}
    inputs = inputs if isinstance(inputs, dict) else {"": inputs}
    signals = {name: u if isinstance(u, HeldSignal) else HeldSignal(t, u) for name, u in inputs.items()}
    own = t[first:]

    def output(theta):
        parts = unpacked(theta, systems)
        return sum(simulate(TransferFunction(b, a), signals[name], own - tau) for name, (b, a, tau) in parts.items())

    x = output(packed(systems)) + plus
    since = own - own[0]
    ramp = since / since[-1]
    deviation = 10 ** (-db / 20) * (np.abs(x) if proportional else np.full(own.size, x.std()))
    y = x + (offset + drift * ramp) * x.std() + deviation * coloured_noise(rng, own.size, colour)
    noise = deviation * correlation(own.size, colour) * deviation[:, None]
    if quantum:
        y = quantum * x.std() * np.round(y / (quantum * x.std()))
        noise = noise + rounding_covariance(x, quantum * x.std(), deviation[0])
    held = {name: HeldSignal(own, signal.at(own)) for name, signal in signals.items()}
    extra, used = [np.ones(own.size)] + [ramp] * bool(drift), np.ones(own.size, dtype=bool)
    if moving:
        used = since >= max(each.delay for each in systems.values())
        extra += free_responses(systems, since)
    psi = differences(output, systems, np.diff(own).min())
    widths = half_widths(systems, np.column_stack([psi, *extra])[used], noise[np.ix_(used, used)], known, common)
    return Case(Record(own, y, held.get("", held)), systems, psi, noise, widths, repeats, common)


def square_record(rng, system, n, half, start="cut", low=-1.0, wait=0, interval=0.1, **noise):
    """Return a square wave of given half period [samples].

    The record is cut from a long one after ``wait`` samples (start "cut"), begins at rest with the wave ("rest"), or
    has the low level before the wave, in the record for ``wait`` samples ("quiet").
    """
    first = {"cut": 20 * half + wait, "rest": 0, "quiet": 20 * half}[start]
    k = np.arange(-first, n)
    u = square(k - wait * (start == "quiet"), half, low)
    if start == "quiet":
        u[: first + wait] = low
    cut = start == "cut"
    return simulated(rng, system, interval * k, u, first=first, moving=cut, repeats=("",) * cut, **noise)


def periodic_record(rng, system, n, period, first=0, known=False, **noise):
    """Return an input of whole periods, given by its samples; the first samples are cut off.

    With a known state, as in a whole number of periods, the delays are taken as known within one period.
    """
    t = np.arange(-float(first), n)
    u = np.resize(period, t.size)
    cut = first > 0 and not known
    return simulated(rng, system, t, u, first=first, moving=cut, repeats=("",) * cut, **noise)


def sine_record(rng, system, n, period, **noise):
    """Return a sine of given period [s] in the steady state, at intervals of 1 s."""
    t = np.arange(-400.0, n)
    return simulated(rng, system, t, np.sin(2 * np.pi * t / period), first=400, moving=True, **noise)


def step_record(rng, system, n, start, size=1.0, interval=1.0, bend=0.0, **noise):
    """Return one step after rest at a sample; the time constant of a first-order system may vary with the response.

    With a response from 0 to 1 it is ``T (1 + bend z)`` at z; then there are no true poles.
    """
    t, plus = interval * np.arange(n), 0.0
    u = size * (np.arange(n) >= start)
    if bend:
        s, last = np.linspace(0.0, 60.0, 60_001), 1.0 - np.exp(-np.linspace(0.0, 60.0, 60_001))
        since = np.maximum(t - t[start], 0.0) * system.denominator[1]
        bent, straight = np.interp(since, s + bend * (s - last), last), 1.0 - np.exp(-since)
        plus = system.dc_gain * size * (bent - straight)
    case = simulated(rng, system, t, u, plus=plus, **noise)
    return replace(case, half_widths={"static_gain": case.half_widths["static_gain"]}) if bend else case


def binary_record(rng, system, t, held, quiet=0, steps=False, **noise):
    """Return a random binary signal, or random steps, constant for some samples, after zero for some samples."""
    u = binary(rng, t.size, held) * (np.repeat(rng.uniform(0.3, 2.0, t.size), held)[: t.size] if steps else 1.0)
    return simulated(rng, system, t, np.where(np.arange(t.size) < quiet, 0.0, u), **noise)


def two_input_record(rng, systems, n, half, held, **noise):
    """Return a square wave u1 of given half period and a random binary signal u2, cut from a long record."""
    first = 20 * half
    k = np.arange(-first, n)
    inputs = {"u1": square(k, half), "u2": binary(rng, k.size, held)}
    return simulated(rng, systems, 1.0 * k, inputs, first=first, moving=True, repeats=("u1",), **noise)


def measured_response(rng, system, frequencies, db=30.0, known=True):
    """Return a frequency response with errors of one deviation, which is known or not."""
    s, count = 1j * frequencies, frequencies.size

    def output(theta):
        b, a, tau = unpacked(theta, {"": system})[""]
        values = np.polyval(b, s) / np.polyval(a, s) * np.exp(-s * tau)
        return np.r_[values.real, values.imag]

    x = output(packed({"": system}))
    deviation = 10 ** (-db / 20) * np.sqrt(np.mean(x**2))
    y = x + deviation * rng.standard_normal(2 * count)
    errors = np.full(count, np.sqrt(2.0) * deviation) if known else None
    psi, noise = differences(output, {"": system}, 1.0 / frequencies[-1]), deviation**2 * np.eye(2 * count)
    data = FrequencyData(frequencies, y[:count] + 1j * y[count:], errors)
    return Case(data, {"": system}, psi, noise, half_widths({"": system}, psi, noise))


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


def drawn_noise(rng):
    return {"db": rng.uniform(10, 30), "offset": rng.choice([0.0, rng.uniform(-3.0, 3.0)])}


def square_wave(rng, number):
    half, n, poles = int(rng.integers(8, 31)), int(rng.integers(150, 401)), int(rng.integers(1, 3))
    start = ("cut", "rest", "quiet")[number % 3]
    system = drawn_system(rng, poles, 0.1 * half * rng.uniform(0.1, 1.0), 0.1 * half * rng.uniform(0.0, 1.9))
    wave = {"start": start, "low": rng.choice([-1.0, 0.0]), "wait": int(rng.integers(5, 2 * half))}
    reach = (0.0, 0.3 * half)
    state = {"cut": {"initial_state": "estimate"}, "rest": {}, "quiet": {"input_before": "first"}}[start]
    variants = {
        "typed": Given(poles=poles, zeros=0),
        "range": Given(poles=poles, zeros=0, delay_bounds=reach),
        "class": DelayProfile(poles, 0, reach, offset="estimate", **state),
        "chosen": Given(),
    }
    case = square_record(rng, system, n, half, **wave, **drawn_noise(rng))
    return case.fitted_with(**{f"{start}, {name}": options for name, options in variants.items()})


def whole_periods(rng, number):
    start = ("cut", "rest", "whole")[number % 3]
    once = start == "whole" and rng.random() < 0.5
    size, poles = int(rng.integers(*((150, 301) if once else (30, 61)))), int(rng.integers(1, 3))
    system = drawn_system(rng, poles, size * rng.uniform(0.05, 0.3), size * rng.uniform(0.0, 0.85))
    waves, k = np.arange(1, size // 2), np.arange(size)
    period = (
        binary(rng, size, 3),
        np.cos(2 * np.pi * np.outer(k, waves) / size + rng.uniform(0, 2 * np.pi, waves.size)).sum(axis=1),
        1.0 * (k < rng.integers(size // 10, size // 3)),
    )[int(rng.integers(3))]
    n = size if once else size * int(rng.integers(3, 7)) + int(rng.integers(size)) * (start != "whole")
    first = 0 if start == "rest" else 12 * size
    first += int(rng.integers(size)) * (start == "cut")
    case = periodic_record(rng, system, n, period, first, known=start == "whole", **drawn_noise(rng))
    reach = (0.0, (0.9 if start == "whole" else 1.5) * size)
    whole = {"initial_state": "periodic"} if start == "whole" else {}
    variants = {"range": Given(poles=poles, zeros=0, delay_bounds=reach, **whole)}
    variants |= {"whole": {}}.get(start, {"typed": Given(poles=poles, zeros=0), "chosen": Given()})
    return case.fitted_with(**{f"{start}, {name}": options for name, options in variants.items()})


def one_sine(rng, number):
    system = first_order(
        rng.choice([2.0, drawn_gain(rng)]), 8.0 * rng.choice([1.0, rng.uniform(0.5, 2.0)]), rng.uniform(0.0, 9.0)
    )
    case = sine_record(rng, system, int(rng.integers(150, 401)), rng.uniform(15.0, 60.0), **drawn_noise(rng))
    reach = (0.0, 10.0)
    own = DelayProfile(1, 0, reach, initial_state="estimate", offset="estimate")
    return case.fitted_with(**{"range": Given(poles=1, zeros=0, delay_bounds=reach), "class": own})


def slow_pole(rng, number):
    n, poles = int(rng.integers(150, 401)), 1 + number % 2
    constants = [n * 20 ** rng.random(), n * rng.uniform(0.02, 0.2)][:poles]
    a = np.poly([-1.0 / each for each in constants])
    system = TransferFunction([drawn_gain(rng) * a[-1]], a, rng.uniform(0.0, 5.0))
    t = irregular(rng, n) if number % 4 == 3 else np.arange(float(n))
    case = binary_record(rng, system, t, int(rng.integers(3, 16)), **drawn_noise(rng))
    return case.fitted_with(
        **{
            f"{poles} typed": Given(poles=poles, zeros=0),
            f"{poles} range": Given(poles=poles, zeros=0, delay_bounds=(0.0, 10.0)),
        }
    )


def linear_drift(rng, number):
    n, poles, noise = int(rng.integers(200, 401)), int(rng.integers(1, 3)), drawn_noise(rng)
    slowest = rng.uniform(3.0, n / 20)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 8.0))
    sizes = rng.uniform(1.0, 5.0) * 10 ** (-noise["db"] / 20), rng.uniform(1.0, 3.0)
    drift, quiet = rng.choice([-1.0, 1.0]) * sizes[number % 2], 40 * (number % 4 > 1)
    t, held = np.arange(float(n)), max(2, round(slowest * rng.uniform(0.7, 3.0)))
    case = binary_record(rng, system, t, held, quiet, bool(rng.integers(2)), drift=drift, **noise)
    typed = Given(poles=poles, zeros=0, delay_bounds=(0.0, 10.0))
    size = ("small", "large")[number % 2]
    return case.fitted_with(
        **{
            f"{size}, range": typed,
            f"{size}, a1 known": replace(typed, fixed=(Fixed("a1", float(system.denominator[1])),)),
            f"{size}, class": DelayProfile(poles, 0, (0.0, 10.0), offset="drift"),
            f"{size}, chosen": Given(),
        }
    )


def frequency_response(rng, number):
    slowest = float(np.exp(rng.uniform(-2.0, 2.0)))
    system = drawn_system(rng, 2, slowest, slowest * rng.uniform(0.0, 1.5), zeros=1)
    w = np.geomspace(0.1, rng.uniform(5.0, 20.0), int(rng.integers(30, 61))) / slowest
    case = measured_response(rng, system, w, rng.uniform(15.0, 35.0), known=bool(number % 2))
    return case.fitted_with(
        **{("errors unknown", "errors known")[number % 2]: FrequencyDomain(2, 1, (0.0, 3 * slowest))}
    )


def all_chosen(rng, number):
    n, poles = int(rng.integers(200, 401)), 1 + number % 3
    zeros = int(poles > 1 and rng.random() < 0.3)
    slowest = rng.uniform(3.0, n / 20)
    delay = rng.choice([0.0, rng.uniform(0.0, 1.0), rng.uniform(1.0, 5.0)]) * slowest
    system = drawn_system(rng, poles, slowest, delay, zeros)
    t = irregular(rng, n) if number % 5 == 4 else np.arange(float(n))
    kind, noise = (
        ("binary", "steps", "multisine")[number // 3 % 3],
        drawn_noise(rng) | {"colour": 0.7 * (number % 4 == 1)},
    )
    if kind == "multisine":
        w = np.linspace(0.1, 3.0, 15) / slowest
        u = np.sin(np.outer(t, w) + rng.uniform(0, 2 * np.pi, w.size)).sum(axis=1)
        case = simulated(rng, system, t, u, **noise)
    else:
        held = max(1, round(slowest * (rng.uniform(0.3, 1.5) if kind == "binary" else rng.uniform(3.0, 6.0))))
        case = binary_record(rng, system, t, held, 0 if kind == "binary" else 10, kind == "steps", **noise)
    return case.fitted_with(**{kind: Given()})


def one_step(rng, number):
    n, poles, bend = int(rng.integers(300, 601)), 1 + number % 2, 0.15 * (number % 4 == 2)
    system = drawn_system(rng, poles, n * rng.uniform(0.03, 0.15), 0.0)
    start, size = (11, 4.0) if number % 2 else (int(rng.integers(5, 0.15 * n)), rng.choice([-1.0, 4.0]))
    noise = {"db": rng.uniform(20, 50), "offset": rng.uniform(-8, 8), "colour": 0.7 * (number % 5 == 4)}
    case = step_record(rng, system, n, start, size, bend=bend, **noise)
    typed = {f"{p}/{z}": Given(poles=p, zeros=z, delay_bounds=(0.0, 0.0)) for p, z in ((1, 0), (2, 0), (2, 1))}
    typed = {name: options for name, options in typed.items() if options.poles >= poles} | {"chosen": Given()}
    return case.fitted_with(**{("bent, " if bend else "") + name: options for name, options in typed.items()})


def regular(rng, number):
    n, poles = int(rng.integers(250, 401)), 1 + number % 3
    slowest = rng.uniform(3.0, n / 20)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 8.0))
    t = irregular(rng, n) if number % 4 == 3 else np.arange(float(n))
    noise = drawn_noise(rng) | {"colour": 0.7 * (number % 4 == 1)}
    case = binary_record(rng, system, t, max(1, round(0.7 * slowest)), **noise)
    reach = (0.0, 10.0)
    own = DelayProfile(poles, 0, reach, offset="estimate")
    return case.fitted_with(**{"range": Given(poles=poles, zeros=0, delay_bounds=reach), "class": own})


def two_inputs(rng, number):
    half, n = int(rng.integers(8, 31)), int(rng.integers(200, 401))
    u1 = first_order(drawn_gain(rng), half * rng.uniform(0.2, 1.0), half * rng.uniform(0.0, 1.9))
    u2 = first_order(drawn_gain(rng), rng.uniform(3.0, n / 20), rng.uniform(0.0, 8.0))
    case = two_input_record(rng, {"u1": u1, "u2": u2}, n, half, int(rng.integers(2, 10)), **drawn_noise(rng))
    reach = (0.0, 3.0 * half)
    return case.fitted_with(
        **{
            name: Given(
                poles=1,
                zeros=0,
                inputs=tuple(InputModel(each, poles=1, zeros=0, delay_bounds=own) for each in ("u1", "u2")),
            )
            for name, own in (("typed", None), ("range", reach))
        }
    )


def long_delay(rng, number):
    n, interval = int(rng.integers(150, 401)), 0.1
    left = 0.9 * n * interval
    system = first_order(drawn_gain(rng), left * rng.uniform(0.03, 0.08), left * rng.uniform(0.5, 0.8))
    noise = {"db": rng.uniform(10, 30), "offset": rng.choice([0.0, 2.0])}
    case = step_record(rng, system, n, n // 10, rng.choice([1.0, 3.0]), interval, **noise)
    return case.fitted_with(chosen=Given(), typed=Given(poles=1, zeros=0))


# --- kinds with a given structure, for the lengths of intervals ----------------------------------------


def one_of(rng, poles, zeros, reach, label="", **own):
    """Return one estimator of a given structure: all else is chosen, or it is a class with an estimated offset."""
    chosen = Given(poles=poles, zeros=zeros, delay_bounds=reach)
    estimators = {"typed": chosen, "class": DelayProfile(poles, zeros, reach, offset="estimate", **own)}
    name = ("typed", "class")[int(rng.integers(2))]
    return {f"{label}, {name}" if label else name: estimators[name]}


def kept(rng, n, low, high, values):
    """Return values that are kept for random numbers of samples."""
    return np.repeat(rng.choice(values, n), rng.integers(low, high, n))[:n]


def building(rng, number):
    """Return a record of indoor temperature in intervals of half an hour, from weeks before it."""
    n, first, interval = 1199, 500, 0.5
    t = interval * np.arange(-first, n)
    weather = lfilter([1.0], [1.0, -0.99], 0.4 * rng.standard_normal(t.size))
    clouds = np.interp(t, t[::8], rng.uniform(0.0, 1.0, t[::8].size))
    day = np.sin(2 * np.pi * (t - 8.0) / 24.0)
    inputs = {
        "heat": kept(rng, t.size, *((4, 24), (24, 96))[number // 2 % 2], [0.0, 0.5, 1.0, 2.0]),
        "outside": 4.0 * day + weather,
        "sun": np.maximum(day, 0.0) * clouds,
    }
    a = np.poly(-1.0 / (np.array([0.9, 16.0]) * rng.uniform(0.7, 1.4, 2)))
    zeros = rng.uniform(1.0, 4.0, 3)
    gains = dict(zip(inputs, [rng.uniform(4.0, 7.0), rng.uniform(0.7, 1.0), rng.uniform(2.0, 6.0)], strict=True))
    systems = {
        name: TransferFunction(gain * a[-1] * np.array([zero, 1.0]), a)
        for (name, gain), zero in zip(gains.items(), zeros, strict=True)
    }
    # The noise enters at the output, or is a disturbance that passes through the plant.
    label, through = (("output", []), ("disturbance", np.exp(interval * np.roots(a)).tolist()))[number % 2]
    roots = [rng.uniform(0.98, 0.995), *through]
    noise = {"db": -20 * np.log10(rng.uniform(0.05, 0.15)), "colour": roots, "offset": 4.0}
    delays = tuple(f"{name}_delay" for name in inputs)
    case = simulated(rng, systems, t, inputs, first=first, moving=True, common=True, known=delays, **noise)
    return case.fitted_with(**one_of(rng, 2, 1, (0.0, 0.0), label, initial_state="estimate"))


def quantised(rng, number):
    n, poles = int(rng.integers(200, 601)), 1 + number % 2
    slowest, quantum = rng.uniform(4.0, n / 25), (0.8, 0.3)[number // 2 % 2]
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 5.0))
    held = max(2, round(slowest * rng.uniform(0.7, 2.5)))
    u = (square(np.arange(n), held), binary(rng, n, held), kept(rng, n, held, 3 * held, np.linspace(-2, 2, 9)))[
        number // 4 % 3
    ]
    noise = {"db": 20 * np.log10(20.0), "offset": rng.uniform(-3.0, 3.0), "quantum": quantum}
    case = simulated(rng, system, np.arange(float(n)), u, **noise)
    return case.fitted_with(**one_of(rng, poles, 0, (0.0, 10.0), f"{quantum}"))


def short_record(rng, number):
    n, poles, colour = int(rng.integers(60, 121)), 1 + (number % 3 == 2), 0.7 * (number % 2)
    slowest = rng.uniform(3.0, n / 12)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 5.0))
    held, noise = max(2, round(0.7 * slowest)), drawn_noise(rng) | {"colour": colour}
    case = binary_record(rng, system, np.arange(float(n)), held, **noise)
    return case.fitted_with(**one_of(rng, poles, 0, (0.0, 10.0), "AR" if colour else "white"))


def noise_model(rng, number):
    n, poles = 200, 1 + number % 2
    slowest = rng.uniform(3.0, 10.0)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 5.0))
    noise = drawn_noise(rng) | {"colour": 0.85}
    case = binary_record(rng, system, np.arange(float(n)), max(2, round(0.7 * slowest)), **noise)
    reach, model = (0.0, 10.0), "arma:1,0"
    chosen = Given(poles=poles, zeros=0, delay_bounds=reach, noise_model=model)
    estimators = {"typed": chosen, "rivc": Rivc(poles, 0, reach, offset="estimate", noise_model=model)}
    name = ("typed", "rivc")[int(rng.integers(2))]
    return case.fitted_with(**{name: estimators[name]})


def zero_delay(rng, number):
    n, poles = int(rng.integers(200, 401)), 1 + number % 2
    slowest = rng.uniform(3.0, n / 20)
    system = drawn_system(rng, poles, slowest, (0.0, rng.uniform(0.0, 0.1))[number // 2 % 2], poles - 1)
    case = binary_record(rng, system, np.arange(float(n)), max(2, round(0.7 * slowest)), **drawn_noise(rng))
    return case.fitted_with(**one_of(rng, poles, poles - 1, (0.0, 5.0)))


def collinear(rng, number):
    n, held, correlation = int(rng.integers(250, 501)), int(rng.integers(3, 9)), rng.uniform(0.95, 0.99)
    u1, other = (kept(rng, n, held, 3 * held, rng.standard_normal(n)) for _ in range(2))
    u2 = correlation * u1 + np.sqrt(1 - correlation**2) * other
    slowest, known = rng.uniform(3.0, n / 20), number % 2 == 0
    a = np.array([1.0, 1.0 / slowest])
    systems = {
        name: TransferFunction([drawn_gain(rng) / slowest], a, 0.0 if known else rng.uniform(0.0, 4.0))
        for name in ("u1", "u2")
    }
    delays = ("u1_delay", "u2_delay") if known else ()
    inputs = {"u1": u1, "u2": u2}
    case = simulated(rng, systems, np.arange(float(n)), inputs, common=True, known=delays, **drawn_noise(rng))
    label, reach = ("known", (0.0, 0.0)) if known else ("range", (0.0, 8.0))
    return case.fitted_with(**one_of(rng, 1, 0, reach, label))


def cancelling(rng, number):
    n = int(rng.integers(250, 501))
    slowest = rng.uniform(5.0, n / 20)
    poles = np.array([-1.0, -rng.uniform(2.0, 5.0)]) / slowest
    zero = poles[number % 2] * (1 + rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.15))
    a, b = np.poly(poles), np.poly([zero])
    system = TransferFunction(b * drawn_gain(rng) * a[-1] / b[-1], a, rng.uniform(0.0, 5.0))
    case = binary_record(rng, system, np.arange(float(n)), max(2, round(0.7 * slowest)), **drawn_noise(rng))
    return case.fitted_with(**one_of(rng, 2, 1, (0.0, 10.0)))


def smooth_input(rng, number):
    """Return samples of a smooth input, simulated from a finer grid with straight lines between its points."""
    n, poles, fine = int(rng.integers(250, 401)), 1 + number % 2, 20
    slowest = rng.uniform(3.0, n / 20)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 3.0))
    t = np.arange(fine * n) / fine
    w = np.linspace(0.1, min(3.0, 0.8 * slowest), 12) / slowest
    phases = rng.uniform(0, 2 * np.pi, w.size)
    # It begins at zero, where the record begins.
    u = (np.sin(np.outer(t, w) + phases) - np.sin(phases)).sum(axis=1)
    case = simulated(rng, system, t[::fine], HeldSignal(t, u, "foh"), **drawn_noise(rng))
    # The hold is not given.
    record = case.data
    case = replace(case, data=Record.from_arrays(record.t, record.input.at(record.t), record.y))
    return case.fitted_with(**one_of(rng, poles, 0, (0.0, 5.0)))


def proportional_noise(rng, number):
    n, poles = int(rng.integers(200, 401)), 1 + number % 2
    slowest = rng.uniform(3.0, n / 20)
    system = drawn_system(rng, poles, slowest, rng.uniform(0.0, 5.0))
    held = max(2, round(slowest * rng.uniform(0.7, 2.5)))
    u = kept(rng, n, held, 3 * held, np.array([0.0, 0.5, 1.0, 2.0, 4.0]))
    db = -20 * np.log10(rng.uniform(0.1, 0.2))
    case = simulated(rng, system, np.arange(float(n)), u, db=db, proportional=True)
    return case.fitted_with(**one_of(rng, poles, 0, (0.0, 10.0), f"{poles}"))


KINDS = {
    "square": square_wave,
    "period": whole_periods,
    "sine": one_sine,
    "slow-pole": slow_pole,
    "drift": linear_drift,
    "response": frequency_response,
    "chosen": all_chosen,
    "one-step": one_step,
    "regular": regular,
    "two-inputs": two_inputs,
    "long-delay": long_delay,
}
#: Kinds of which the structure is given.
GIVEN_KINDS = {
    "building": building,
    "quantised": quantised,
    "short": short_record,
    "arma": noise_model,
    "zero-delay": zero_delay,
    "collinear": collinear,
    "cancelling": cancelling,
    "smooth": smooth_input,
    "proportional": proportional_noise,
}
KINDS |= GIVEN_KINDS
