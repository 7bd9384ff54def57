"""Quality of the model that `ctid fit` chooses with default settings, on simulated records of known structure.

    python benchmarks/bench_choice.py FILE [--records 400] [--seed 20261126] [--first 0] [--steps 30]

A record has 300 to 1,000 samples, 1 to 4 poles (a quarter of the records one at the origin), a dominant time constant
of 3 samples to a fifteenth of the record, a delay of 0 or .3 to 10 samples, in half of the cases a state before the
record, or an offset of the output; a binary input, one step, or a multisine; white noise or AR(1) of .5 to .95 at 5 to
30 dB.

The error of a model is the root mean square error of its noise-free output for a new input, from rest, over the
standard deviation of the true one, with the chosen hold. References are errors of the true structure with known hold,
or their root mean square over five redraws of the noise if that is larger: `chosen` with the chosen treatment and
range; `true` knows everything, with the true treatment and a range of the delay of 0 to 20 samples. Each record adds a
line to FILE (JSON); existing ones are not computed again.

Then step records with a lead of 1, 5 and 15 samples are compared with the true structure from rest.
"""

import argparse
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from _timing import cpu

import numpy as np
from _rows import Rows

from ctid_cli import DelayProfile, HeldSignal, Record, TransferFunction, choose, simulate
from ctid_cli.errors import CtidError

INTERVAL = 1.0
REDRAWS = 5
#: Range of the delay of the true structure in the true treatment, in samples.
DELAYS = (0.0, 20.0)
#: Leads of step records [samples], and the number from which on they are drawn.
LEADS, FIRST_LEAD = (1, 5, 15), 10**6
GROUPS: dict[str, Callable[["Case"], bool]] = {
    "all": lambda case: True,
    "10 dB and more": lambda case: case.snr_db >= 10,
    "white noise": lambda case: case.colour == 0,
    "AR(1) below .8": lambda case: 0 < case.colour < 0.8,
    "AR(1) from .8": lambda case: case.colour >= 0.8,
    "binary input": lambda case: case.kind == "binary",
    "step": lambda case: case.kind == "step",
    "multisine": lambda case: case.kind == "multisine",
    "integrator": lambda case: case.integrators == 1,
    "no integrator": lambda case: case.integrators == 0,
    "irregular clock": lambda case: case.irregular,
    "at rest": lambda case: case.at_rest,
    "with a state": lambda case: not case.at_rest,
}


