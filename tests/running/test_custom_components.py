"""Custom components and measures: same results in workers, and a failure affects only its own estimates."""

import json
import os
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import RefusedError, SpecError
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.plan import build_plan
from ctid_cli.running.trial import load_tried
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.estimates import read_estimates, read_stored
from tests.running.fakes import outcomes_of
from tests.specification.written import CLOSED_LOOP, SIGNAL

CODE = """\
import os, random, signal
from dataclasses import dataclass
from typing import Literal
import numpy as np
import ctid_cli
from level import LEVEL

@dataclass(frozen=True)
class Mean(ctid_cli.Estimator):
    mischief: Literal["none", "raise", "die", "nan", "always", "global", "mistake", "fail"] = "none"
    def fit(self, record, start):
        print("a word that must not get into the answer")
        if self.mischief == "global":
            return {"parameters": {"mean": random.random()}}
        if self.mischief == "fail":
            raise LookupError("never")
        if self.mischief == "mistake":
            return {"parameters": {"mean": recrod.y.mean()}}
        if record.y[0] > 0.0 or self.mischief == "always":
            if self.mischief == "raise":
                raise LookupError("no mean")
            if self.mischief in ("die", "always"):
                os.kill(os.getpid(), signal.SIGSEGV)
            if self.mischief == "nan":
                return {"parameters": {"mean": float("nan")}}
        return {"parameters": {"mean": record.y.mean()}, "standard_errors": {"mean": 0.1}}

@dataclass(frozen=True)
class Noise(ctid_cli.Noise):
    unseeded: bool = False
    def generate(self, output, rng):
        if self.unseeded:
            return np.random.randn(output.size)
        # The sign of the first sample changes from one data set to the next: 0.32, -0.57
        return LEVEL * rng.standard_normal(output.size) - output

@dataclass(frozen=True)
class Slowest(ctid_cli.Measure):
    unit = "s"
    scale: float = 1.0
    def value(self, fit, data):
        data.record.y[:] = 0.0
        fit.model.denominator[:] = 1.0
        return self.scale * data.record.t[-1]

class Lost(ctid_cli.Measure):
    def value(self, fit, data):
        raise KeyError(f"nothing at {hex(id(self))}")

class Odd(ctid_cli.Measure):
    def value(self, fit, data):
        return "much"

class Random(ctid_cli.Measure):
    def value(self, fit, data):
        return np.random.random()

class Tones(ctid_cli.Measure):
    def value(self, fit, data):
        return fit.track.frequencies[-1, 0] / data.source.signal.frequencies_at(np.zeros(1))[0, 0]
"""
SPEC = """\
experiment: custom
system:      {numerator: [2], denominator: [1, 2]}
excitation:  {kind: prbs, stages: 6, clock_period: 0.2, amplitude: 1.0}
sampling:    {kind: regular, interval: 0.1, samples: 200}
noise:       {kind: "./parts.py:Noise"}
estimators:
  good:      {kind: "./parts.py:Mean"}
  bad:       {kind: "./parts.py:Mean", mischief: [raise, die, nan]}
monte_carlo: {runs: 2, seed: 2}
"""
#: Built-in estimators for custom measures.
OWN = (
    "noise={kind: white, standard_deviation: 0.1}",
    "estimators={one: {kind: srivc, poles: 1, zeros: 0}, two: {kind: delay_profile, poles: 1, zeros: 0, "
    "delay_bounds: [0, 1]}}",
    "monte_carlo.runs=2",
)


