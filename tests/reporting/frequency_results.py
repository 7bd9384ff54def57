"""Results of studies computed in this process."""

import itertools

from ctid_cli.reporting.study import find_study
from ctid_cli.storage.identity import Origin
from tests.running.fakes import outcomes_of
from tests.storage.made_results import export_image

STUDY = find_study("finite-time-frequency")


def run_here(name, out, overrides, study=STUDY):
    """Run an experiment of a study with some settings replaced, and store it as ``ctid run`` would."""
    plan = study.plan(name, overrides)
    results = {}
    for cell, replicate in itertools.product(range(len(plan.data_cells)), range(plan.runs)):
        results |= {outcome.key: outcome.result for outcome in outcomes_of(plan.job(cell, replicate))}
    folder = out / plan.experiment
    folder.mkdir(parents=True)
    (folder / "runs.h5").write_bytes(export_image(plan.manifest(), (Origin("c", "p", ()),), results))
    return folder
