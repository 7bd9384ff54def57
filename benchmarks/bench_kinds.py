"""Printed intervals against the truth for kinds of records in which numbers are easily wrong.

Usage: ``python benchmarks/bench_kinds.py [RECORDS] [SEED] [KIND ...]``; ``given`` stands for all kinds with a given
structure. BENCH_PROCESSES=2 divides the records between two processes. Each record is fitted with several options, one
row of the table each. For gain, delay, poles (time constants, natural frequencies, damping), other parameters (the
coefficients) and step response (at instants up to four slowest time constants after the delay) the columns are in %:

- cover: given intervals that contain the truth;
- ref: estimates with a given interval whose error is below the half-width of the reference;
- long: median length of the given intervals, relative to the reference;
- far: of all, intervals that miss it by more than two lengths;
- held: without an interval;
- well: without one, although least squares about the true model gives 95 % half-widths below a quarter of the value (of
  the sampling interval, for a shorter delay);
- sign: intervals of a gain that contain only values of the wrong sign.

The reference is the same estimator, with the state and offset of the fit, if it knew the true model for its standard
errors and the true covariance of the noise, with 1.96 of them to each side. Only models of the true structure have one.

A known delay is not counted; a chosen one has an interval of length 0, which may miss by .1 %. Poles, other parameters
and step responses are counted if the number of poles is right. Where a fit states that a repeating input has equivalent
models, gain and delay are compared with the equivalent of nearest delay. Warnings of NumPy count as failures; those of
responses, after a fit, also leave the fit in the table.

At the end, kinds with a given structure are pooled, with 95 % confidence for independent records, and groups with a
coverage below 91 % are listed; "5 %" and "95 %" are quantiles of the relative lengths, and held is in %.
"""

import os
import sys
import time
import traceback
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from types import SimpleNamespace

import _timing  # noqa: F401  (one thread for linear algebra)

import numpy as np
from _kinds import GIVEN_KINDS, KINDS, instants

from ctid_cli import FrequencyData, identify, identify_frequency_response
from ctid_cli.errors import CtidError

