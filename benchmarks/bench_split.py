"""Choice of structure on the beginning of measured records, judged on the rest.

    python benchmarks/bench_split.py FILE DATA... [--grid GRID] [--share .6] [--poles 6]

DATA is a file that ``ctid_cli.read_record`` reads, with optional columns and level of the input before the record:
``arm.csv``, ``arm.csv,u2,y2``, ``step.csv,u,y,0``. The structure is chosen on the first 60 % of the samples. A model is
judged by its fit on the rest: simulated with the input of the whole record; free responses of its poles and a constant,
for an integrator a slope too, are estimated on the rest, as for a validation record.

The reference is the best on the rest of all structures of 1 to 6 poles with all fewer zeros, with and without an
integrator, in the chosen treatment and in six others, in the chosen range of the delay. Each choice adds a line to
FILE (JSON), each grid one to GRID (FILE with the suffix .grid unless given); existing ones are not computed again.
Choices of two versions with the same GRID have the same reference, with the range of the first one.

Columns: fit of the chosen model on both parts, the best fit on the rest and its structure, the regret (their
difference), and processor time of the choice.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

from _timing import cpu

import numpy as np
from _rows import Rows

from ctid_cli import DelayProfile, Given, HeldSignal, Record, choose, read_record, simulate
from ctid_cli.errors import CtidError, DataError
from ctid_cli.estimation.optimum.best_model import best_of_orders
from ctid_cli.estimation.optimum.box import box_of
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch
from ctid_cli.estimators.measured_fit import fitted
from ctid_cli.signals.record import with_hold

#: State, input before the record, and offset.
TREATMENTS = (
    ("rest", "first", "estimate"),
    ("rest", None, "none"),
    ("rest", None, "estimate"),
    ("estimate", None, "estimate"),
    ("rest", "first", "drift"),
    ("estimate", None, "drift"),
)


def read(given):
    """Return a record and the level of its input before it, if given."""
    path, *rest = given.split(",")
    columns = dict(zip(("input", "output"), rest, strict=False))
    return read_record(path, **columns), float(rest[2]) if len(rest) > 2 else None


def first_part(record, share):
    """Return the first samples of a record."""
    n = round(share * record.n_samples)
    signal = record.input
    kept = signal.t <= record.t[n - 1]
    return Record(record.t[:n], record.y[:n], replace(signal, t=signal.t[kept], values=signal.values[kept]))


def fits(model, record, hold, n):
    """Return the fit on the rest of a record [%]."""
    signal = HeldSignal(record.input.t, record.input.values - record.input.values[0], hold)
    x, since = simulate(model, signal, record.t)[n:], record.t[n:] - record.t[n]
    poles = model.poles[np.abs(model.poles) > 0]
    free = np.exp(np.outer(since, poles[poles.imag >= 0]))
    columns = [free.real, free.imag[:, poles[poles.imag >= 0].imag > 0], np.ones((since.size, 1))]
    columns += [since[:, None]] * (poles.size < model.poles.size)
    use = record.valid[n:]
    y, psi = record.y[n:][use], np.hstack(columns)[use]
    e = y - x[use]
    e = e - psi @ np.linalg.lstsq(psi, e, rcond=None)[0]
    return float(100 * (1 - np.linalg.norm(e) / np.linalg.norm(y - y.mean())))


def grid(part, record, hold, treatments, delays, most):
    """Return the structures of a grid with their fits on the rest of the record."""
    found = []
    for state, before, offset in treatments:
        for integrators in (0, 1) if offset != "drift" else (0,):
            own = {"integrators": integrators, "initial_state": state, "input_before": before, "offset": offset}
            options = DelayProfile(1 - integrators, 0, delays, **own)
            try:
                measured = options.prepare(with_hold(part, hold)).laid_out
            except DataError:  # a constant input with an unknown level before it
                continue
            # One search for all structures.
            box = box_of(measured.problem, measured.treatment.delay_bounds)
            search = StructureSearch(measured.problem, box, effort=QUICK)
            for poles in range(1 - integrators, most - integrators + 1):
                for zeros in range(poles + integrators):
                    laid_out = measured.with_degrees(poles + integrators, [zeros])
                    fit = fitted(laid_out, best_of_orders(search, poles, zeros), None)
                    on_rest = fits(fit.model, record, hold, part.n_samples)
                    found.append([on_rest, poles, zeros, integrators, state, before, offset])
    return sorted(found, key=lambda row: -row[0])


def chosen(name, given, share):
    """Return the choice on the first part and its fit on the rest."""
    record, before = read(given)
    part = first_part(record, share)
    row = {"name": name, "share": share}
    try:
        row["cpu"], choice = cpu(choose, part, Given(input_before=before))
        fit = choice.options.fit(choice.records, None)
    except CtidError as error:
        return {**row, "message": str(error)}
    options, hold = choice.options, choice.records[0].hold
    row |= {name: getattr(options, name) for name in ("poles", "zeros", "integrators")}
    row |= {"treatment": [options.initial_state, options.input_before, options.offset], "hold": hold}
    row |= {"delays": options.delay_bounds, "delay": fit.model.delay, "command": " ".join(choice.words())}
    y = part.y[fit.used[0]]
    error = np.linalg.norm(fit.residuals[0]) / np.linalg.norm(y - y.mean())
    return row | {"first": float(100 * (1 - error)), "fit": fits(fit.model, record, hold, part.n_samples)}


def grid_row(name, data, row, share, poles):
    """Return the best structures of a grid in several treatments."""
    record, _ = read(data)
    part, delays = first_part(record, share), tuple(row["delays"])
    treatments = dict.fromkeys([tuple(row["treatment"]), *TREATMENTS])
    seconds, found = cpu(grid, part, record, row["hold"], treatments, delays, poles)
    return {"name": name, "share": share, "cpu": seconds, "found": found[:50]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("data", nargs="+")
    parser.add_argument("--grid", type=Path)
    parser.add_argument("--share", type=float, default=0.6)
    parser.add_argument("--poles", type=int, default=6)
    given = parser.parse_args()
    files = given.file, given.grid or given.file.with_suffix(".grid")
    rows, grids = (Rows(file, "name", "share") for file in files)
    print(f"{'record':36}{'chosen':>7} {'treatment':24}{'first':>7}{'rest':>7}  {'best':34}{'regret':>7}{'CPU s':>7}")
    regrets, spent = [], []
    for data in given.data:
        name = ",".join([Path(data.split(",")[0]).stem, *data.split(",")[1:]])
        key = name, given.share
        row = rows.row(key, partial(chosen, name, data, given.share))
        if "message" in row:
            print(f"{name:36}{row['message']}")
            continue
        best, *what = grids.row(key, partial(grid_row, name, data, row, given.share, given.poles))["found"][0]
        regrets.append(best - row["fit"])
        spent.append(row["cpu"])
        print(
            f"{name:36}{words(row['poles'], row['zeros'], row['integrators']):>7} {words(*row['treatment']):24}"
            f"{row['first']:7.2f}{row['fit']:7.2f}  {f'{best:.2f} {words(*what[:3])} {words(*what[3:])}':34}"
            f"{regrets[-1]:7.2f}{row['cpu']:7.1f}",
            flush=True,
        )
    if regrets:
        above = sum(each > 6 for each in regrets)
        print(f"median regret {np.median(regrets):.2f}, above 6: {above} of {len(regrets)}; {sum(spent):.1f} CPU s")


def words(*parts):
    return "/".join("-" if each is None else str(each) for each in parts)


if __name__ == "__main__":
    main()
