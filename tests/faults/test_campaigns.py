"""Nothing that is acknowledged is lost, nothing is read wrongly: short forms of the campaigns of ``make faults``."""

import shutil
import sys

import pytest

from ctid_cli.storage.store import load_estimates
from tests.faults import damage, process_faults, storage_faults
from tests.faults.counts import Count, table
from tests.running.fakes import FakePlan, Toy
from tests.running.hostile import Hostile
from tests.running.test_limits import run


def require_good(counts):
    assert sum(count.trials for count in counts) > 0
    assert all(count.is_good for count in counts), table(counts) + "\n".join(e for one in counts for e in one.examples)


@pytest.mark.skipif(sys.platform != "linux" or shutil.which("cc") is None, reason="needs a C compiler and LD_PRELOAD")
def test_faults_at_storage_calls(tmp_path):
    require_good(storage_faults.run_under(tmp_path, 12))


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_faults_of_processes():
    require_good(process_faults.campaign(0.03, quick=True))


def test_damaged_files():
    require_good(damage.campaign(12))


def test_the_bad_are_named_and_all_others_are_stored(tmp_path):
    hostile = [Hostile("leave", at=1, order=5), Hostile("loop", at=0, order=6), Hostile("grow", at=2, order=7)]
    plan = FakePlan(Toy(), *hostile, Toy(order=4), levels=(5,), runs=3, limits={"cpu_seconds": 4, "memory_mb": 300})
    summary = run(plan, tmp_path)
    frame = load_estimates(tmp_path)
    bad = frame[frame["status"] != "CONVERGED"]
    assert (summary.missing, summary.failed) == (0, 4)
    assert {(row.estimator, row.replicate, row.status) for row in bad.itertuples()} == {
        ("toy1", 1, "CRASHED"),
        ("toy2", 0, "TIMEOUT"),
        ("toy3", 2, "MEMORY"),
    }


def test_a_count_of_what_must_not_happen():
    count = Count("a fault")
    count.add([], "first")
    count.add([("lost", "one"), ("left", "a file")], "second")
    assert not count.is_good
    assert count.examples == ["lost (second): one", "left (second): a file"]
    assert "| a fault | 2 | 1 | 0 | 0 | 0 | 0 | 1 |" in table([count])
