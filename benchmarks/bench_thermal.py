"""Models that ``ctid fit`` chooses for records of a small heated body, which has no integrator and does not oscillate.

    python benchmarks/bench_thermal.py FILE [--records 30] [--seed 101] [--first 0]

Two bodies with a heater each, as in a temperature control lab: power on the first is the input, a sensor with a lag on
it is the output. They lose heat to the surroundings by convection and radiation and exchange it with each other:

    C dT/dt = U A (Ta - T) + e s A (Ta^4 - T^4) + (the same between the bodies) + a Q

A record of 400 to 1,000 s, begun in equilibrium with its first input, has one or a few steps. Ingredients that no
linear model contains are drawn: radiation, a change of the unmeasured second heater, a walk of the ambient temperature,
sun, draughts (more convection for a while), a beginning beside equilibrium, output rounded to .32 or .1 K, and a clock
that is not regular.

Models are judged on another record of the same plant, undisturbed and unrounded, with other levels of the input in the
range of the first: simulated from rest at its first input, with a constant estimated. The reference is the best there
of 1/0, 2/0, 2/1 and 3/1 (poles/zeros), fitted to the same record from rest at the first input with an offset and a
delay of 0 to 10 samples. Faults are a pair of poles of damping below .5, an integrator, and a loss of more than one
point of fit against the reference. Each record adds a line to FILE (JSON); existing ones are not computed again.
"""

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path

from _timing import cpu

import numpy as np
from _rows import Rows

from ctid_cli import DelayProfile, HeldSignal, Record, choose, simulate
from ctid_cli.errors import CtidError

#: Steps of the integration [s].
FINE = 0.25
STEFAN = 5.67e-8
KELVIN = 273.15
#: Structures of the reference, and the range of their delay [samples].
REFERENCE, DELAYS = ((1, 0), (2, 0), (2, 1), (3, 1)), 10
#: Damping below which a pair of poles oscillates, and a loss of fit that counts [points].
OSCILLATES, COSTLY = 0.5, 1.0


@dataclass(frozen=True)
class Plant:
    """Heat capacity [J/K], convection [W/K], radiation (emissivity times area [m2]) and what couples the bodies."""

    capacity: float
    convection: float
    radiation: float
    between: float
    power: float
    sensor: float


@dataclass(frozen=True)
class Surroundings:
    """What happens in a record beside its input."""

    start: float = 22.0
    #: Walk of the ambient temperature in 100 s, and its rise by the sun [K], with its begin and time constant [s].
    walk: float = 0.0
    sun: tuple[float, float, float] = (0.0, 0.0, 1.0)
    #: Factor of convection, from and to [s].
    draughts: tuple[tuple[float, float, float], ...] = ()
    #: Power of the second heater before and after an instant [s].
    second: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: Distance of both bodies from equilibrium at the beginning [K].
    warmer: float = 0.0


def simulated(plant, around, t, u, rng):
    """Return the temperature of the sensor at some instants [deg C], for an input held between these."""
    count = int(np.ceil(t[-1] / FINE)) + 1
    s = FINE * np.arange(count)
    rise, begin, constant = around.sun
    ambient = around.start + rise * (1 - np.exp(-np.maximum(s - begin, 0) / constant))
    ambient += around.walk * np.sqrt(FINE / 100) * np.cumsum(rng.standard_normal(count))
    convection = np.full(count, plant.convection)
    for factor, low, high in around.draughts:
        convection[(s >= low) & (s < high)] *= factor
    before, after, instant = around.second
    held = u[np.clip(np.searchsorted(t, s, side="right") - 1, 0, u.size - 1)]
    powers = np.stack([held, np.where(s < instant, before, after)], axis=1)

    def slope(x, ambient, convection, power):
        one, two, sensor = x
        lost = [convection * (T - ambient) + radiated(T, ambient) for T in (one, two)]
        exchanged = plant.between * (one - two) + 0.2 * radiated(one, two)
        return np.array(
            [
                (plant.power * power[0] - lost[0] - exchanged) / plant.capacity,
                (plant.power * power[1] - lost[1] + exchanged) / plant.capacity,
                (one - sensor) / plant.sensor,
            ]
        )

    def radiated(T, other):
        return plant.radiation * STEFAN * ((T + KELVIN) ** 4 - (other + KELVIN) ** 4)

    x = np.full(3, float(ambient[0]))
    for _ in range(3000):
        x = x + 4.0 * slope(x, ambient[0], convection[0], powers[0])
    x = x + around.warmer
    sensed = np.empty(count)
    for k in range(count):
        sensed[k] = x[2]
        own = ambient[k], convection[k], powers[k]
        half = x + 0.5 * FINE * slope(x, *own)
        x = x + FINE * slope(half, *own)
    return np.interp(t, s, sensed)


