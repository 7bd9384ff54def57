"""From specifications to data sets and estimates: expansion, identity, random streams."""

import hashlib
import pickle

import numpy as np
import pytest

from ctid_cli.canonical import content_hash
from ctid_cli.errors import DataError, UsageError
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.measurement import read_record
from ctid_cli.signals.noise import stream
from ctid_cli.simulation.start_points import StartPoint
from ctid_cli.specification.load import load_spec, spec_from_canonical

SPEC = """\
experiment: toy
system: {numerator: [2], denominator: [0.25, 0.7, 1], delay: 1.0}
excitation: {kind: prbs, stages: 6, clock_period: 0.5}
sampling: {kind: uniform_intervals, low: 0.05, high: 0.15, samples: 200, input_record: sampled}
noise: {kind: white, snr_db: [5, 15]}
estimators:
  search: {kind: td_srivc, poles: 2, zeros: 0, delay_bounds: [0, 9]}
  known: {kind: srivc, poles: 2, zeros: 0, delay: 1.0}
starts: {initial_delay: [3, {uniform: [0, 9]}]}
monte_carlo: {runs: 3, seed: 11}
"""


@pytest.fixture
def plan_of(tmp_path):
    def plan(*overrides, text=SPEC, runs=None):
        file = tmp_path / "spec.yaml"
        file.write_text(text, encoding="utf-8")
        return build_plan(load_spec(file, overrides), runs)

    return plan


def ids(plan):
    cells = range(len(plan.data_cells))
    return {key.id for cell in cells for replicate in range(plan.runs) for key, _, _ in plan.keys(cell, replicate)}


def test_expansion(plan_of):
    plan = plan_of(
        "sampling.samples=[100,200]", "estimators.search.svf_cutoff=[1,2]", "estimators.search.variant=[plain,guarded]"
    )
    assert [cell.swept for cell in plan.data_cells] == [
        {"samples": 100, "snr_db": 5.0},
        {"samples": 100, "snr_db": 15.0},
        {"samples": 200, "snr_db": 5.0},
        {"samples": 200, "snr_db": 15.0},
    ]
    assert [(cell.name, cell.swept) for cell in plan.estimators] == [
        ("search", {"svf_cutoff": 1.0, "variant": "plain"}),
        ("search", {"svf_cutoff": 1.0, "variant": "guarded"}),
        ("search", {"svf_cutoff": 2.0, "variant": "plain"}),
        ("search", {"svf_cutoff": 2.0, "variant": "guarded"}),
        ("known", {}),
    ]
    assert plan.estimators[1].estimator.svf_cutoff == 1.0
    assert plan.estimators[1].estimator.variant == "guarded"
    assert plan.data_cells[2].content["sampling"]["samples"] == 200
    assert len({cell.hash for cell in plan.data_cells}) == 4
    assert len({cell.hash for cell in plan.estimators}) == 5


def test_tasks_and_keys(plan_of):
    plan = plan_of()
    assert plan.data_sets == 3 * 2
    keys = plan.keys(1, 2)
    assert [(cell.name, start.label) for _, cell, start in keys] == [
        ("search", "3"),
        ("search", "uniform(0, 9)"),
        ("known", "none"),
    ]
    key = keys[1][0]
    assert (key.data_hash, key.replicate, key.start) == (plan.data_cells[1].hash, 2, "uniform(0, 9)")
    text = f"{key.data_hash}/2/{key.estimator_hash}/uniform(0, 9)"
    assert key.id == hashlib.sha256(text.encode()).hexdigest()[:12]
    assert len(ids(plan)) == 3 * 2 * 3
    assert [(start.label, start.initial_delay) for start in plan.starts] == [
        ("3", 3.0),
        ("uniform(0, 9)", "random"),
        ("none", None),
    ]


def test_without_starts_every_estimator_runs_once(plan_of):
    plan = plan_of(text=SPEC.replace("starts: {initial_delay: [3, {uniform: [0, 9]}]}\n", ""))
    assert [(cell.name, start.label) for _, cell, start in plan.keys(0, 0)] == [
        ("search", "none"),
        ("known", "none"),
    ]
    assert [start.label for start in plan.starts] == ["none"]
    assert plan.starts[0].draw(None, 0) is None


def test_columns_of_swept_fields(plan_of):
    plan = plan_of("system.delay=[1,2]", "estimators.known.delay=[1,2]", "sampling.low=[0.05,0.06]")
    assert set(plan.data_cells[0].swept) == {"system.delay", "sampling.low", "snr_db"}
    assert plan.estimators[1].swept == {"estimator.delay": 1.0}, "delay is the estimated one"
    nested = plan_of(
        "estimators.search.lowpass={cutoff: [0.5, 1], order: 2}", "excitation={kind: gaussian, clock_period: [0.5, 1]}"
    )
    assert nested.estimators[0].swept == {"cutoff": 0.5}
    assert nested.estimators[1].estimator.lowpass.cutoff == 1.0
    assert nested.data_cells[0].swept == {"clock_period": 0.5, "snr_db": 5.0}


