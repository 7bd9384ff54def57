"""Hand-made results: a plan of one experiment and estimates for part of it."""

import pytest

from ctid_cli.reporting.results import Results
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Key
from tests.storage.made_results import MadeResults


def make_estimate(delay, status="CONVERGED", numerator=(8.0,), denominator=(1.0, 2.8, 4.0), **more):
    failed = status == "FAILED"
    row = {
        "status": status,
        "message": "ValueError: singular\n  svf.py:3 in fit" if failed else "converged",
        "start_delay": 0.0,
        "delay": None if failed else delay,
        "numerator": None if failed else list(numerator),
        "denominator": None if failed else list(denominator),
        "standard_errors": None if failed else {"b0": 0.4, "a1": 0.1, "a2": 0.2, "delay": 0.01},
        "cost": None if failed else 0.25,
        "fit_percent": None if failed else 90.0,
        "validation_fit_percent": None,
        "iterations": None if failed else 7,
        "condition_number": None if failed else 12.0,
    }
    return row | more


@pytest.fixture
def estimate():
    """Return a worker's result for an estimated delay."""
    return make_estimate


@pytest.fixture
def add_estimator():
    """Add an estimator to results, from its delays by SNR and start; None for an estimator without starts."""

    def add(results, name, found):
        manifest, stored = results.manifest, results.stored
        labels = {start: "none" if start is None else start for _, start in found}
        manifest["estimators"].append(
            manifest["estimators"][0] | {"name": name, "hash": name, "starts": list(labels.values())}
        )
        manifest["spec"]["estimators"][name] = manifest["spec"]["estimators"]["existing"]
        if None in labels:
            manifest["starts"]["none"] = None
        for (snr, start), values in found.items():
            for replicate, value in enumerate(values):
                key = Key(f"cell{snr:g}", replicate, name, labels[start])
                stored.results[key], stored.seconds[key] = value, 0.5

    return add


@pytest.fixture
def make_results(tmp_path):
    """Return results of a case with SNR 5 and 15 dB and one estimator, from the estimated delays."""

    def make(found, *, experiment="useful-redundancy/case1-regular", snrs=(5.0, 15.0), swept=True, origins=1, **spec):
        starts = {"0.0": 0.0, "uniform(0, 9)": "random"}
        system = {"numerator": [2.0], "denominator": [0.25, 0.7, 1.0], "delay": 8.0}
        success = {"delay_relative_error": 0.01}
        estimator = {"kind": "td_srivc", "poles": 2, "zeros": 0, "delay_bounds": [0.0, 15.0]}
        settings = {
            "experiment": experiment,
            "system": system,
            "sampling": {"kind": "regular", "interval": 0.05, "samples": 4000},
            "noise": {"kind": "white", "snr_db": list(snrs) if swept else snrs[0]},
            "estimators": {"existing": estimator},
            "starts": {"initial_delay": [0.0, {"uniform": [0.0, 9.0]}]},
            "monte_carlo": {"runs": 4, "seed": 1},
            "success": success,
        } | spec
        manifest = {
            "experiment": experiment,
            "runs": 4,
            "seed": 1,
            "spec_hash": "0" * 16,
            "spec": settings,
            "success": settings["success"],
            "data_cells": [
                {
                    "hash": f"cell{snr:g}",
                    "replicates": 4,
                    "swept": {"snr_db": snr} if swept else {},
                    "content": {"system": system, "noise": {"kind": "white", "snr_db": snr}},
                }
                for snr in snrs
            ],
            "estimators": [
                {
                    "name": "existing",
                    "kind": "td_srivc",
                    "hash": "existing",
                    "swept": {},
                    "content": estimator,
                    "starts": list(starts),
                }
            ],
            "starts": starts,
        }
        results = {
            Key(f"cell{snr:g}", replicate, "existing", start): value
            for (snr, start), values in found.items()
            for replicate, value in enumerate(values)
        }
        return Results(tmp_path, MadeResults(manifest, results, tuple(Origin(str(k), "x", ()) for k in range(origins))))

    return make