@dataclass(frozen=True)
class Case:
    """A plant, its surroundings, and how it was measured; the rest follows from the seed and the number."""

    seed: int
    number: int
    plant: Plant
    around: Surroundings
    duration: float
    interval: float
    jitter: float
    #: Levels of the input [%] and instants of its steps [s].
    levels: tuple[float, ...]
    steps: tuple[float, ...]
    quantum: float
    noise: float

    def rng(self, what):
        return np.random.default_rng([self.seed, self.number, what])

    def input(self, t):
        return np.array(self.levels)[np.searchsorted(self.steps, t, side="right")]

    @property
    def record(self):
        """Record to which models are fitted."""
        rng = self.rng(1)
        t = np.arange(0.0, self.duration, self.interval)
        t = np.sort(t + self.jitter * self.interval * rng.uniform(-1, 1, t.size))
        t = t - t[0]
        u = self.input(t)
        y = simulated(self.plant, self.around, t, u, rng) + self.noise * rng.standard_normal(t.size)
        return Record(t, self.quantum * np.round(y / self.quantum), HeldSignal(t, u), name=f"record {self.number}")

    @property
    def other(self):
        """Undisturbed record on which models are judged."""
        rng, t = self.rng(2), np.arange(0.0, 1200.0)
        low, high = min(self.levels), max(self.levels)
        levels = np.r_[self.levels[0], self.levels[1], rng.uniform(low, high, 3), self.levels[1]]
        u = levels[np.searchsorted([30.0, 330.0, 500.0, 700.0, 950.0], t, side="right")]
        second = self.around.second[0]
        quiet = Surroundings(start=self.around.start, second=(second, second, 0.0))
        return Record(t, simulated(self.plant, quiet, t, u, rng), HeldSignal(t, u))


def drawn(seed, number):
    """Draw a record."""
    rng = np.random.default_rng([seed, number])
    plant = Plant(
        capacity=rng.uniform(1.5, 3.0),
        convection=rng.uniform(0.003, 0.012),
        radiation=rng.uniform(0.3, 1.0) * 1.2e-3,
        between=rng.uniform(0.5, 2.5) * 2e-3,
        power=rng.uniform(0.006, 0.013),
        sensor=rng.uniform(5.0, 25.0),
    )
    duration = rng.uniform(400.0, 1000.0)
    draughts = tuple(
        (rng.uniform(1.1, 1.4), begin, begin + rng.uniform(30.0, 150.0))
        for begin in rng.uniform(0.1, 0.9, rng.choice([0, 0, 0, 1])) * duration
    )
    second = float(rng.choice([0.0, 0.0, 20.0, 40.0]))
    around = Surroundings(
        start=rng.uniform(18.0, 25.0),
        walk=float(rng.choice([0.0, 0.1, 0.3])),
        sun=(float(rng.choice([0.0, 0.0, 0.0, 2.0])), rng.uniform(0.0, 0.7) * duration, rng.uniform(60.0, 300.0)),
        draughts=draughts,
        second=(0.0, second, rng.uniform(0.2, 0.8) * duration) if rng.random() < 0.7 else (second, 0.0, duration / 2),
        warmer=float(rng.choice([0.0, 0.0, -0.5, 1.0])),
    )
    first = rng.uniform(1.5, 40.0)
    count = int(rng.choice([1, 1, 2, 4]))
    steps = np.sort(np.r_[first, first + rng.uniform(0.15, 0.85, count - 1) * (duration - first)])
    levels = np.r_[float(rng.choice([0.0, 0.0, 20.0])), rng.uniform(35.0, 100.0), 10 * rng.integers(0, 9, count - 1)]
    return Case(
        seed=seed,
        number=number,
        plant=plant,
        around=around,
        duration=duration,
        interval=float(rng.choice([1.0, 1.0, 2.0, 5.0])),
        jitter=float(rng.choice([0.0, 0.01, 0.1])),
        levels=tuple(levels.tolist()),
        steps=tuple(steps.tolist()),
        quantum=float(rng.choice([0.32, 0.32, 0.1])),
        noise=float(rng.choice([0.03, 0.1, 0.2])),
    )


def fit_percent(model, record):
    """Return the fit of a model from rest at the first input, with a constant estimated [%]."""
    x = simulate(model, HeldSignal(record.t, record.input.values - record.input.values[0]), record.t)
    e = record.y - x
    return float(100 * (1 - np.linalg.norm(e - e.mean()) / np.linalg.norm(record.y - record.y.mean())))


