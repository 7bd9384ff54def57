"""Custom components in worker processes: the same numbers as here, and a failure costs its own estimates only."""

import json
import os
from dataclasses import replace

import pytest

from ctid_cli.errors import RefusedError, SpecError
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.plan import build_plan
from ctid_cli.running.trial import load_tried
from ctid_cli.storage.estimates import read_stored
from tests.running.fakes import outcomes_of

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
        # The sign of the first sample changes from one data set to the next: 0.64, -0.08, ...
        return LEVEL * rng.standard_normal(output.size) - output
"""

SPEC = """\
experiment: custom-run
system:      {numerator: [2], denominator: [1, 2]}
excitation:  {kind: prbs, stages: 6, clock_period: 0.2, amplitude: 1.0}
sampling:    {kind: regular, interval: 0.1, samples: 200}
noise:       {kind: "./parts.py:Noise"}
estimators:
  good:      {kind: "./parts.py:Mean"}
  bad:       {kind: "./parts.py:Mean", mischief: [raise, die, nan]}
monte_carlo: {runs: 4, seed: 5}
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "parts.py").write_text(CODE, encoding="utf-8")
    (tmp_path / "level.py").write_text("LEVEL = 0.5\n", encoding="utf-8")
    return tmp_path


def planned(folder, *changes):
    text = SPEC
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "spec.yaml").write_text(text, encoding="utf-8")
    return build_plan(load_tried(folder / "spec.yaml", allow_code=True))


def jobs(plan):
    return [plan.job(0, replicate) for replicate in range(plan.runs)]


def test_workers_run_it_failures_stay_alone_and_changed_code_is_not_mixed_in(folder, tmp_path, capfd):
    plan = planned(folder)
    summary = run_experiment(plan, tmp_path / "out", jobs=2, warm=lambda plan: None)
    assert capfd.readouterr().out == ""
    stored = read_stored(tmp_path / "out")
    results = {
        (row["estimator"], row.get("mischief"), row["replicate"]): result
        for result, row in zip(stored.results.values(), stored.rows(), strict=True)
    }
    first = [job.cell.dataset(job.replicate).record.y[0] for job in jobs(plan)]
    bad = [k for k, y in enumerate(first) if y > 0]
    assert 0 < len(bad) < 4
    for k in range(4):
        job = jobs(plan)[k]
        here = outcomes_of(replace(job, wanted=job.wanted[:1]))[0].result
        assert results["good", None, k] == here
        for mischief, status in (("raise", "FAILED"), ("die", "CRASHED"), ("nan", "FAILED")):
            found = results["bad", mischief, k]
            assert found["status"] == (status if k in bad else "CONVERGED")
            if k not in bad:
                assert found == here
    assert "LookupError: no mean" in results["bad", "raise", bad[0]]["message"]
    assert "parts.py:" in results["bad", "raise", bad[0]]["message"]
    assert "mean is nan; give a status" in results["bad", "nan", bad[0]]["message"]
    assert summary.failed == 3 * len(bad)

    # Nothing is left to do, whatever is said in comments; other numbers are other results.
    (folder / "level.py").write_text("LEVEL = 0.5  # of the noise\n", encoding="utf-8")
    assert run_experiment(planned(folder), tmp_path / "out", warm=lambda plan: None).computed == 0
    before = {file.name: file.read_bytes() for file in (tmp_path / "out").iterdir() if file.is_file()}
    (folder / "level.py").write_text("LEVEL = 0.6\n", encoding="utf-8")
    with pytest.raises(RefusedError, match="results of other code"):
        run_experiment(planned(folder), tmp_path / "out", warm=lambda plan: None)
    assert {file.name: file.read_bytes() for file in (tmp_path / "out").iterdir() if file.is_file()} == before
    # Results are read without the code.
    os.unlink(folder / "parts.py")
    assert json.dumps(list(read_stored(tmp_path / "out")))


@pytest.mark.parametrize(
    ("changes", "place", "words"),
    [
        ((('Noise"}', 'Noise", unseeded: true}'),), "5:21: noise.kind", "global random state"),
        ((("[raise, die, nan]", "global"),), "8:21: estimators.bad.kind", "global random state"),
        ((("[raise, die, nan]", "mistake"),), "8:21: estimators.bad.kind", "NameError: name 'recrod' is not defined"),
    ],
)
def test_what_shows_on_the_first_data_set_is_said_before_the_run(changes, place, words, folder):
    with pytest.raises(SpecError) as caught:
        planned(folder, *changes)
    assert f"spec.yaml:{place}" in str(caught.value)
    assert words in str(caught.value)


BAD = '  bad:       {kind: "./parts.py:Mean", mischief: [raise, die, nan]}\n'
RULE = ("seed: 5}", "seed: 5}\nsuccess: {delay_relative_error: 0.1}")


@pytest.mark.parametrize(
    ("changes", "at", "words"),
    [
        (((BAD, ""),), "7:21: estimators.good.kind", ["returns mean; true values are known of a1, b0, delay only"]),
        (
            ((BAD, ""), RULE, ("[1, 2]}", "[1, 2], delay: 0.1}")),
            "7:21: estimators.good.kind",
            ["true values", "returns no delay, so that it never meets success.delay_relative_error"],
        ),
        (
            (("[raise, die, nan]", "fail"),),
            "estimators.",
            ["true", "fails on the first data set: LookupError: never ("],
        ),
    ],
)
def test_what_is_odd_on_the_first_data_set_is_a_warning(changes, at, words, folder):
    heard = [text for text in planned(folder, *changes).spec.warnings if "estimators." in text]
    for text, expected in zip(heard, words, strict=True):
        assert at in text
        assert expected in text


def test_a_component_that_ends_the_process_is_left_to_the_run(folder):
    assert planned(folder, ("[raise, die, nan]", "always")).data_sets == 4