@dataclass(frozen=True)
class Case:
    """Properties of a record; everything else follows from the seed and its number."""

    seed: int
    number: int
    samples: int
    poles: tuple[complex, ...]
    zeros: tuple[float, ...]
    integrators: int
    constant: float
    delay: float
    gain: float
    kind: str
    hold: str
    irregular: bool
    at_rest: bool
    has_offset: bool
    snr_db: float
    colour: float
    #: Clock of a binary input and instant of a step [samples], frequencies of a multisine [rad/sample].
    clock: int
    step: int
    frequencies: tuple[float, ...]
    offset: float

    @cached_property
    def model(self) -> TransferFunction:
        numerator = np.atleast_1d(np.poly(self.zeros).real)
        denominator = np.atleast_1d(np.poly(self.poles).real)
        speed = 1 / self.constant if self.integrators else 1.0
        numerator = numerator / numerator[-1] * denominator[-1] * self.gain * speed
        return TransferFunction(numerator, np.append(denominator, np.zeros(self.integrators)), self.delay)

    def rng(self, *what: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.number, *what])

    def clock_of(self, rng: np.random.Generator, count: int) -> np.ndarray:
        if not self.irregular:
            return INTERVAL * np.arange(count)
        t = np.cumsum(INTERVAL * rng.uniform(0.5, 1.5, count))
        return t - t[0]

    def input(self, rng: np.random.Generator, t: np.ndarray, past: int) -> np.ndarray:
        """Return the input, including some samples before the record."""
        if self.kind == "multisine":
            phases = rng.uniform(0, 2 * np.pi, len(self.frequencies))
            waves = np.sin(np.outer(t, self.frequencies) + phases).sum(axis=1)
            return np.asarray(waves / np.sqrt(len(self.frequencies) / 2))
        width = self.clock if self.kind == "binary" else max(round(self.constant), 1)
        levels = np.repeat(rng.choice([-1.0, 1.0], t.size // width + 2), width)[int(rng.integers(width)) :][: t.size]
        if self.kind == "step":
            levels[past:] = 0.0
            levels[past + self.step :] = 1.0
        return levels

    @cached_property
    def clean(self) -> Record:
        """Record without noise and offset."""
        rng, past = self.rng(1), 0 if self.at_rest else int(4 * self.constant) + 20
        t = self.clock_of(rng, self.samples + past)
        u = self.input(rng, t, past)
        x = simulate(self.model, HeldSignal(t, u, self.hold), t)
        t = t[past:] - t[past]
        return Record(t, x[past:], HeldSignal(t, u[past:], "zoh"), name=f"record {self.number}")

    def record(self, draw: int) -> Record:
        """Return the record with a draw of the noise."""
        rng, x = self.rng(2, draw), self.clean.y
        e = rng.standard_normal(x.size + 200)
        for k in range(1, e.size) if self.colour else ():
            e[k] += self.colour * e[k - 1]
        deviation = float(np.std(x))
        noise = e[200:] * np.sqrt(1 - self.colour**2) * deviation * 10 ** (-self.snr_db / 20)
        return replace(self.clean, y=x + noise + self.offset * deviation)

    def error(self, model: TransferFunction, hold: str) -> float:
        """Return the error of a model for a new input, from rest."""
        rng = self.rng(3)
        t = self.clock_of(rng, self.samples)
        u = self.input(rng, t, 0)
        x = simulate(self.model, HeldSignal(t, u, self.hold), t)
        found = simulate(model, HeldSignal(t, u, hold), t)
        return float(np.sqrt(np.mean((found - x) ** 2)) / np.std(x))

    def reference(self, options: DelayProfile) -> float:
        """Return the error of the true structure with some options."""
        structure = {"poles": len(self.poles), "zeros": len(self.zeros), "integrators": self.integrators}
        errors = []
        for draw in range(1 + REDRAWS):
            record = self.record(draw)
            signal = HeldSignal(record.input.t, record.input.values, self.hold)
            fit = replace(options, **structure).fit(replace(record, inputs=signal), None)
            errors.append(self.error(fit.model, self.hold))
        return max(errors[0], float(np.sqrt(np.mean(np.square(errors[1:])))))

    @property
    def true_treatment(self) -> DelayProfile:
        """True structure in its true treatment; the state of an integrator has an offset of the output."""
        state = "rest" if self.at_rest else "estimate"
        offset = "estimate" if self.has_offset and not (self.integrators and not self.at_rest) else "none"
        return DelayProfile(1, 0, DELAYS, initial_state=state, offset=offset)


def drawn(seed: int, number: int) -> Case:
    """Draw a record of the distribution."""
    rng = np.random.default_rng([seed, number])
    samples = round(float(np.exp(rng.uniform(np.log(300), np.log(1000)))))
    order, integrators = int(rng.integers(1, 5)), int(rng.random() < 0.25)
    constant = float(np.exp(rng.uniform(np.log(3), np.log(samples / 15))))
    kind = str(rng.choice(["binary", "step", "multisine"]))
    highest = min(rng.uniform(1, 4) / constant, 1.5)
    zeros = [
        float(rng.choice([-1, 1], p=[0.7, 0.3]) * np.exp(rng.uniform(np.log(0.5), np.log(9))) / constant)
        for _ in range(int(rng.integers(0, order)))
    ]
    has_offset = bool(rng.random() < 0.5)
    return Case(
        seed=seed,
        number=number,
        samples=samples,
        poles=tuple(_poles(rng, order - integrators, constant)),
        zeros=tuple(zeros),
        integrators=integrators,
        constant=constant,
        delay=0.0 if rng.random() < 0.3 else float(rng.uniform(0.3, 10)),
        gain=float(rng.choice([-1, 1]) * np.exp(rng.uniform(-1, 1))),
        kind=kind,
        hold="foh" if kind == "multisine" and rng.random() < 0.6 else "zoh",
        irregular=bool(rng.random() < 0.25),
        at_rest=bool(rng.random() < 0.5),
        has_offset=has_offset,
        snr_db=float(rng.uniform(5, 30)),
        colour=0.0 if rng.random() < 0.5 else float(rng.uniform(0.5, 0.95)),
        clock=int(rng.integers(1, max(2, int(constant / 2)) + 1)),
        step=max(round(float(rng.uniform(0.05, 0.15)) * samples), 1),
        frequencies=tuple(np.sort(rng.uniform(0.05 / constant, highest, int(rng.integers(6, 20)))).tolist()),
        offset=float(rng.uniform(-3, 3)) * has_offset,
    )


def _poles(rng: np.random.Generator, count: int, constant: float) -> Iterator[complex]:
    """Yield the dominant pole, or pair, and modes up to six times faster."""
    k = 0
    while k < count:
        speed = (1.0 if k == 0 else float(rng.uniform(1, 6))) / constant
        if count - k >= 2 and rng.random() < 0.5:
            damping = float(rng.uniform(0.1, 0.9))
            pole = speed * complex(-damping, np.sqrt(1 - damping**2))
            yield from (pole, pole.conjugate())
            k += 2
        else:
            yield complex(-speed)
            k += 1


def errors_of(case: Case) -> dict[str, object]:
    """Return the error of the chosen model, and the references."""
    row: dict[str, object] = {"seed": case.seed, "number": case.number, "step": case.step}
    try:
        row["cpu_seconds"], choice = cpu(choose, case.record(0))
    except CtidError as error:
        return {**row, "error": None, "message": str(error)}
    found = choice.options.fit(choice.records, None)
    hold = choice.records[0].input.hold
    row |= {"error": case.error(found.model, hold), "command": choice.words(), "hold": hold}
    row["true"] = case.reference(case.true_treatment)
    if case.number < FIRST_LEAD:
        row["chosen"] = case.reference(replace(choice.options, poles=1, zeros=0))
    return row


def steps(seed: int, count: int) -> Iterator[Case]:
    """Yield step records at rest with short leads."""
    found = filter(_is_step, (drawn(seed, number) for number in itertools.count(FIRST_LEAD)))
    for case, lead in zip(found, itertools.islice(itertools.cycle(LEADS), count), strict=False):
        yield replace(case, at_rest=True, step=lead)


def _is_step(case: Case) -> bool:
    return case.kind == "step" and not case.integrators


def shares(name: str, rows: list[dict[str, object]], reference: str) -> str:
    """Return the shares of errors of at most 1.25 and 2 times a reference."""
    ratios = np.array([np.inf if row["error"] is None else row["error"] / row[reference] for row in rows], dtype=float)
    return f"{name:16}{reference:8}{ratios.size:6}{100 * np.mean(ratios <= 1.25):8.1f}{100 * np.mean(ratios <= 2):8.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--seed", type=int, default=20261126)
    given = parser.parse_args()
    kept = Rows(given.file, "seed", "number", "step")
    cases = [drawn(given.seed, number) for number in range(given.first, given.first + given.records)]
    leads = list(steps(given.seed, given.steps))

    def rows_of(some: list[Case]) -> list[dict[str, object]]:
        return [kept.row((case.seed, case.number, case.step), partial(errors_of, case)) for case in some]

    rows_of([*cases, *leads])

    print(f"{'records':16}{'against':8}{'number':>6}{'<= 1.25':>8}{'<= 2':>8}  [%]")
    for name, belongs in GROUPS.items():
        some = [case for case in cases if belongs(case)]
        for reference in ("chosen", "true") if some else ():
            print(shares(name, rows_of(some), reference))
    far = sum(row["error"] is None or (row["error"] > 1 and row["chosen"] < 0.5) for row in rows_of(cases))
    print(f"errors above 1 where the reference is below .5, and refused records: {far}")
    for lead in LEADS:
        some = [case for case in leads if case.step == lead]
        if some:
            print(shares(f"lead of {lead}", rows_of(some), "true"))


if __name__ == "__main__":
    main()
