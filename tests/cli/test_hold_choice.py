"""``ctid fit`` without ``--hold``: the hold that describes a record best, and why.

Two measured records may not be copied into the project: where the variable CTID_RECORDS names a folder with Silverbox
(https://www.nonlinearbenchmark.org/benchmarks/silverbox) and the gas furnace of Box and Jenkins, they are fitted too.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, load_fit, simulate
from ctid_cli.signals.measurement import read_measurement
from tests.cli.records import write

RECORDS = os.environ.get("CTID_RECORDS")
SECOND = TransferFunction([4.0], [1.0, 0.8, 4.0])


def moved(path, hold, deviation=0.01, levels=False):
    """A record of an input that moves smoothly, or jumps."""
    rng = np.random.default_rng(2)
    t = 0.2 * np.arange(400)
    u = np.repeat(rng.choice([-1.0, 1.0], 80), 5) if levels else rng.standard_normal(400)
    if not levels:
        for k in range(1, 400):
            u[k] += 0.5 * u[k - 1]
    y = simulate(SECOND, HeldSignal(t, u, hold), t) + deviation * rng.standard_normal(400)
    return write(path, (t, u, y))


@pytest.mark.parametrize(
    ("hold", "said"), [("foh", "Hold: foh, as --hold is not given: with 2 poles"), ("zoh", "best")]
)
def test_the_hold_that_made_a_record_is_taken(ctid, tmp_path, hold, said):
    done = ctid("fit", moved(tmp_path / "a.csv", hold), "--poles", 2, "--out", tmp_path)
    first = " ".join(done.stdout.split("\n\n")[0].split())
    assert first.startswith(f"Hold: {hold}")
    assert said in first
    assert load_fit(tmp_path / "fit.json").records[0].input.hold == hold
    given = ctid("fit", tmp_path / "a.csv", "--poles", 2, "--hold", hold, "--out", tmp_path)
    assert given.stdout == done.stdout.split("\n\n", 1)[1]


def test_the_structure_is_searched_with_that_hold(ctid, tmp_path):
    done = ctid("fit", moved(tmp_path / "a.csv", "foh"), "--out", tmp_path)
    hold, order, *_ = done.stdout.split("\n\n")
    assert hold.startswith("Hold: foh")
    assert order.startswith("Structure by an order search, as --poles is not given: 2 poles, no zero")


def test_a_record_that_does_not_tell_is_taken_as_held(ctid, tmp_path):
    done = ctid("fit", moved(tmp_path / "a.csv", "foh", deviation=3.0), "--poles", 2, "--out", tmp_path)
    said = " ".join(done.stdout.split())
    assert said.startswith("Hold: zoh, as --hold is not given and the record does not tell how its input was made.")


def test_nothing_is_said_of_an_input_that_jumps(ctid, tmp_path):
    done = ctid("fit", moved(tmp_path / "a.csv", "zoh", levels=True), "--poles", 2, "--out", tmp_path)
    assert "Hold:" not in done.stdout


@pytest.mark.skipif(RECORDS is None, reason="CTID_RECORDS names no folder with the records")
def test_silverbox(ctid, tmp_path):
    folder = Path(str(RECORDS))
    options = ("--poles", 2, "--initial-state", "estimate", "--offset", "estimate", "--out", tmp_path)
    assert ctid("fit", folder / "silverbox_est.csv", *options).stdout.startswith("Hold: band-limited")
    fit = load_fit(tmp_path / "fit.json").fit
    test = read_measurement(folder / "silverbox_test_arrow_no_extrapolation.csv", hold="band-limited").record
    left = test.y - fit.offsets[0] - simulate(fit.model, test.input, test.t)
    # The rule of the benchmark: the initial state from the first 50 samples.
    pole = fit.model.poles[0]
    free = np.exp(pole * test.t)
    basis = np.column_stack((free.real, free.imag))
    left -= basis @ np.linalg.lstsq(basis[:50], left[:50])[0]
    assert np.sqrt(np.mean(left[50:] ** 2)) <= 6.6e-3  # [V]


@pytest.mark.skipif(RECORDS is None, reason="CTID_RECORDS names no folder with the records")
def test_gas_furnace(ctid, tmp_path):
    record = Path(str(RECORDS)) / "gas_furnace.csv"
    done = ctid("fit", record, "--poles", 1, "--delay", "0:60", "--offset", "remove", "--out", tmp_path)
    said = " ".join(done.stdout.split())
    assert said.startswith("Hold: zoh")
    assert 2 * 9 < load_fit(tmp_path / "fit.json").fit.model.delay < 3 * 9  # [s]
    assert "with --hold foh the delay is longer by" in said
