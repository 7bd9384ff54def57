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

import _timing  # noqa: F401  (one thread for linear algebra)

import numpy as np
from _kinds import KINDS, packed, quantities, unpacked

from ctid_cli import FrequencyData, identify, identify_frequency_response
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


def equivalent(case, found, printed):
    """Return the true quantities, for a stated repetition those of the equivalent model of nearest delay."""
    truth = quantities(unpacked(packed(case.systems), case.systems))
    for each in getattr(found.fit, "equivalents", ()):
        if each.input and each.input not in case.repeats:
            continue
        delay, gain = (f"{each.input}_{one}" if each.input else one for one in ("delay", "static_gain"))
        shift = abs(each.delay - printed[delay].estimate)
        times = round((printed[delay].estimate - truth[delay]) / shift)
        truth[delay] += times * shift
        truth[gain] *= each.sign ** abs(times)
    return truth


def count(case, options, found, rows):
    """Count each quantity of a fit in the rows of gain, delay and poles."""
    printed = {item.name: item for item in (*found.estimates, *found.derived)}
    interval = 0.0 if isinstance(case.data, FrequencyData) else float(np.diff(case.data.t).min())
    bounds = getattr(options, "delay_bounds", None)
    right = found.fit.model.order == sum(each.order for each in case.systems.values())
    for name, value in equivalent(case, found, printed).items():
        group = next((each for each in ("gain", "delay") if name.endswith(each)), "poles")
        if name not in printed or name not in case.half_widths or (group == "poles" and not right):
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
            repeats = group != "poles" and any(name.startswith(each) for each in case.repeats)
            row["held"] += 1
            row["well"] += case.half_widths[name] < WELL * size and not repeats


def fit_of(case, options):
    """Return a fit, with NumPy's warnings as errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        fit = identify_frequency_response if isinstance(case.data, FrequencyData) else identify
        return fit(case.data, options)


def reason_of(error):
    """Return an error without numbers in brackets, with its place in the source."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = "" if isinstance(error, CtidError) else f" ({last.filename.rpartition('/')[2]}, line {last.lineno})"
    return f"{type(error).__name__}: {str(error).partition(' (')[0][:150]}{place}"


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
    warm = KINDS["regular"](np.random.default_rng(0), 0)
    fit_of(warm, warm.variants["range"])  # compiles, or loads the compiled functions
    heads = ["    n" + "".join(f"{name:>6}" for name in columns) for columns in COLUMNS.values()]
    print(" " * 35 + " |" + " |".join(f"{group:>{len(head)}}" for group, head in zip(COLUMNS, heads, strict=True)))
    print(f"{'kind: variant':26}   n fail |{' |'.join(heads)} | CPU s", flush=True)
    for kind in kinds:
        print_kind(kind, records, seed)


if __name__ == "__main__":
    given = sys.argv[1:] + DEFAULTS[len(sys.argv) - 1 :]
    main(int(given[0]), int(given[1]), given[2:] or [*KINDS])