@pytest.fixture
def file(tmp_path):
    (tmp_path / "parts.py").write_text(CODE, encoding="utf-8")
    (tmp_path / "level.py").write_text("LEVEL = 0.5\n", encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    return tmp_path / "spec.yaml"


def planned(file, *overrides):
    return build_plan(load_tried(file, overrides, allow_code=True))


def run(plan, out):
    return run_experiment(plan, out, jobs=2, warm=lambda plan: None)


def ctid(*arguments, code=0):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.output
    return done.output


def asked(*classes):
    return "measures=[bias, " + ", ".join(f'{{kind: "./parts.py:{name}"}}' for name in classes) + "]"


@pytest.mark.slow
def test_workers_run_it_failures_stay_alone_and_changed_code_is_not_mixed_in(file, tmp_path, capfd):
    plan, out = planned(file), tmp_path / "out"
    summary = run(plan, out)
    assert capfd.readouterr().out == ""
    stored = read_stored(out)
    results = {
        (row["estimator"], row.get("mischief"), row["replicate"]): result
        for result, row in zip(stored.results.values(), stored.rows(), strict=True)
    }
    jobs = [plan.job(0, replicate) for replicate in range(2)]
    bad = [k for k, job in enumerate(jobs) if job.cell.dataset(job.replicate).record.y[0] > 0]
    assert bad == [0]
    for k, job in enumerate(jobs):
        here = outcomes_of(replace(job, wanted=job.wanted[:1]))[0].result
        assert results["good", None, k] == here
        for mischief, status in (("raise", "FAILED"), ("die", "CRASHED"), ("nan", "FAILED")):
            found = results["bad", mischief, k]
            assert found["status"] == status if k in bad else found == here
    message = results["bad", "raise", bad[0]]["message"]
    assert "LookupError: no mean" in message
    assert "parts.py:" in message
    assert "mean is nan; give a status" in results["bad", "nan", bad[0]]["message"]
    assert summary.failed == 3 * len(bad)

    # Comments do not change results; other numbers do.
    level = file.with_name("level.py")
    level.write_text("LEVEL = 0.5  # of the noise\n", encoding="utf-8")
    assert run(planned(file), out).computed == 0
    before = {file.name: file.read_bytes() for file in out.iterdir() if file.is_file()}
    level.write_text("LEVEL = 0.6\n", encoding="utf-8")
    with pytest.raises(RefusedError, match="results of other code"):
        run(planned(file), out)
    assert {file.name: file.read_bytes() for file in out.iterdir() if file.is_file()} == before
    # Results can be read without the code.
    os.unlink(file.with_name("parts.py"))
    assert json.dumps(list(read_stored(out)))


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["noise.unseeded=true"], "noise.kind: depends on the global random state"),
        (["estimators.bad.mischief=global"], "estimators.bad.kind: depends on the global random state"),
        (["estimators.bad.mischief=mistake"], "estimators.bad.kind: .*NameError: name 'recrod' is not defined"),
        ([*OWN, asked("Random")], "measures.Random: depends on the global random state"),
    ],
)
def test_errors_on_the_first_data_set_are_raised_before_the_run(file, overrides, said):
    with pytest.raises(SpecError, match=said):
        planned(file, *overrides)


GOOD = "estimators={good: {kind: './parts.py:Mean'}}"
UNKNOWN = "returns mean; true values are known of a1, b0, delay only"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([GOOD], [UNKNOWN]),
        (
            [GOOD, "success={delay_relative_error: 0.1}", "system.delay=0.1"],
            [UNKNOWN, "returns no delay, so that it never meets success.delay_relative_error"],
        ),
        (["estimators.bad.mischief=fail"], [UNKNOWN, "fails on the first data set: LookupError: never ("]),
    ],
)
def test_what_is_odd_on_the_first_data_set_is_a_warning(file, overrides, words):
    heard = [text for text in planned(file, *overrides).spec.warnings if "estimators." in text]
    assert [word in text for text, word in zip(heard, words, strict=True)] == [True] * len(words)


