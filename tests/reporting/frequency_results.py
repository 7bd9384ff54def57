"""Results of the study of finite-time frequency estimation from short records, computed in this process."""

from ctid_cli.reporting.figures.finite_time_frequency import CONFIGS
from ctid_cli.reporting.study import data_folder
from ctid_cli.running.plan import build_plan
from ctid_cli.running.worker import Job, run_job
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.sealed import seal_image
from ctid_cli.storage.version import Origin


def config(name):
    return data_folder("configs") / CONFIGS[f"finite-time-frequency/{name}"]


def run_here(name, out, overrides):
    """Run an experiment of the study with some settings replaced, and store it as ``ctid run`` would."""
    plan = build_plan(load_spec(config(name), overrides))
    results = {}
    for task in plan.tasks():
        job = Job(plan.data_cells[task.cell], task.replicate, 1, tuple(plan.keys(task)))
        results |= {outcome.key: outcome.result for outcome in run_job(job)}
    folder = out / plan.experiment
    folder.mkdir(parents=True)
    image, _, _ = seal_image(plan.manifest(), (Origin("c", "p", ()),), results)
    (folder / "runs.h5").write_bytes(image)
    return folder