@pytest.mark.parametrize(
    "override",
    [
        "noise.snr_db=[5,10,15]",
        "starts.initial_delay=[0,3,{uniform: [0, 5]},{uniform: [0, 9]}]",
        "estimators.third={kind: svf, poles: 2, zeros: 0}",
        "monte_carlo.runs=5",
        "estimators.known.max_iterations=[50,60]",
    ],
)
def test_adding_leaves_what_there_is_alone(plan_of, override):
    before, after = plan_of(), plan_of(override)
    assert ids(before) < ids(after)


@pytest.mark.parametrize(
    "override",
    [
        "system.delay=1.5",
        "system.numerator=[3]",
        "excitation.stages=7",
        "sampling.samples=201",
        "sampling.input_record=exact",
        "monte_carlo.seed=12",
        "noise={kind: white, standard_deviation: 5}",
    ],
)
def test_other_data_are_other_cells(plan_of, override):
    assert not ids(plan_of()) & ids(plan_of(override))


def test_names_runs_and_success_are_in_no_identity(plan_of):
    before = plan_of()
    renamed = plan_of("experiment=other", "success.fit_percent=3", text=SPEC.replace("search:", "other:"))
    assert ids(renamed) == ids(before)
    assert plan_of("monte_carlo.runs=9").spec_hash == before.spec_hash == plan_of(runs=9).spec_hash
    assert renamed.spec_hash != before.spec_hash


def test_runs_of_the_command_line(plan_of):
    plan = plan_of(runs=7)
    assert plan.runs == 7
    assert plan.data_sets == 14
    assert plan.spec.canonical()["monte_carlo"]["runs"] == 7, "what was run can be planned again"
    again = build_plan(spec_from_canonical(plan.spec.canonical()))
    assert ids(again) == ids(plan)
    assert again.spec_hash == plan.spec_hash
    assert plan.spec.text == SPEC
    with pytest.raises(UsageError, match="1 or more"):
        plan_of(runs=0)
    with pytest.raises(UsageError, match="too many"):
        plan_of(runs=1_000_000)


def test_too_many_cells(plan_of):
    many = ",".join(str(k) for k in range(2, 400))
    with pytest.raises(UsageError, match="158404 data cells"):
        plan_of(f"noise.snr_db=[{many}]", f"excitation.amplitude=[{many}]")


def test_what_a_data_cell_is_made_of(plan_of):
    """Another value here would leave the results of every user aside."""
    plan = plan_of()
    assert plan.data_cells[0].content == {
        "system": {"numerator": [2.0], "denominator": [0.25, 0.7, 1.0], "delay": 1.0},
        "excitation": {"kind": "prbs", "stages": 6, "clock_period": 0.5, "amplitude": 1.0},
        "sampling": {"kind": "uniform_intervals", "low": 0.05, "high": 0.15, "samples": 200, "input_record": "sampled"},
        "noise": {"kind": "white", "snr_db": 5.0, "standard_deviation": None, "variance": None},
        "seed": 11,
    }
    assert plan.data_cells[0].hash == "b3133309744adf43"
    assert plan.estimators[1].content["kind"] == "srivc"
    assert plan.estimators[1].hash == content_hash(plan.estimators[1].content)


# -- data sets --------------------------------------------------------------------------------------------------------


def test_levels_share_input_instants_and_noise_shape(plan_of):
    low, high = (cell.dataset(1) for cell in plan_of().data_cells)
    np.testing.assert_array_equal(low.record.t, high.record.t)
    np.testing.assert_array_equal(low.record.input.values, high.record.input.values)
    np.testing.assert_array_equal(low.record.noise_free, high.record.noise_free)
    noise_low, noise_high = (data.record.y - data.record.noise_free for data in (low, high))
    np.testing.assert_allclose(noise_low, noise_high * 10**0.5, rtol=1e-9, atol=1e-12)
    # Longer records begin with the shorter ones.
    longer = plan_of("sampling.samples=300").data_cells[0].dataset(1)
    np.testing.assert_array_equal(longer.record.t[:200], low.record.t)
    np.testing.assert_allclose(longer.record.noise_free[:200], low.record.noise_free, atol=1e-12)


def test_replicates_differ_and_repeat(plan_of):
    cell = plan_of().data_cells[0]
    first, second, again = cell.dataset(0).record, cell.dataset(1).record, cell.dataset(0).record
    assert not np.array_equal(first.t, second.t)
    assert not np.array_equal(first.input.values, second.input.values)
    np.testing.assert_array_equal(first.y, again.y)
    sent = pickle.loads(pickle.dumps(cell))
    np.testing.assert_array_equal(sent.dataset(0).record.y, first.y)
    assert sent.dataset(0).true_model.delay == 1.0


