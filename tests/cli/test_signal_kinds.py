"""Every kind of input, clock, noise and controller in an experiment, from its specification to its estimates."""

import json

import numpy as np
import pytest

from ctid_cli.kinds import KINDS
from ctid_cli.models.controller import ContinuousPid
from ctid_cli.running.plan import build_plan
from ctid_cli.simulation.dataset import LoopOptions, MeasuredSource
from ctid_cli.specification.load import load_spec

#: A value for every section, and options for every kind that has some without a default.
USUAL = {
    "excitation": {"kind": "prbs", "stages": 7, "clock_period": 0.4},
    "sampling": {"kind": "regular", "interval": 0.1, "samples": 400},
    "noise": {"kind": "white", "snr_db": 30},
}
OPTIONS = {
    ("excitation", "gbn"): {"clock_period": 0.2, "switching_probability": 0.3},
    ("excitation", "multisine"): {
        "lowest_frequency": 0.3, "highest_frequency": 6.0, "period": 20.0, "phases": "schroeder",
    },
    ("excitation", "step"): {"time": 2.0},
    ("excitation", "steps"): {"times": [0, 5, 12], "levels": [1, -1, 2]},
    ("excitation", "file"): {"file": "input.csv"},
    ("sampling", "irregular"): {"interval": 0.1, "samples": 400},
    ("sampling", "uniform_intervals"): {"low": 0.05, "high": 0.15, "samples": 400},
    ("sampling", "jitter"): {"interval": 0.1, "samples": 400, "largest_shift": 0.03},
    ("noise", "arma"): {"numerator": [1], "denominator": [1, -0.5], "snr_db": 30},
}  # fmt: skip


def specification(name, **sections):
    common = {
        "experiment": name,
        "system": {"numerator": [2], "denominator": [1, 2], "delay": 0.35},
        "estimators": {"known": {"kind": "srivc", "poles": 1, "zeros": 0, "delay": 0.35}},
        "monte_carlo": {"runs": 1, "seed": 1},
    }
    return {key: value for key, value in {**USUAL, **common, **sections}.items() if value is not None}


def options(section, kind):
    usual = USUAL[section] if USUAL[section]["kind"] == kind else {}
    return usual | {"kind": kind} | OPTIONS.get((section, kind), {})


def specifications():
    """Every kind in one experiment at least, with others beside it."""
    kinds = [list(KINDS[section]) for section in USUAL]
    for k in range(max(map(len, kinds))):
        chosen = {section: names[k % len(names)] for section, names in zip(USUAL, kinds, strict=True)}
        yield "-".join(chosen.values()), {section: options(section, kind) for section, kind in chosen.items()}
    yield "instants", {"sampling": {"kind": "irregular", "file": "instants.csv"}}
    gains = {"kp": 0.5, "ti": 2.0, "td": 0.2, "filter_time": 0.1, "discretisation": "tustin"}
    reference = {"kind": "gaussian", "clock_period": 1.0}
    quiet = {"excitation": None, "noise": {"kind": "white", "variance": 1e-3}}
    yield "pid", quiet | {"loop": {"controller": {"continuous_pid": gains}, "reference": reference}}
    yield "relay", quiet | {"loop": {"controller": {"relay": {"amplitude": 1.0, "hysteresis": 0.2}}}}


@pytest.fixture(scope="module")
def results(tmp_path_factory, ctid, without_workers):
    """Results folder of all experiments, run once."""
    folder = tmp_path_factory.mktemp("kinds")
    (folder / "input.csv").write_text("t,u\n0,1\n3,-1\n4,1\n11,-1\n13,1\n")
    instants = 7.0 + 0.1 * np.arange(400) ** 1.02
    (folder / "instants.csv").write_text("t\n" + "\n".join(map(str, instants)) + "\n")
    files = []
    for name, sections in specifications():
        files.append(folder / f"{name}.yaml")
        files[-1].write_text(json.dumps(specification(name, **sections)))
    ctid("run", *files, "--quiet", "--out", folder / "results")
    return folder / "results"


@pytest.mark.parametrize("name", [name for name, _ in specifications()])
def test_every_kind_runs_from_its_specification_to_its_estimates(ctid, results, name):
    (estimate,) = json.loads(ctid("export", name, "--format", "json", "--out", results).stdout)
    assert estimate["status"] == "CONVERGED"
    # 30 dB and a few hundred samples: a fifth is far more than the noise can do.
    np.testing.assert_allclose([*estimate["numerator"], estimate["denominator"][1]], [2.0, 2.0], rtol=0.2)


