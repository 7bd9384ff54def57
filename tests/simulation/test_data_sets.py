"""Data sets of one specification: shared parts of different cells and replicates, and records from files."""

import pickle

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.measurement import read_record
from ctid_cli.signals.noise import stream
from ctid_cli.simulation.start_points import StartPoint
from ctid_cli.specification.load import load_spec, spec_from_canonical

SPEC = {
    "experiment": "toy",
    "system": {"numerator": [2], "denominator": [0.25, 0.7, 1], "delay": 1.0},
    "excitation": {"kind": "prbs", "stages": 6, "clock_period": 0.5},
    "sampling": {"kind": "uniform_intervals", "low": 0.05, "high": 0.15, "samples": 200, "input_record": "sampled"},
    "noise": {"kind": "white", "snr_db": [5, 15]},
    "estimators": {"search": {"kind": "td_srivc", "poles": 2, "zeros": 0, "delay_bounds": [0, 9]}},
    "starts": {"initial_delay": [3, {"uniform": [0, 9]}]},
    "monte_carlo": {"runs": 3, "seed": 11},
}


def plan_of(*overrides, spec=SPEC):
    return build_plan(load_spec(spec, overrides))


def record_of(*overrides, replicate=0, cell=0):
    return plan_of(*overrides).data_cells[cell].dataset(replicate).record


def test_levels_share_input_instants_and_noise_shape():
    low, high = (record_of(replicate=1, cell=cell) for cell in (0, 1))
    np.testing.assert_array_equal(low.t, high.t)
    np.testing.assert_array_equal(low.input.values, high.input.values)
    np.testing.assert_array_equal(low.noise_free, high.noise_free)
    np.testing.assert_allclose(low.y - low.noise_free, (high.y - high.noise_free) * 10**0.5, rtol=1e-9, atol=1e-12)
    # Longer records begin with the shorter ones.
    longer = record_of("sampling.samples=300", replicate=1)
    np.testing.assert_array_equal(longer.t[:200], low.t)
    np.testing.assert_allclose(longer.noise_free[:200], low.noise_free, atol=1e-12)


def test_replicates_differ_and_repeat():
    cell = plan_of().data_cells[0]
    first, second, again = (cell.dataset(replicate).record for replicate in (0, 1, 0))
    assert not np.array_equal(first.t, second.t)
    assert not np.array_equal(first.input.values, second.input.values)
    np.testing.assert_array_equal(first.y, again.y)
    sent = pickle.loads(pickle.dumps(cell))
    np.testing.assert_array_equal(sent.dataset(0).record.y, first.y)


def test_the_input_record_is_sampled_or_exact():
    sampled, exact = record_of(), record_of("sampling.input_record=exact")
    np.testing.assert_array_equal(sampled.noise_free, exact.noise_free)
    np.testing.assert_array_equal(sampled.input.t, sampled.t)
    np.testing.assert_array_equal(exact.input.t, 0.5 * np.arange(exact.input.t.size))
    np.testing.assert_array_equal(sampled.input.values, exact.input.at(sampled.t))


def test_random_starts():
    random = plan_of().starts[1]
    drawn = [random.draw(11, replicate).delay for replicate in range(50)]
    assert drawn[3] == 9 * stream(11, "start", 3).random()
    assert all(0 <= delay <= 9 for delay in drawn)
    assert len(set(drawn)) == 50
    # A start does not depend on the other starts either.
    more = plan_of("starts.initial_delay=[{uniform: [0, 5]},{uniform: [0, 9]}]")
    assert more.starts[1].draw(11, 3) == random.draw(11, 3)
    assert StartPoint("3", "delay", 3.0).draw(None, 0).delay == 3.0
    with pytest.raises(ValueError, match="seed"):
        random.draw(None, 0)


@pytest.fixture
def file(tmp_path):
    rng = np.random.default_rng(5)
    rows = [f"{k / 10},{3 + rng.integers(2)},{5 + rng.standard_normal() if k != 7 else ''}" for k in range(100)]
    file = tmp_path / "record.csv"
    file.write_text("t,u,y\n" + "\n".join(rows) + "\n")
    return file


def measured(file):
    return {
        "experiment": "measured",
        "data": {"file": str(file), "offset": "remove", "estimation_samples": 60},
        "estimators": {"one": {"kind": "srivc", "poles": 1, "zeros": 0}},
    }


def test_a_measured_record_is_split_and_its_means_are_those_of_the_first_part(file):
    (cell,) = plan_of(spec=measured(file)).data_cells
    data, whole = cell.dataset(0), read_record(file)
    assert (data.true_model, data.record.n_samples) == (None, 60)
    assert np.isnan(data.record.y[7])
    np.testing.assert_allclose(data.record.y, whole.y[:60] - np.nanmean(whole.y[:60]))
    np.testing.assert_allclose(data.record.input.values, whole.input.values[:60] - whole.input.values[:60].mean())
    assert not data.validation.valid[:60].any()
    np.testing.assert_allclose(data.validation.y[60:], whole.y[60:] - np.nanmean(whole.y[:60]))
    np.testing.assert_array_equal(data.validation.input.values[:60], data.record.input.values)
    raw = plan_of("data.offset=none", spec=measured(file)).data_cells[0].dataset(0)
    np.testing.assert_array_equal(raw.record.y, whole.y[:60])
    everything = plan_of("data.estimation_samples=null", spec=measured(file)).data_cells[0].dataset(0)
    assert (everything.validation, everything.record.n_samples) == (None, 100)
    with pytest.raises(ValueError, match="replicate 0 only"):
        cell.dataset(1)


def test_a_record_that_changed_since_is_refused(file):
    plan = build_plan(load_spec(measured(file)), 20)
    assert (plan.runs, plan.data_sets) == (1, 1)
    file.write_text(file.read_text() + "10.0,3,5\n")
    with pytest.raises(DataError, match="differs from that of the planned experiment"):
        plan.data_cells[0].dataset(0)
    # Its results can still be read.
    assert build_plan(spec_from_canonical(plan.spec.canonical())).data_cells[0].hash == plan.data_cells[0].hash
    assert plan_of(spec=measured(file)).data_cells[0].hash != plan.data_cells[0].hash
