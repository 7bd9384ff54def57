"""Every kind of input, clock, noise and controller, from specification to estimates."""

import json

import numpy as np
import pytest

from ctid_cli.kinds import KINDS
from ctid_cli.models.controller import ContinuousPid
from ctid_cli.running.plan import build_plan
from ctid_cli.simulation.dataset import LoopOptions, MeasuredSource
from ctid_cli.specification.load import load_spec
from tests.running.fakes import outcomes_of

#: A value for every section, and options of every kind with required ones.
USUAL = {
    "excitation": {"kind": "prbs", "stages": 7, "clock_period": 0.4},
    "sampling": {"kind": "regular", "interval": 0.1, "samples": 400},
    "noise": {"kind": "white", "snr_db": 30},
}
MULTISINE = {"lowest_frequency": 0.3, "highest_frequency": 6.0, "period": 20.0, "phases": "schroeder"}
OPTIONS = {
    "gbn": {"clock_period": 0.2, "switching_probability": 0.3},
    "multisine": MULTISINE,
    "step": {"time": 2.0},
    "steps": {"times": [0, 5, 12], "levels": [1, -1, 2]},
    "file": {"file": "input.csv"},
    "irregular": {"interval": 0.1, "samples": 400},
    "uniform_intervals": {"low": 0.05, "high": 0.15, "samples": 400},
    "jitter": {"interval": 0.1, "samples": 400, "largest_shift": 0.03},
    "arma": {"numerator": [1], "denominator": [1, -0.5], "snr_db": 30},
}
RELAY = {"relay": {"amplitude": 1.0, "hysteresis": 0.2}}
GAINS = {"kp": 0.5, "ti": 2.0, "td": 0.2, "filter_time": 0.1, "discretisation": "tustin"}
REFERENCE = {"kind": "gaussian", "clock_period": 1.0}
LOOP = {"excitation": None, "noise": {"kind": "white", "variance": 1e-3}}


def specification(**sections):
    common = {
        "experiment": "one",
        "system": {"numerator": [2], "denominator": [1, 2], "delay": 0.35},
        "estimators": {"known": {"kind": "srivc", "poles": 1, "zeros": 0, "delay": 0.35}},
        "monte_carlo": {"runs": 1, "seed": 1},
    }
    found = {key: value for key, value in {**USUAL, **common, **sections}.items() if value is not None}
    return json.dumps(found)


def specifications():
    """Yield specifications that use every kind in at least one experiment."""
    kinds = [list(KINDS[section]) for section in USUAL]
    for k in range(max(map(len, kinds))):
        chosen = {section: names[k % len(names)] for section, names in zip(USUAL, kinds, strict=True)}
        yield (
            "-".join(chosen.values()),
            {section: {"kind": kind} | OPTIONS.get(kind, USUAL[section]) for section, kind in chosen.items()},
        )
    yield "instants", {"sampling": {"kind": "irregular", "file": "instants.csv"}}
    yield "pid", LOOP | {"loop": {"controller": {"continuous_pid": GAINS}, "reference": REFERENCE}}
    yield "relay", LOOP | {"loop": {"controller": RELAY}}


@pytest.fixture
def plan_of(tmp_path):
    """Return the plan of a specification with some sections."""
    write_columns(tmp_path / "input.csv", "t,u", [0, 3, 4, 11, 13], [1, -1, 1, -1, 1])
    write_columns(tmp_path / "instants.csv", "t", 7.0 + 0.1 * np.arange(400) ** 1.02)

    def call(**sections):
        (tmp_path / "spec.yaml").write_text(specification(**sections))
        return build_plan(load_spec(tmp_path / "spec.yaml"))

    return call


def write_columns(file, header, *columns):
    np.savetxt(file, np.column_stack(columns), delimiter=",", header=header, comments="")


@pytest.mark.parametrize("sections", [pytest.param(sections, id=name) for name, sections in specifications()])
def test_every_kind_runs_from_its_specification_to_its_estimates(plan_of, sections):
    (outcome,) = outcomes_of(plan_of(**sections).job(0, 0))
    estimate = outcome.result
    assert estimate["status"] == "CONVERGED"
    # 30 dB and a few hundred samples: the noise causes much smaller errors than a fifth.
    np.testing.assert_allclose([*estimate["numerator"], estimate["denominator"][1]], [2.0, 2.0], rtol=0.2)


def test_gains_in_continuous_time_follow_the_interval(plan_of, tmp_path):
    loop = {"controller": {"continuous_pid": {"kp": 0.5, "ti": [2.0, 4.0]}}, "reference": {"kind": "gaussian"}}
    sampling = {"kind": "regular", "interval": [0.05, 0.1], "samples": 50}
    for cell in plan_of(**LOOP, loop=loop, sampling=sampling).data_cells:
        kp = 0.5 + 0.5 * cell.swept["interval"] / cell.swept["ti"]
        np.testing.assert_allclose(cell.dataset(0).record.loop.controller.numerator, [kp, -0.5])
    # A measured loop accepts gains in seconds too.
    file = tmp_path / "record.csv"
    file.write_text("t,r,u,y\n" + "".join(f"{0.1 * k},{k % 3},{k % 5},{k % 7}\n" for k in range(30)))
    source = MeasuredSource(str(file), reference="r", loop=LoopOptions(ContinuousPid(kp=1.0, ti=2.0)))
    np.testing.assert_allclose(source.dataset(0).record.loop.controller.numerator, [1.05, -1.0])