def test_gains_in_continuous_time_follow_the_interval(tmp_path):
    loop = {"controller": {"continuous_pid": {"kp": 0.5, "ti": [2.0, 4.0]}}, "reference": {"kind": "gaussian"}}
    sampling = {"kind": "regular", "interval": [0.05, 0.1], "samples": 50}
    noise = {"kind": "white", "variance": 0.01}
    file = tmp_path / "spec.yaml"
    file.write_text(json.dumps(specification("one", loop=loop, sampling=sampling, noise=noise, excitation=None)))
    for cell in build_plan(load_spec(file, ())).data_cells:
        kp = 0.5 + 0.5 * cell.swept["interval"] / cell.swept["ti"]
        np.testing.assert_allclose(cell.dataset(0).record.loop.controller.numerator, [kp, -0.5])


RELAY = {"relay": {"amplitude": 1.0}}
WRONG = {
    "a relay and gains": ({"controller": RELAY | {"pid": {"kp": 1}}}, "relay: gives the controller a second time"),
    "a gain twice": ({"controller": {"continuous_pid": {"kp": 1, "ti": 1, "ki": 1}}}, "ti gives the same as ki"),
    "no gain": ({"controller": {"continuous_pid": {"ti": 1.0}}}, "the controller is zero, so there is no loop"),
    "too much gain": ({"controller": {"continuous_pid": {"kp": 30.0}}}, "the loop with the true system is unstable"),
    "no reference": ({"controller": {"continuous_pid": {"kp": 1.0}}, "reference": None}, "loop.reference: is missing"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_loops_are_told(ctid, tmp_path, name):
    loop, message = WRONG[name]
    file = tmp_path / "spec.yaml"
    noise = {"kind": "white", "variance": 0.01}
    sections = {"loop": {"reference": {"kind": "gaussian"}} | loop, "excitation": None, "noise": noise}
    file.write_text(json.dumps(specification("one", **sections)))
    assert message in " ".join(ctid("validate", file, code=2).stderr.split())


def test_only_a_linear_controller_has_closed_loop_instruments_and_theory(ctid, tmp_path):
    file = tmp_path / "spec.yaml"
    sections = {"loop": {"controller": RELAY}, "excitation": None, "noise": {"kind": "white", "variance": 0.01}}
    file.write_text(json.dumps(specification("one", **sections)))
    assert "theory is given here for linear controllers" in " ".join(ctid("accuracy", file).stdout.split())
    closed = {"known": {"kind": "srivc", "poles": 1, "zeros": 0, "delay": 0.35, "instruments": "closed_loop"}}
    file.write_text(json.dumps(specification("one", **sections, estimators=closed)))
    said = ctid("validate", file, code=2).stderr
    assert "closed-loop instruments need the reference and the controller" in " ".join(said.split())


def test_what_draws_nothing_needs_no_seed(ctid, tmp_path):
    file = tmp_path / "spec.yaml"
    designed = options("excitation", "multisine")
    sections = {"excitation": designed, "noise": None, "monte_carlo": None}
    file.write_text(json.dumps(specification("one", **sections)))
    ctid("validate", file)
    file.write_text(json.dumps(specification("one", **sections | {"excitation": designed | {"phases": "random"}})))
    assert "monte_carlo: is missing, and the excitation is random" in ctid("validate", file, code=2).stderr
    file.write_text(json.dumps(specification("one", **sections | {"noise": {"kind": ["white"]}})))
    assert "noise.kind: must be one of white" in ctid("validate", file, code=2).stderr


def test_a_measured_loop_takes_gains_in_seconds(tmp_path):
    file = tmp_path / "record.csv"
    file.write_text("t,r,u,y\n" + "".join(f"{0.1 * k},{k % 3},{k % 5},{k % 7}\n" for k in range(30)))
    loop = LoopOptions(ContinuousPid(kp=1.0, ti=2.0))
    record = MeasuredSource(str(file), reference="r", loop=loop).dataset(0).record
    np.testing.assert_allclose(record.loop.controller.numerator, [1.05, -1.0])
