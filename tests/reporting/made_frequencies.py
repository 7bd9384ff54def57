"""Hand-made results of an experiment on a signal."""

from ctid_cli.custom_code import STUDIES
from ctid_cli.reporting.results import Results
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import slots
from tests.storage.made_results import MadeResults

COMPARATORS = STUDIES / "finite_time_frequency" / "comparators"
SPEC = f"""\
experiment: made
signal: {{tones: [{{frequency: 2.0}}, {{frequency: [{{until: 10, value: 3.0}}, {{value: 3.5}}]}}]}}
sampling: {{kind: regular, interval: 0.05, duration: 20}}
estimators:
  tracker: {{kind: restarting_least_squares, tones: 2, h: 0.7}}
  whole: {{kind: "{COMPARATORS}/whole_record.py:Esprit", tones: 2}}
success: {{band: 0.1, by: 4}}
monte_carlo: {{runs: 4, seed: 1}}
"""


def of_track(first, second, after, rms, alarms):
    """Return a tracker's result, from the settling times of both tones and of the second one after its step."""
    return {
        "status": "VALID",
        "message": "good",
        "measures": {
            "settling_time_1": first,
            "settling_time_2": second,
            "settling_after_step_1": 0.0,
            "settling_after_step_2": after,
            "rms_1": rms,
            "rms_2": 0.2,
            "false_alarms": alarms,
        },
    }


def of_record(rms):
    """Return the result of an estimator of whole records."""
    return {"status": "VALID", "message": "good", "measures": {"omega_1": 2.0, "rms_1": rms, "rms_2": 0.05}}


def frequency_results(folder, tracks, records):
    """Return results from estimates of the tracker and of ESPRIT; None stands for a failure."""
    file = folder / "made.yaml"
    file.write_text(SPEC, encoding="utf-8")
    manifest = build_plan(load_spec(file)).manifest()
    values = {"tracker": tracks, "whole": records}
    found = {
        slot.key: values[slot.estimator["name"]][slot.key.replicate] or failed("ValueError: too short", "FAILED")
        for slot in slots(manifest)
        if slot.key.replicate < len(values[slot.estimator["name"]])
    }
    return Results(folder, MadeResults(manifest, found, seconds=0.25))
