"""Custom measures: stored with every estimate, in every table, and never the loss of an estimate."""

import json

import pytest
from typer.testing import CliRunner

from ctid_cli.errors import RefusedError, SpecError
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.estimates import read_estimates
from tests.running.fakes import outcomes_of
from tests.specification.written import CLOSED_LOOP, SIGNAL

CODE = """
from dataclasses import dataclass
import numpy as np
from ctid_cli import Measure

@dataclass(frozen=True)
class Slowest(Measure):
    unit = "s"
    scale: float = 1.0
    def value(self, fit, data):
        data.record.y[:] = 0.0
        fit.model.denominator[:] = 1.0
        return self.scale * data.record.t[-1]

class Lost(Measure):
    def value(self, fit, data):
        raise KeyError(f"nothing at {hex(id(self))}")

class Odd(Measure):
    def value(self, fit, data):
        return "much"

class Random(Measure):
    def value(self, fit, data):
        return np.random.random()

class Tones(Measure):
    def value(self, fit, data):
        return fit.track.frequencies[-1, 0] / data.source.signal.frequencies_at(np.zeros(1))[0, 0]
"""
SYSTEM = """
experiment: measured
system: {numerator: [2], denominator: [1, 2], delay: 0.35}
excitation: {kind: prbs, stages: 6, clock_period: 0.5}
sampling: {kind: regular, interval: 0.1, samples: 200}
noise: {kind: white, standard_deviation: 0.1}
estimators:
  one: {kind: srivc, poles: 1, zeros: 0}
  search: {kind: delay_profile, poles: 1, zeros: 0, delay_bounds: [0, 1]}
monte_carlo: {runs: 2, seed: 1}
measures: [rmse]
"""


def ctid(*arguments, code=0):
    from ctid_cli.cli.main import app

    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.output
    return done


@pytest.fixture
def file(tmp_path):
    (tmp_path / "measures.py").write_text(CODE, encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(SYSTEM, encoding="utf-8")
    return tmp_path / "spec.yaml"


def asked(*classes):
    return "measures=[bias, " + ", ".join(f'{{kind: "./measures.py:{name}"}}' for name in classes) + "]"


def run(file, *measures):
    said = ctid("run", file, "--allow-code", "--jobs", "1", "--out", file.parent / "out", "--set", asked(*measures))
    return read_estimates(file.parent / "out" / "measured"), said.output


def test_a_value_is_stored_with_every_estimate_and_in_every_table(file, tmp_path):
    estimates, _ = run(file, "Slowest")
    assert estimates["custom_measures"].tolist() == [{"Slowest": pytest.approx(19.9)}] * 4
    assert ctid("export", "measured", "--out", tmp_path / "out").stdout.count(",19.9") == 4
    out = ("measured", "--out", tmp_path / "out")
    assert "Slowest [s]" in ctid("table", *out).stdout
    rows = json.loads(ctid("table", *out, "--measure", "Slowest", "--format", "json").stdout)
    assert [(row["value"], row["unit"], row["n"]) for row in rows] == [(pytest.approx(19.9), "s", 2)] * 2
    assert "did you mean 'Slowest'" in ctid("table", *out, "--measure", "Slowet", code=2).stderr
    # Nothing that a measure changes reaches what comes after it.
    assert ctid("run", file, "--jobs", "1", "--out", tmp_path / "plain", "--quiet").stdout == ""
    plain = read_estimates(tmp_path / "plain" / "measured")
    assert plain["numerator"].tolist() == estimates["numerator"].tolist()
    assert plain["custom_measures"].isna().all()


def test_an_estimate_is_kept_when_a_measure_raises(file):
    estimates, said = run(file, "Lost", "Slowest", "Odd")
    assert estimates["custom_measures"].tolist() == [{"Lost": None, "Odd": None, "Slowest": pytest.approx(19.9)}] * 4
    assert set(estimates["status"]) == {"CONVERGED"}
    message = estimates["message"][0]
    assert "\nMeasure Lost: KeyError: 'nothing at 0x…' (measures.py:17)" in message
    assert "\nMeasure Odd: ComponentError: Odd.value returned str; one number is expected" in message
    assert "measures.Lost: fails on the first data set, with the estimator 'one': KeyError" in said


def test_what_is_measured_belongs_to_the_key_of_a_row(file):
    def cell(*overrides):
        return build_plan(load_spec(file, overrides, allow_code=True)).data_cells[0].hash

    assert cell() == cell("measures=[bias]")
    scaled = 'measures=[{kind: "./measures.py:Slowest", scale: 2.0}]'
    assert len({cell(), cell(asked("Slowest")), cell(asked("Odd")), cell(scaled)}) == 4


def test_a_measure_of_a_signal(tmp_path):
    (tmp_path / "measures.py").write_text(CODE, encoding="utf-8")
    spec = tmp_path / "spec.yaml"
    spec.write_text(SIGNAL + "\n" + asked("Tones").replace("=", ": ") + "\n", encoding="utf-8")
    ctid("run", spec, "--allow-code", "--jobs", "1", "--runs", "1", "--out", tmp_path / "out")
    (folder,) = (path.parent for path in (tmp_path / "out").rglob("runs.h5"))
    found = [row["Tones"] for row in read_estimates(folder)["custom_measures"]]
    assert found == pytest.approx([1.0] * len(found), abs=0.5)


@pytest.mark.parametrize(
    ("measures", "said"),
    [
        ("{kind: './measures.py:Slowest', scale: [1, 2]}", "measures[0].scale: must be a number, not a list of 2;"),
        ("{kind: './measures.py:Slowest', size: 1}", "measures[0].size: there is no such key here"),
        ("{kind: rmse}", "measures[0].kind: must be one of ./file.py:Class, package.module:Class, not the text 'rmse'"),
        ("{name: x}", "measures[0].kind: is missing; allowed: ./file.py:Class, package.module:Class"),
        ("{kind: './measures.py:dataclass'}", "measures[0].kind: "),
        ("{kind: './measures.py:Odd', name: a b}", "measures[0].name: 'a b' cannot be used here: a name has letters"),
        ("{kind: './measures.py:Odd', name: rmse}", "measures[0]: another measure is called 'rmse'; give this one"),
        ("3", "measures[0]: must be a text, not 3; write it in quotes: '3'; a mapping with a kind is allowed too"),
    ],
)
def test_mistakes_have_their_places(file, measures, said):
    with pytest.raises(SpecError, match=r"--set:1:\d+: ") as error:
        load_spec(file, [f"measures=[{measures}]"], allow_code=True)
    assert said in str(error.value)


def test_nothing_is_imported_without_permission_and_randomness_is_refused(file):
    with pytest.raises(RefusedError, match=r"measures\[1\].kind: names code"):
        load_spec(file, [asked("Slowest")])
    refused = ctid("run", file, "--allow-code", "--set", asked("Random"), "--out", file.parent / "out", code=2)
    assert "measures.Random: depends on the global random state" in refused.stderr


def test_fits_of_submodels_can_be_measured(tmp_path):
    (tmp_path / "measures.py").write_text(CODE, encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(CLOSED_LOOP, encoding="utf-8")
    plan = build_plan(load_spec(tmp_path / "spec.yaml", [asked("Slowest")], allow_code=True))
    for outcome in outcomes_of(plan.job(0, 0)):
        assert outcome.result["custom_measures"]["Slowest"] > 0, outcome.result["message"]