#: Number of records of each kind, and seed.
DEFAULTS = ["20", "6301"]
#: Half-width of a well determined value, relative to it.
WELL = 0.25
#: Lengths of an interval from which the truth is far, and relative error if the length is zero.
FAR, EXACT = 2.0, 1e-3
#: Coverage below which a group of quantities is listed.
LOW = 0.91
#: Printed columns by group.
COMMON = ("cover", "ref", "long", "far", "held")
COLUMNS = {
    "gain": (*COMMON, "well", "sign"),
    "delay": (*COMMON, "well"),
    "poles": (*COMMON, "well"),
    "other": COMMON,
    "step": COMMON,
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
    truth = case.truth
    for each in getattr(found.fit, "equivalents", ()):
        if each.input and each.input not in case.repeats:
            continue
        delay, gain = (f"{each.input}_{one}" if each.input else one for one in ("delay", "static_gain"))
        shift = abs(each.delay - printed[delay].estimate)
        times = round((printed[delay].estimate - truth[delay]) / shift)
        truth[delay] += times * shift
        truth[gain] *= each.sign ** abs(times)
    return truth


def group_of(name):
    """Return the group of a quantity from its name."""
    last = name.rpartition("_")[2]
    if " " in name or last in ("gain", "delay"):
        return "step" if " " in name else last
    return "other" if last[0] in "ab" and last[1:].isdigit() else "poles"


def responses(case, found):
    """Return the points of the step responses as printed quantities; frequency responses are only computed."""
    points = {}
    for name, system in case.systems.items():
        model = found.of_input(name) if name else found
        band = model.step_response(instants(system))
        for k, (value, low, high) in enumerate(zip(band.value, band.lower, band.upper, strict=True)):
            each = f"{name}_step {k}" if name else f"step {k}"
            points[each] = SimpleNamespace(name=each, estimate=value, low=low, high=high, status="free", reason="")
        model.frequency_response()
    return points


def count(case, options, found, points):
    """Return counts of the quantities of a fit by group, and the relative lengths of their intervals."""
    rows = {group: (Counter(), []) for group in COLUMNS}
    printed = {item.name: item for item in (*found.estimates, *found.derived)} | points
    response = isinstance(case.data, FrequencyData)
    interval = 0.0 if response else float(np.diff(case.data.t).min())
    bounds = getattr(options, "delay_bounds", None)
    parts = list(case.systems.values())
    right = found.fit.model.order == (parts[0].order if case.common else sum(each.order for each in parts))
    used = np.ones(len(case.psi), dtype=bool) if response else found.fit.used[0]
    truth = equivalent(case, found, printed)
    same = right and set(printed) >= {name for name in truth if group_of(name) == "other"}
    reference = case.reference(found.options, used) if same else {}
    for name, value in truth.items():
        group = group_of(name)
        if name not in printed or name not in case.half_widths or (group not in ("gain", "delay") and not right):
            continue
        if group == "delay" and bounds is not None and bounds[0] == bounds[1]:
            continue
        if group in ("other", "step") and (case.repeats or (printed[name].status == "fixed" and group == "other")):
            continue
        (row, lengths), intervals, width = rows[group], intervals_of(printed[name]), reference.get(name, 0.0)
        if group == "step" and value == 0 and intervals and intervals[0][0] == 0 == intervals[0][1]:
            continue  # before the delay
        row["n"] += 1
        if intervals:
            missed, far = misses(intervals, value)
            row["given"] += 1
            row["cover"] += not missed
            row["far"] += far
            row["sign"] += group == "gain" and all(low * value < 0 > high * value for low, high in intervals)
            if width > 0:
                row["compared"] += 1
                row["ref"] += abs(printed[name].estimate - value) <= width
                lengths.append(sum(high - low for low, high in intervals) / (2 * width))
        else:
            size = max(abs(value), interval if group == "delay" else 0.0)
            repeats = group != "poles" and any(name.startswith(each) for each in case.repeats)
            row["held"] += 1
            row["well"] += case.half_widths[name] < WELL * size and not repeats
    return rows


# --- fits ----------------------------------------------------------------------------------------------


def fit_of(case, options):
    """Return a fit."""
    fit = identify_frequency_response if isinstance(case.data, FrequencyData) else identify
    return fit(case.data, options)


def strictly(function, failures, *arguments):
    """Return the result of a function with NumPy's warnings as errors; note the error and return None if it fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return function(*arguments)
        except Exception as error:
            failures.append(reason_of(error))
            return None


def reason_of(error):
    """Return an error without numbers in brackets, with its place in the source."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = "" if isinstance(error, CtidError) else f" ({last.filename.rpartition('/')[2]}, line {last.lineno})"
    return f"{type(error).__name__}: {str(error).partition(' (')[0][:150]}{place}"


def fits_of(kind, seed, number):
    """Return the failures, counts by group and CPU time of the fits of one record, by variant."""
    case = KINDS[kind](np.random.default_rng([seed, number, *kind.encode()]), number)
    fits = {}
    for variant, options in case.variants.items():
        begin, failures, rows = time.process_time(), [], {}
        found = strictly(fit_of, failures, case, options)
        if found is not None:
            points = strictly(responses, failures, case, found)
            rows = count(case, options, found, points or {})
        fits[variant] = failures, rows, time.process_time() - begin
    return fits


# --- tables --------------------------------------------------------------------------------------------


def percent(counts, columns):
    """Return the columns of one group of quantities [%], after their number, from the counts of each record."""
    row = sum((each for each, _ in counts), Counter())
    lengths = [length for _, each in counts for length in each]
    total = {"cover": row["given"], "sign": row["given"], "ref": row["compared"]}
    found = f"{row['n']:5d}"
    for name in columns:
        part, whole = (
            (min(np.median(lengths or [0.0]), 99.0), len(lengths) > 0) if name == "long" else (row[name], row["n"])
        )
        whole = total.get(name, whole)
        found += f"{100 * part / whole:6.0f}" if whole else "     -"
    return found


def print_kind(kind, fits):
    """Print a row for each variant from the fits of each record, and the errors of failed fits."""
    for variant in sorted({variant for each in fits for variant in each}):
        failures, rows, spent = zip(*(each[variant] for each in fits if variant in each), strict=True)
        parts = [percent([row[group] for row in rows if row], columns) for group, columns in COLUMNS.items()]
        failed = Counter(reason for reasons in failures for reason in set(reasons))
        bad = sum(len(reasons) > 0 for reasons in failures)
        print(f"{f'{kind}: {variant}':28}{len(rows):4d}{bad:5d} |{' |'.join(parts)} | {np.mean(spent):5.2f}")
        for reason, times in failed.items():
            print(f"    {variant}: {times} x {reason}")
    sys.stdout.flush()


def share(counts, name="cover", total="given"):
    """Return a share of given intervals, with its 95 % half-width for independent records."""
    part, whole = (np.array([sum(row[each] for row, _ in record) for record in counts]) for each in (name, total))
    if not whole.sum():
        return np.nan, np.nan
    found = part.sum() / whole.sum()
    return found, 1.96 * np.sqrt(np.sum((part - found * whole) ** 2)) / whole.sum()


def print_summary(fits):
    """Print the coverage of all kinds with a given structure, and the groups in which it is low."""
    records = {kind: each for kind, each in fits.items() if kind in GIVEN_KINDS}
    print(f"\n{'given structures':18}{'n':>7}{'cover':>14}{'ref':>14}{'long':>7}{'5 %':>7}{'95 %':>7}{'held':>7}")
    low = []
    for group in COLUMNS:
        every = [[rows[group] for _, rows, _ in each.values() if rows] for one in records.values() for each in one]
        row = sum((one for record in every for one, _ in record), Counter())
        lengths = [length for record in every for _, each in record for length in each]
        cover, ref = (
            f"{100 * found:7.1f} +-{100 * half:4.1f}" for found, half in (share(every), share(every, "ref", "compared"))
        )
        long, low_end, high_end = 100 * np.quantile(lengths or [np.nan], [0.5, 0.05, 0.95])
        held = 100 * row["held"] / max(row["n"], 1)
        print(f"{group:18}{row['n']:7d}{cover}{ref}{long:7.0f}{low_end:7.0f}{high_end:7.0f}{held:7.1f}")
        for kind, one in records.items():
            for variant in sorted({variant for each in one for variant in each}):
                cell = [[each[variant][1][group]] for each in one if variant in each and each[variant][1]]
                found, half = share(cell)
                if found < LOW:
                    low.append(f"{kind}: {variant}, {group}: {100 * found:.0f} +- {100 * half:.0f}")
    print(f"Below {100 * LOW:.0f} %:\n    " + "\n    ".join(low or ["none"]))


def main(records, seed, kinds, processes):
    warm = KINDS["regular"](np.random.default_rng(0), 0)
    fit_of(warm, warm.variants["range"])  # compiles, or loads the compiled functions
    heads = ["    n" + "".join(f"{name:>6}" for name in columns) for columns in COLUMNS.values()]
    print(" " * 37 + " |" + " |".join(f"{group:>{len(head)}}" for group, head in zip(COLUMNS, heads, strict=True)))
    print(f"{'kind: variant':28}   n fail |{' |'.join(heads)} | CPU s", flush=True)
    fits = {}
    pool = ProcessPoolExecutor(processes) if processes > 1 else None
    for kind in kinds:
        fits[kind] = list((pool.map if pool else map)(partial(fits_of, kind, seed), range(records)))
        print_kind(kind, fits[kind])
    if pool:
        pool.shutdown()
    if set(kinds) & set(GIVEN_KINDS):
        print_summary(fits)


if __name__ == "__main__":
    given = sys.argv[1:] + DEFAULTS[len(sys.argv) - 1 :]
    wanted = [kind for each in given[2:] for kind in (GIVEN_KINDS if each == "given" else [each])]
    main(int(given[0]), int(given[1]), wanted or [*KINDS], int(os.environ.get("BENCH_PROCESSES", "1")))