def test_the_value_of_a_measure_is_stored_with_every_estimate_and_in_every_table(file, tmp_path):
    run(planned(file, *OWN, asked("Slowest")), tmp_path / "custom")
    estimates, out = read_estimates(tmp_path / "custom"), ("custom", "--out", tmp_path)
    assert estimates["custom_measures"].tolist() == [{"Slowest": pytest.approx(19.9)}] * 4
    assert ctid("export", *out).count(",19.9") == 4
    assert "Slowest [s]" in ctid("table", *out)
    rows = json.loads(ctid("table", *out, "--measure", "Slowest", "--format", "json"))
    assert [(row["value"], row["unit"], row["n"]) for row in rows] == [(pytest.approx(19.9), "s", 2)] * 2
    assert "did you mean 'Slowest'" in ctid("table", *out, "--measure", "Slowet", code=2)
    # Changes made by a measure do not affect later computations.
    run(planned(file, *OWN), tmp_path / "plain")
    plain = read_estimates(tmp_path / "plain")
    assert plain["numerator"].tolist() == estimates["numerator"].tolist()
    assert plain["custom_measures"].isna().all()


def test_an_estimate_is_kept_when_a_measure_raises(file):
    plan = planned(file, *OWN, asked("Lost", "Slowest", "Odd"))
    assert any("fails on the first data set, with the estimator 'one': KeyError" in said for said in plan.spec.warnings)
    for outcome in outcomes_of(plan.job(0, 1)):
        assert outcome.result["custom_measures"] == {"Lost": None, "Odd": None, "Slowest": pytest.approx(19.9)}
        assert outcome.result["status"] == "CONVERGED"
        message = outcome.result["message"]
        assert "\nMeasure Lost: KeyError: 'nothing at 0x…' (parts.py:" in message
        assert "\nMeasure Odd: ComponentError: Odd.value returned str; one number is expected" in message


def test_what_is_measured_belongs_to_the_key_of_a_row(file):
    def cell(*overrides):
        return build_plan(load_spec(file, overrides, allow_code=True)).data_cells[0].hash

    assert cell() == cell("measures=[bias]")
    scaled = 'measures=[{kind: "./parts.py:Slowest", scale: 2.0}]'
    assert len({cell(), cell(asked("Slowest")), cell(asked("Odd")), cell(scaled)}) == 4


@pytest.mark.parametrize(("spec", "name", "most"), [(CLOSED_LOOP, "Slowest", 1e9), (SIGNAL, "Tones", 1.5)])
def test_measures_of_signals_and_of_sums_of_submodels(file, spec, name, most):
    file.write_text(spec, encoding="utf-8")
    plan = build_plan(load_spec(file, [asked(name)], allow_code=True))
    for outcome in outcomes_of(plan.job(0, 0)):
        assert 0.5 < outcome.result["custom_measures"][name] < most, outcome.result["message"]


@pytest.mark.parametrize(
    ("measures", "said"),
    [
        ("{kind: './parts.py:Slowest', scale: [1, 2]}", "measures[0].scale: must be a number, not a list of 2;"),
        ("{kind: './parts.py:Slowest', size: 1}", "measures[0].size: there is no such key here"),
        ("{kind: rmse}", "measures[0].kind: must be one of ./file.py:Class, package.module:Class, not the text 'rmse'"),
        ("{name: x}", "measures[0].kind: is missing; allowed: ./file.py:Class, package.module:Class"),
        ("{kind: './parts.py:dataclass'}", "measures[0].kind: "),
        ("{kind: './parts.py:Odd', name: a b}", "measures[0].name: 'a b' cannot be used here: a name has letters"),
        ("{kind: './parts.py:Odd', name: rmse}", "measures[0]: another measure is called 'rmse'; give this one"),
        ("3", "measures[0]: must be a text, not 3; write it in quotes: '3'; a mapping with a kind is allowed too"),
    ],
)
def test_mistakes_have_their_places(file, measures, said):
    with pytest.raises(SpecError, match=r"--set:1:\d+: ") as error:
        load_spec(file, [f"measures=[{measures}]"], allow_code=True)
    assert said in str(error.value)
