"""Quality of the model that `ctid fit` chooses for a frequency response, on simulated responses of known structure.

    python benchmarks/bench_choice_lines.py [--systems 40] [--seed 20270114] [--first 0]

A system has 2 to 8 poles over up to 1.5 decades (pairs with a damping of .01 to .7, real poles), a fifth one at the
origin, up to as many zeros as its relative degree admits, and in half of the cases a delay of up to 3 time constants
of its fastest pole; its scale is 1 mHz to 1 GHz. There are 60 to 400 lines, evenly spaced or by a constant ratio, from
a third of the slowest to three times the fastest pole. The noise is 20 to 50 dB below the response (root mean
squares), the same at all lines or proportional to the gain; half of the responses have standard errors.

The error of a model is the root mean square of its weighted errors on a finer grid without noise. The reference is that
of the true structure (order, zeros, integrators, delay searched over the same range or 0), or, if that is larger, the
one expected from its number of parameters.
"""

import argparse

from _timing import cpu

import numpy as np

from ctid_cli import FrequencyData, FrequencyDomain, TransferFunction
from ctid_cli.identification.choose_response import choose_response


def drawn(seed, number):
    """Return a transfer function, the number of its integrators, its lines with noise, and the noise of any line."""
    rng = np.random.default_rng([seed, number])
    order, integrators = int(rng.integers(2, 9)), int(rng.random() < 0.2)
    scale, span = 2.0 * np.pi * 10.0 ** rng.uniform(-3.0, 9.0), 10.0 ** rng.uniform(0.5, 1.5)
    poles = []
    while len(poles) < order - integrators:
        speed = span ** rng.uniform()
        if order - integrators - len(poles) > 1 and rng.random() < 0.7:
            damping = 10.0 ** rng.uniform(-2.0, np.log10(0.7))
            poles += [speed * complex(-damping, sign * np.sqrt(1.0 - damping**2)) for sign in (1, -1)]
        else:
            poles.append(complex(-speed))
    zeros = []
    most = int(rng.integers(0, order))
    while len(zeros) < most:
        speed, side = span ** rng.uniform(), rng.choice([-1.0, 1.0], p=[0.8, 0.2])
        if most - len(zeros) > 1 and rng.random() < 0.6:
            damping = side * 10.0 ** rng.uniform(-2.0, np.log10(0.7))
            zeros += [speed * complex(damping, sign * np.sqrt(1.0 - damping**2)) for sign in (1, -1)]
        else:
            zeros.append(complex(side * speed))
    delay = float(rng.uniform(0.1, 3.0)) / span if rng.random() < 0.5 else 0.0
    a, b = np.poly(poles).real, np.atleast_1d(np.poly(zeros).real)
    model = TransferFunction(b / b[-1] * a[-1], np.append(a, np.zeros(integrators)), delay)
    count = int(rng.integers(60, 401))
    ends = 0.33, 3.0 * max(abs(pole) for pole in poles)
    spaced = np.geomspace if rng.random() < 0.6 else np.linspace
    w, fine = spaced(*ends, count), spaced(*ends, 4 * count)
    level, relative, stated = 10.0 ** (-rng.uniform(20.0, 50.0) / 20.0), rng.random() < 0.5, rng.random() < 0.5

    def noise(w):
        gain = np.abs(model.frequency_response(w))
        power = np.sqrt(np.mean(np.abs(model.frequency_response(fine)) ** 2))
        return level * (gain if relative else power * np.ones(w.size))

    errors = noise(w) * (rng.standard_normal(count) + 1j * rng.standard_normal(count)) / np.sqrt(2.0)
    values = model.frequency_response(w) + errors
    data = FrequencyData(w * scale, values, noise(w) if stated else None)
    return model, integrators, scale, data, (fine, noise(fine))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=40)
    parser.add_argument("--seed", type=int, default=20270114)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    print(
        f"{'':4}{'true':12}{'chosen':12}{'least':12}{'lines':>6}{'error':>8}{'of true':>8}{'ratio':>7}",
        f"{'CPU s':>8}",
    )
    ratios, seconds = [], []
    for number in range(given.first, given.first + given.systems):
        model, integrators, scale, data, (fine, noise) = drawn(given.seed, number)

        def error(found, scale=scale, model=model, fine=fine, noise=noise):
            off = found.frequency_response(fine * scale) - model.frequency_response(fine)
            return float(np.sqrt(np.mean(np.abs(off / noise) ** 2)))

        own, choice = cpu(choose_response, data)
        found = choice.taken
        zeros, reach = model.numerator.size - 1, max(choice.judged, key=lambda one: one.options.delay_bounds[1])
        delays = reach.options.delay_bounds if model.delay else (0.0, 0.0)
        true = FrequencyDomain(model.order - integrators, zeros, delays, integrators=integrators)
        size = model.order - integrators + zeros + 1 + int(model.delay > 0.0)
        expected = np.sqrt(size / (2.0 * data.frequencies.size))
        reference = max(error(true.fit(data).model), expected)
        ratios.append(error(found.fit.model) / reference)
        seconds.append(own)
        plus = f" + {integrators}" * bool(integrators)
        names = [f"{model.order - integrators}/{zeros}{plus}{' d' * bool(model.delay)}"]
        names += [f"{one.name}{' d' * bool(one.options.delay_bounds[1])}" for one in (choice.taken, choice.judged[0])]
        line = "".join(f"{name:12}" for name in names)
        end = f"{data.frequencies.size:6}{error(found.fit.model):8.3f}{reference:8.3f}{ratios[-1]:7.2f}"
        print(f"{number:<4}{line}{end}{own:9.2f}", *choice.missed, flush=True)
    shares = [100.0 * float(np.mean(np.array(ratios) <= most)) for most in (1.25, 2.0)]
    print(f"error at most 1.25 times that of the true structure in {shares[0]:.0f} %, 2 times in {shares[1]:.0f} %")
    print(f"CPU time of the choice [s]: median {np.median(seconds):.2f}, greatest {np.max(seconds):.2f}")


if __name__ == "__main__":
    main()
