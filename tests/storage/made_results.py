"""Stored estimates made by a test, which may be changed until they are first read as a table."""

import io
from functools import cached_property
from pathlib import Path

import h5py

from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.export import Export, write_export, write_runs
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.manifest import Outcome, slots

ORIGIN = Origin("c", "p", ())
ORIGINS = (ORIGIN,)
#: A plan of two estimators, one of them from two starts, at two noise levels.
SPEC = {
    "experiment": "toys",
    "system": {"numerator": [2], "denominator": [1, 2], "delay": 0.35},
    "excitation": {"kind": "prbs", "stages": 6, "clock_period": 0.2, "amplitude": 1.0},
    "sampling": {"kind": "regular", "interval": 0.1, "samples": 400},
    "noise": {"kind": "white", "snr_db": [10, 20]},
    "estimators": {
        "search": {"kind": "td_srivc", "poles": 1, "zeros": 0, "delay_bounds": [0, 2]},
        "known": {"kind": "svf", "poles": 1, "zeros": 0, "delay": 0.35, "svf_cutoff": 2.0},
    },
    "starts": {"initial_delay": [0.2, {"uniform": [0, 1]}]},
    "monte_carlo": {"runs": 3, "seed": 1},
    "success": {"delay_relative_error": 0.2},
}


def plan_of(runs=3, **changes):
    """Return the plan with other data sets or sections."""
    return build_plan(load_spec({**SPEC, **changes}), runs)


def outcome(key, delay=0.35):
    """Return a made-up estimate; one in five is a failure."""
    if key.replicate % 5 == 4:
        return Outcome(key, failed("ValueError: singular\n  svf.py:3 in fit", "FAILED"), 0.25)
    numbers = {"delay": delay + key.replicate / 7, "numerator": [2.0], "denominator": [1.0, 2.0 + key.replicate / 3]}
    errors = {"standard_errors": {"b0": 0.1, "delay": 0.01}, "cost": 0.5, "fit_percent": 90.0, "iterations": 3}
    return Outcome(key, no_result() | {"status": "CONVERGED", "message": "τ̂ found"} | numbers | errors, 0.25, 0.125)


def outcomes_of(manifest):
    """Return made-up estimates of a whole plan."""
    return [outcome(key) for key in dict.fromkeys(slot.key for slot in slots(manifest))]


def run_folder(manifest, place, outcomes=None, origin=ORIGIN, **info):
    """Write a folder like that of a run that has computed some or all estimates of its plan."""
    place.mkdir(parents=True)
    log = open_journal(place / "journal.sqlite")
    log.write_spec(b"# toys\n")
    session = log.begin(manifest, origin, f"began {place.name}", info)
    log.add(outcomes_of(manifest) if outcomes is None else outcomes, session)
    write_runs(place, log)
    log.end(session, "ended", "finished")
    log.close()
    return place


class MadeResults(Estimates):
    """Results by key with a common computing time, except given ones [s]; some have a CPU time."""

    def __init__(self, manifest, results, origins=ORIGINS, seconds=0.02):
        self.plan, self.given_origins, self.results = manifest, origins, results
        self.usual, self.seconds = seconds, {}
        self._all, self._places, self._read = None, None, {}

    @property
    def manifest(self):
        return self.plan

    @property
    def origins(self):
        return self.given_origins

    @cached_property
    def export(self):
        image = export_image(self.plan, self.given_origins, self.results)
        return Export(h5py.File(io.BytesIO(image), "r"), Path("runs.h5"))

    def _times(self, data_hash, estimator_hash, first, last):
        return {
            (key.replicate, key.start): (self.seconds.get(key, self.usual), result.get("cpu_seconds"))
            for key, result in self.results.items()
            if (key.data_hash, key.estimator_hash) == (data_hash, estimator_hash) and first <= key.replicate <= last
        }


def export_image(manifest, origins, results):
    """Return the bytes of ``runs.h5`` for some results."""
    image = io.BytesIO()
    planned = [(slot, results[slot.key]) for slot in slots(manifest) if slot.key in results]
    write_export(image, manifest, lambda: origins, lambda: planned)
    return image.getvalue()