def least_damping(model):
    """Return the least damping of a pair of poles; 1 without any."""
    pairs = model.poles[model.poles.imag > 0]
    return float(np.min(-pairs.real / np.abs(pairs), initial=1.0))


def row_of(case):
    """Return a choice with its faults, and the fits of the reference."""
    record, other = case.record, case.other
    row = {"seed": case.seed, "number": case.number, "case": asdict(case)}
    reach = DELAYS * case.interval
    fits = {}
    for poles, zeros in REFERENCE:
        options = DelayProfile(poles, zeros, (0.0, reach), "rest", "estimate", input_before="first")
        fits[f"{poles}/{zeros}"] = fit_percent(options.prepare(record).minimum().model, other)
    row["reference"] = fits
    try:
        row["cpu"], choice = cpu(choose, record)
        fit = choice.options.prepare(choice.records).minimum()
    except CtidError as error:
        return {**row, "message": str(error)}
    options = choice.options
    row |= {name: getattr(options, name) for name in ("poles", "zeros", "integrators")}
    row |= {"treatment": [options.initial_state, options.input_before, options.offset]}
    row |= {"damping": least_damping(fit.model), "delay": fit.model.delay, "fit": fit_percent(fit.model, other)}
    return row | {"command": " ".join(choice.words())}


def faults(row):
    """Return the faults of a choice: oscillation, integrator, loss."""
    if "message" in row:
        return {"refused"}
    loss = max(row["reference"].values()) - row["fit"]
    found = {"oscillation": row["damping"] < OSCILLATES, "integrator": row["integrators"] > 0, "loss": loss > COSTLY}
    return {name for name, is_so in found.items() if is_so}


def ingredients(case):
    """Return a short description of a record."""
    around = case["around"]
    before, after, _ = around["second"]
    found = {
        f"{len(case['steps'])} steps": True,
        f"{case['interval']:g} s": True,
        f"quantum {case['quantum']:g}": True,
        "second heater": before != after,
        f"walk {around['walk']:g}": around["walk"] > 0,
        "sun": around["sun"][0] > 0,
        f"{len(around['draughts'])} draughts": len(around["draughts"]) > 0,
        f"begun {around['warmer']:+g} K": around["warmer"] != 0,
    }
    return ", ".join(name for name, is_so in found.items() if is_so)


def print_summary(rows):
    found = [faults(row) for row in rows]
    kept = [row for row in rows if "message" not in row]
    for name in ("oscillation", "integrator", "loss", "refused"):
        print(f"{name:14}{sum(name in each for each in found):4} of {len(rows)}")
    print(f"{'any of them':14}{sum(map(bool, found)):4} of {len(rows)}")
    losses = [max(row["reference"].values()) - row["fit"] for row in kept]
    far = sum(each > 5 * COSTLY for each in losses)
    print(
        f"loss of fit: median {np.median(losses):.2f}, mean {np.mean(losses):.2f} points, above {5 * COSTLY:g}: {far}"
    )
    for name in rows[0]["reference"]:
        own = [max(row["reference"].values()) - row["reference"][name] for row in rows]
        print(
            f"    always {name}: {sum(each > COSTLY for each in own)} of {len(rows)} lose, median {np.median(own):.2f}"
        )
    print(f"median poles {np.median([row['poles'] + row['integrators'] for row in kept]):g}")
    print(f"CPU s: median {np.median([row['cpu'] for row in kept]):.1f}, sum {sum(row['cpu'] for row in kept):.0f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--records", type=int, default=30)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    kept, rows = Rows(given.file, "seed", "number"), []
    print(f"{'':4}{'chosen':>7} {'treatment':24}{'damping':>8}{'fit':>7}{'reference':>14}{'CPU s':>6}  faults (record)")
    for number in range(given.first, given.first + given.records):
        row = kept.row((given.seed, number), lambda number=number: row_of(drawn(given.seed, number)))
        rows.append(row)
        structure, best = max(row["reference"].items(), key=lambda each: each[1])
        about = f"{' '.join(sorted(faults(row))) or '-'} ({ingredients(row['case'])})"
        if "message" in row:
            print(f"{number:4}  {row['message']}", flush=True)
            continue
        chosen = "/".join(str(row[name]) for name in ("poles", "zeros", "integrators"))
        treatment = "/".join("-" if each is None else str(each) for each in row["treatment"])
        print(
            f"{number:4}{chosen:>7} {treatment:24}{row['damping']:8.2f}{row['fit']:7.2f}{best:8.2f} ({structure})"
            f"{row['cpu']:6.1f}  {about}",
            flush=True,
        )
    print_summary(rows)


if __name__ == "__main__":
    main()
