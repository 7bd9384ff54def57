"""Variants of four kinds of records for which numbers of a fit are easily wrong, fitted freely and typed.

    python benchmarks/bench_variants.py FILE [--records 60] [--seed 7] [--first 0]

The kinds take turns:

- one_step: one step from an operating point of a slow, slightly nonlinear plant of two or three lags; typed 2/0 and 2/1
  (poles/zeros) without a delay.
- half_period: a square wave, symmetric or between zero and a level, cut from a long one or begun at rest, to a plant of
  one or two poles, about 200 samples; the delay is zero, small, or up to .9 of the half period; typed 1/0 or 2/0.
- longdelay: one step, and a first-order response to it in the second half of the rest of the record; typed 1/0.
- quantised_square: a square wave to a plant of two lags, output rounded to .5 to 3 % of its range; typed 2/0.

Typed structures have no other option. Columns, in numbers of fits:

- refused;
- sign: static gains with an interval that contains only values of the wrong sign, if the fit states no equivalent model
  of a repeating input;
- withheld: gains without an interval that the record determines: least squares about the true model give a 95 %
  half-width below a quarter of the value; for the nonlinear plant, the response has reached 95 % of its end;
- far: delays farther than two lengths of their interval from the truth and, in a square wave that was cut, from each
  delay that is equivalent to it;
- poles: more than two poles above the true order;
- integrators, which no plant has.

Each fit adds a line to FILE (JSON); existing ones are not computed again.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from _timing import cpu

import numpy as np
from _kinds import Case, drawn_gain, drawn_system, square_record, step_record
from _rows import Rows
from bench_kinds import WELL, intervals_of, misses

from ctid_cli import Given, HeldSignal, Record, TransferFunction, identify
from ctid_cli.errors import CtidError

#: Poles above the true order that count as too many.
TOO_MANY = 2
COUNTS = ("refused", "sign", "withheld", "far", "poles", "integrators")


@dataclass(frozen=True, eq=False)
class Variant:
    """A record with what is true of it, and the options with which it is fitted."""

    record: Record
    order: int
    gain: float
    #: Whether the record determines the gain.
    determined: bool
    #: True delay, and the shift to the next equivalent one; infinite without.
    delay: float
    shift: float
    typed: dict[str, Given] = field(default_factory=dict)

    @classmethod
    def of(cls, case: Case, shift: float = np.inf, **typed: Given) -> "Variant":
        """Return the variant of a simulated case."""
        system, width = case.systems[""], case.half_widths["static_gain"]
        gain = case.truth["static_gain"]
        return cls(case.data, system.order, gain, width < WELL * abs(gain), system.delay, shift, typed)


def one_step(rng: np.random.Generator) -> Variant:
    n, start, size = int(rng.integers(300, 801)), int(rng.integers(3, 60)), float(rng.choice([-2.0, 1.0, 4.0, 50.0]))
    gain, bend = float(rng.choice([-1, 1]) * np.exp(rng.uniform(-1, 2))), rng.uniform(-0.25, 0.4)
    slowest = n * rng.uniform(0.05, 0.15)
    lags = [slowest, *slowest * rng.uniform(0.1, 0.7, int(rng.integers(1, 3)))]
    fine = 10
    x, z = np.zeros(len(lags)), np.zeros(n)
    for k in range(n):
        z[k] = x[-1]
        for _ in range(fine):
            # The first lag is slower, or faster, the farther it is from the operating point.
            into = np.r_[float(k >= start), x[:-1]]
            x = x + (into - x) / fine / (np.array(lags) * np.r_[1 + bend * x[0], np.ones(len(lags) - 1)])
    response = gain * abs(size)
    y = rng.uniform(-3, 3) * response + gain * size * z + rng.uniform(0.001, 0.01) * response * rng.standard_normal(n)
    t = np.arange(float(n))
    record = Record(t, y, HeldSignal(t, float(rng.choice([0.0, 1.0])) * size + size * (t >= start)))
    known = (0.0, 0.0)
    typed = {
        f"{poles}/{zeros}": Given(poles=poles, zeros=zeros, delay_bounds=known) for poles, zeros in ((2, 0), (2, 1))
    }
    return Variant(record, len(lags), gain, bool(z[-1] > 0.95), 0.0, np.inf, typed)


def half_period(rng: np.random.Generator) -> Variant:
    half, n, poles = int(rng.integers(8, 31)), int(rng.integers(160, 261)), int(rng.integers(1, 3))
    interval = 0.1
    delay = interval * half * float(rng.choice([0.0, rng.uniform(0.02, 0.2), rng.uniform(0.3, 0.9)]))
    system = drawn_system(rng, poles, interval * half * rng.uniform(0.1, 0.5), delay)
    low, start = float(rng.choice([-1.0, 0.0])), str(rng.choice(["cut", "cut", "rest"]))
    noise = {"db": rng.uniform(25.0, 45.0)}
    case = square_record(rng, system, n, half, start, low, int(rng.integers(0, 2 * half)), interval, **noise)
    shift = interval * half if start == "cut" else np.inf
    return Variant.of(case, shift, **{f"{poles}/0": Given(poles=poles, zeros=0)})


def longdelay(rng: np.random.Generator) -> Variant:
    n, interval = int(rng.integers(150, 401)), 0.1
    left = 0.9 * n * interval
    system = drawn_system(rng, 1, left * rng.uniform(0.02, 0.08), left * rng.uniform(0.5, 0.8))
    noise = {"db": rng.uniform(20, 40), "offset": float(rng.choice([0.0, 2.0]))}
    case = step_record(rng, system, n, n // 10, float(rng.choice([1.0, 3.0])), interval, **noise)
    return Variant.of(case, **{"1/0": Given(poles=1, zeros=0)})


def quantised_square(rng: np.random.Generator) -> Variant:
    half, n, interval = int(rng.integers(8, 31)), int(rng.integers(160, 301)), 0.1
    slow = interval * half * rng.uniform(0.1, 0.5)
    poles = -1.0 / (slow * np.array([1.0, rng.uniform(0.1, 0.6)]))
    a = np.poly(poles)
    delay = interval * float(rng.choice([0.0, rng.uniform(0.0, 3.0)]))
    system = TransferFunction([drawn_gain(rng) * a[-1]], a, delay)
    start, low = str(rng.choice(["cut", "rest"])), float(rng.choice([-1.0, 0.0]))
    # A range of about two deviations for a response that settles.
    noise = {"db": float(rng.choice([80.0, 40.0])), "quantum": 2 * rng.uniform(0.005, 0.03)}
    case = square_record(rng, system, n, half, start, low, int(rng.integers(0, 2 * half)), interval, **noise)
    shift = interval * half if start == "cut" else np.inf
    return Variant.of(case, shift, **{"2/0": Given(poles=2, zeros=0)})


KINDS: dict[str, Callable[[np.random.Generator], Variant]] = {
    each.__name__: each for each in (one_step, half_period, longdelay, quantised_square)
}


def row_of(variant: Variant, given: Given) -> dict:
    """Return what a fit prints, and what is wrong with it."""
    try:
        seconds, found = cpu(identify, variant.record, given)
    except CtidError as error:
        return {"refused": True, "message": str(error)}
    printed = {item.name: item for item in (*found.estimates, *found.derived)}
    stated = bool(getattr(found.fit, "equivalents", ()))
    options, row = found.options, {"cpu": seconds}
    row |= {name: getattr(options, name) for name in ("poles", "zeros", "integrators")}
    row |= {"treatment": [options.initial_state, options.input_before, options.offset], "equivalents": stated}
    row |= {"true_order": variant.order, "true_gain": variant.gain, "true_delay": variant.delay}
    gain, delay = printed.get("static_gain"), printed.get("delay")
    if gain is not None:
        intervals = row["gain"] = intervals_of(gain)
        row["gain_estimate"] = gain.estimate
        wrong = all(low * variant.gain < 0 > high * variant.gain for low, high in intervals)
        row["sign"] = bool(intervals) and wrong and not stated
    row["withheld"] = variant.determined and not (gain is not None and intervals_of(gain))
    fixed = options.delay_bounds[0] == options.delay_bounds[1]
    if delay is not None and not fixed:
        intervals = row["delay"] = intervals_of(delay)
        shifts = np.arange(-20, 21) * variant.shift if np.isfinite(variant.shift) else [0.0]
        row["far"] = bool(intervals) and all(misses(intervals, variant.delay + each)[1] for each in shifts)
    row["poles_over"] = options.poles + options.integrators - variant.order
    return row


def wrong(row: dict) -> dict[str, bool]:
    """Return which columns count a fit."""
    over = row.get("poles_over", 0) > TOO_MANY
    return {name: bool(row.get(name, False)) for name in COUNTS} | {"poles": over}


def print_table(rows: list[dict]) -> None:
    print(f"{'kind':20}{'fits':8}{'n':>4}" + "".join(f"{name:>12}" for name in COUNTS) + f"{'CPU s':>8}{'median':>8}")
    for kind in KINDS:
        own = [row for row in rows if row["kind"] == kind]
        for fits in dict.fromkeys(row["fits"] for row in own):
            some = [row for row in own if row["fits"] == fits]
            counts = "".join(f"{sum(wrong(row)[name] for row in some):12}" for name in COUNTS)
            spent = [row["cpu"] for row in some if "cpu" in row] or [np.nan]
            print(f"{kind:20}{fits:8}{len(some):4}{counts}{sum(spent):8.0f}{np.median(spent):8.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--records", type=int, default=60)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    kept, rows = Rows(given.file, "seed", "number", "fits"), []
    for number in range(given.first, given.first + given.records):
        kind = list(KINDS)[number % len(KINDS)]
        variant = KINDS[kind](np.random.default_rng([given.seed, number]))
        for fits, options in {"free": Given(), **variant.typed}.items():
            about = {"seed": given.seed, "number": number, "kind": kind, "fits": fits}
            key = given.seed, number, fits
            rows.append(kept.row(key, lambda known=about, given=options, of=variant: known | row_of(of, given)))
    print_table(rows)


if __name__ == "__main__":
    main()