def test_what_the_estimator_is_told_of_the_input(plan_of):
    sampled = plan_of().data_cells[0].dataset(0).record
    exact = plan_of("sampling.input_record=exact").data_cells[0].dataset(0).record
    np.testing.assert_array_equal(sampled.noise_free, exact.noise_free)
    np.testing.assert_array_equal(sampled.input.t, sampled.t)
    np.testing.assert_array_equal(exact.input.t, 0.5 * np.arange(exact.input.t.size))
    np.testing.assert_array_equal(sampled.input.values, exact.input.at(sampled.t))


def test_without_noise_the_output_is_noise_free(plan_of):
    plan = plan_of(text=SPEC.replace("noise: {kind: white, snr_db: [5, 15]}\n", ""))
    (cell,) = plan.data_cells
    record = cell.dataset(0).record
    np.testing.assert_array_equal(record.y, record.noise_free)


def test_random_starts(plan_of):
    plan = plan_of()
    random = plan.starts[1]
    drawn = [random.draw(11, replicate).delay for replicate in range(50)]
    assert drawn[3] == 9 * stream(11, "start", 3).random()
    assert all(0 <= delay <= 9 for delay in drawn)
    assert len(set(drawn)) == 50
    # Nor does a start depend on which others there are.
    more = plan_of("starts.initial_delay=[{uniform: [0, 5]},{uniform: [0, 9]}]")
    assert more.starts[1].draw(11, 3) == random.draw(11, 3)
    assert StartPoint("3", "delay", 3.0).draw(None, 0).delay == 3.0
    with pytest.raises(ValueError, match="seed"):
        random.draw(None, 0)


MEASURED = """\
experiment: measured
data: {file: record.csv, offset: remove, estimation_samples: 60}
estimators: {one: {kind: srivc, poles: 1, zeros: 0}}
"""


@pytest.fixture
def record_file(tmp_path):
    rng = np.random.default_rng(5)
    rows = [f"{k / 10},{3 + rng.integers(2)},{5 + rng.standard_normal() if k != 7 else ''}" for k in range(100)]
    file = tmp_path / "record.csv"
    file.write_text("t,u,y\n" + "\n".join(rows) + "\n")
    return file


def test_a_measured_record_is_split_and_its_means_are_those_of_the_first_part(plan_of, record_file):
    plan = plan_of(text=MEASURED, runs=20)
    assert plan.runs == 1
    assert plan.data_sets == 1
    data = plan.data_cells[0].dataset(0)
    whole = read_record(record_file)
    assert data.true_model is None
    assert data.record.n_samples == 60
    assert np.isnan(data.record.y[7])
    np.testing.assert_allclose(data.record.y, whole.y[:60] - np.nanmean(whole.y[:60]))
    np.testing.assert_allclose(data.record.input.values, whole.input.values[:60] - whole.input.values[:60].mean())
    assert not data.validation.valid[:60].any()
    np.testing.assert_allclose(data.validation.y[60:], whole.y[60:] - np.nanmean(whole.y[:60]))
    np.testing.assert_array_equal(data.validation.input.values[:60], data.record.input.values)
    raw = plan_of("data.offset=none", text=MEASURED).data_cells[0].dataset(0)
    np.testing.assert_array_equal(raw.record.y, whole.y[:60])
    everything = plan_of("data.estimation_samples=null", text=MEASURED).data_cells[0].dataset(0)
    assert everything.validation is None
    assert everything.record.n_samples == 100
    with pytest.raises(ValueError, match="replicate 0 only"):
        plan.data_cells[0].dataset(1)


def test_a_record_that_changed_since_is_refused(plan_of, record_file):
    plan = plan_of(text=MEASURED)
    record_file.write_text(record_file.read_text() + "10.0,3,5\n")
    with pytest.raises(DataError, match="not that which the experiment was planned with"):
        plan.data_cells[0].dataset(0)
    # Its results can be read all the same.
    assert build_plan(spec_from_canonical(plan.spec.canonical())).data_cells[0].hash == plan.data_cells[0].hash
    assert plan_of(text=MEASURED).data_cells[0].hash != plan.data_cells[0].hash


def test_an_input_from_a_file(plan_of, record_file):
    overrides = [
        "excitation={kind: file, file: record.csv, hold: foh}",
        "sampling={kind: regular, interval: 0.1, samples: 99}",
    ]
    (cell, _) = plan_of(*overrides, "system.delay=0.5").data_cells
    record = cell.dataset(0).record
    np.testing.assert_allclose(record.input.values, read_record(record_file).input.values[:99])
    assert record.input.hold == "foh", "samples of straight lines are joined by straight lines"
    record_file.write_text(record_file.read_text().replace("t,u,y\n", "t,u,y\n-1,3,1\n"))
    with pytest.raises(DataError, match="not that which"):
        cell.dataset(0)
