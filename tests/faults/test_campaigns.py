"""Nothing that is acknowledged is lost, nothing is read wrongly: short forms of the campaigns of ``make faults``."""

import json
import shutil
import sys

import pytest

from tests.faults.campaigns import CAMPAIGNS, Campaign, named
from tests.faults.counts import Trial, counted, table
from tests.faults.process_faults import KINDS, TURNS
from tests.faults.record import Record, refusal


def require_good(name, numbers):
    trials = list(named(name).tried(iter(numbers)))
    assert [trial.number for trial in trials] == list(numbers)
    assert not any(trial.found for trial in trials), "\n".join(str(trial) for trial in trials if trial.found)


@pytest.mark.skipif(sys.platform != "linux" or shutil.which("cc") is None, reason="needs a C compiler and LD_PRELOAD")
def test_faults_at_storage_calls():
    require_good("storage", range(12))


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_faults_of_processes():
    require_good("processes", [TURNS.index((kind, turn)) for kind in list(KINDS)[:4] for turn in range(2)])


def test_damaged_files():
    require_good("damage", range(12))


def test_an_input_is_tried_like_any_other():
    require_good("csv", range(3))


def test_a_count_of_what_must_not_happen():
    trials = [
        Trial("a fault", 0, "first"),
        Trial("a fault", 1, "second", [("lost", "one"), ("left", "a file")], faults=3),
        Trial("another", 0, "third"),
    ]
    counts = counted(trials)
    assert [count.is_good for count in counts] == [False, True]
    assert "| a fault | 4 | 1 | 0 | 0 | 0 | 0 | 1 |" in table(counts)
    assert "| **all** | 5 | 1 | 0 | 0 | 0 | 0 | 1 |" in table(counts)


def test_a_trial_that_ends_its_process_counts_and_the_next_goes_on(tmp_path):
    (tmp_path / "deadly.py").write_text(
        "import os\n"
        "from tests.faults.campaigns import serve\n"
        "from tests.faults.counts import Trial\n"
        "serve(lambda number: os._exit(3) if number == 1 else Trial('a', number, 'b'))\n"
    )
    campaign = Campaign("deadly", "deadly", 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path))
        trials = list(campaign.tried(iter(range(3))))
        assert [(trial.number, len(trial.found)) for trial in trials] == [(0, 0), (1, 1), (2, 0)]
        assert trials[1].found == [("traceback", "the process of the campaign ended with 3")]
        with pytest.raises(RuntimeError, match="does not begin"):
            list(Campaign("none", "tests.faults.nothing", 1).tried(iter([0])))


def test_a_record_goes_on_where_it_was_and_says_what_was_repeated(tmp_path):
    campaign = named("damage")
    record = Record(tmp_path)
    record.begin()
    for number in (0, 2):
        record.add(campaign, Trial("cut short", number, "runs.h5", [("wrong", "5 of 6")] if number else []))
    with (tmp_path / "trials.jsonl").open("a") as file:
        file.write('{"campaign": "damage", "trial": {"kind": "cut')  # the power went off
    record = Record(tmp_path)
    assert list(record.missing(campaign, 4)) == [1, 3]
    assert list(record.failed(campaign)) == [2]
    assert "repeated" not in record.texts()["faults.md"]
    record.begin()
    record.add(campaign, Trial("cut short", 2, "runs.h5"))
    texts = Record(tmp_path).texts()
    assert "| cut short | 2 | 0 | 0 | 0 | 0 | 0 | 0 |" in texts["faults.md"]
    assert "| cut short | 2 (runs.h5) | wrong: 5 of 6 | nothing, " in texts["faults.md"]
    assert texts["faults.csv"].splitlines()[1] == "cut short,2,0,0,0,0,0,0,0,1,0,0,0,0"
    assert [one["trials"] for one in json.loads(texts["environment.json"])["sittings"]] == [2, 1]
    assert refusal(record) == "not all trials of the full form were made"


def test_the_full_form_has_what_was_asked_for():
    assert sum(campaign.trials for campaign in CAMPAIGNS if campaign.module.endswith(".fuzz")) == 20_000
    assert len(TURNS) == named("processes").trials
