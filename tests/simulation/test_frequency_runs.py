"""Experiments on the frequencies of a signal: specification, measures, storage."""

import json
import os
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest

from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from ctid_cli.frequency.tracking import FrequencyTrack
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.job import Job
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.sinusoids import Piece, SumOfSinusoids, Tone
from ctid_cli.simulation.frequency_measures import (
    Measuring,
    is_settled,
    measure_track,
    pack_track,
    thinned,
    unpack_track,
)
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.store import load_estimates, read_stored, read_tracks
from ctid_cli.storage.summary import export_rows
from tests.running.fakes import outcomes_of
from tests.specification.written import load, problems

SPEC = """\
experiment: frequencies
signal:
  tones: [{frequency: [{until: 15, value: 1.8}, {value: 2.0}]}, {frequency: 3.0, phase: 1.5}]
  phase_at_steps: jump
disturbance: {kind: uniform, half_width: 0.01}
sampling: {kind: regular, interval: 0.01, duration: 30}
estimators:
  restarting: {kind: restarting_least_squares, tones: 2, h: 0.7, prefilter: 0.5}
  esprit: {kind: esprit, tones: 2, averaging: 0.05}
success: {band: 0.05, by: 8}
tracks: {interval: 0.05, window: [25, 30]}
monte_carlo: {runs: 2, seed: 1}
"""
SYSTEM = "system: {numerator: [1], denominator: [1, 1]}\nexcitation: {kind: gaussian}\n"

#: (what is replaced, by what, line, key, part of the message); the only problem of the specification.
BROKEN = {
    "both worlds": ("experiment: frequencies\n", "experiment: frequencies\nnoise: {kind: white, variance: 1}\n", 2,
                    "noise", "disturbance"),
    "estimator of systems": ("{kind: esprit, tones: 2, averaging: 0.05}", "{kind: svf, poles: 2, zeros: 0}", 9,
                             "estimators.esprit.kind", "allowed: drem_gradient"),
    "too many tones": ("esprit, tones: 2", "esprit, tones: 3", 9, "estimators.esprit.tones", "must be 2"),
    "too slow a clock": ("{frequency: 3.0,", "{frequency: 400.0,", 6, "sampling.interval", "below 314.2 rad/s"),
    "late step": ("until: 15", "until: 31", 3, "signal.tones", "a step at 31 s comes after the last sample"),
    "no last piece": ("{value: 2.0}", "{value: 2.0, until: 20}", 3, "signal.tones[0].frequency", "the last has none"),
    "text for pieces": ("3.0, phase", "fast, phase", 3, "signal.tones[1].frequency", "a list is allowed too"),
    "length twice": ("duration: 30}", "duration: 30, samples: 7}", 6, "sampling.samples", "keep one of the two"),
    "an endless hold": ("{kind: esprit, tones: 2, averaging: 0.05}",
                              "{kind: filter_regression, tones: 2, pole: 4, hold: 1e307}", 9, "estimators.esprit.hold",
                              "longer than the record"),
    "too long averages": ("averaging: 0.05", "averaging: 29", 9, "estimators.esprit.averaging", "too few for 2 tones"),
    "averages that alias": ("averaging: 0.05", "averaging: 1, highest_frequency: 10", 9, "estimators.esprit.averaging",
                            "averages over 1 s show frequencies up to"),
    "a start beyond the clock": ("{kind: esprit, tones: 2, averaging: 0.05}",
                                 "{kind: nonlinear_least_squares, tones: 2, initial_frequencies: [2, 5000]}", 9,
                                 "estimators.esprit.initial_frequencies", "below 314.2 rad/s"),
    "a pole beyond the clock": ("{kind: esprit, tones: 2, averaging: 0.05}",
                                "{kind: filter_regression, tones: 2, pole: 1e300}", 9, "estimators.esprit.pole",
                                "beyond what samples every 0.01 s can show"),
    "window": ("[25, 30]", "[25, 31]", 11, "tracks.window", "ends at 30 s"),
    "track interval": ("tracks: {interval: 0.05", "tracks: {interval: 0.001", 11, "tracks.interval", "0.01 s"),
    "rule of systems": ("{band: 0.05, by: 8}", "{delay_relative_error: 1}", 10, "success.delay_relative_error", "band"),
    "no band": ("{band: 0.05, by: 8}", "{by: 8}", 10, "success.by", "add band"),
    "h too long": ("h: 0.7", "h: 8", 8, "estimators.restarting.h", "delays are filled after 32.5 s"),
    "prefilter too long": ("prefilter: 0.5", "prefilter: 1e9", 8, "estimators.restarting.prefilter", "longer than"),
    "too many samples": ("interval: 0.01, d", "interval: 1e-300, d", 6, "sampling.duration", "samples in a record"),
    "too long an interval": ("interval: 0.01, d", "interval: 50, d", 6, "sampling.duration", "two sampling intervals"),
    "no such disturbance": ("{kind: uniform, half_width: 0.01}", "{kind: x}", 5, "disturbance.kind", "uniform, sine"),
    "no such word": ("jump", "leap", 4, "signal.phase_at_steps", "'jump', 'continuous'"),
    "no clock": ("sampling: {kind: regular, interval: 0.01, duration: 30}\n", "", 1, "sampling", "for example"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN.values(), ids=BROKEN)
def test_mistakes_are_named_with_their_place(tmp_path, case):
    old, new, line, key, message = case
    assert SPEC.count(old) == 1
    (problem,) = problems(tmp_path, SPEC.replace(old, new))
    assert (problem.line, problem.key) == (line, key)
    assert message in problem.message


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        ("h: 0.7", "h: 1.2", "estimators.restarting.h", "above pi/h = 2.618 rad/s are seen as lower ones"),
        ("interval: 0.01, d", "interval: 0.04, d", "estimators.restarting.h", "0.72 s"),
    ],
)
def test_what_is_unwise_is_a_warning(tmp_path, old, new, key, message):
    always = "estimators.esprit.kind: gives one estimate of the whole record, in which a frequency steps"
    assert [warning.partition(": ")[2] for warning in load(tmp_path, SPEC).warnings] == [always]
    text = SPEC.replace(old, new).replace("averaging: 0.05", "averaging: 0.04")
    (first, second) = load(tmp_path, text).warnings
    assert f": {key}: " in first
    assert message in first
    assert second.endswith(always)


def test_a_system_has_no_estimator_of_frequencies(tmp_path):
    text = SYSTEM + "\n".join(SPEC.splitlines()[5:7]) + "\n  one: {kind: esprit, tones: 2}\n"
    (problem,) = problems(tmp_path, f"experiment: one\n{text}monte_carlo: {{runs: 1, seed: 1}}\n")
    assert problem.key == "estimators.one.kind"
    assert "give signal" in problem.message


def test_a_duration_is_a_number_of_samples(tmp_path):
    spec = load(tmp_path, SPEC, "sampling.interval=[0.01, 0.02]")
    assert [cell.source.sampling.samples for cell in build_plan(spec).data_cells] == [3000, 1500]
    again = spec_from_canonical(json.loads(json.dumps(spec.canonical())))
    assert build_plan(again).spec_hash == build_plan(spec).spec_hash


def test_no_disturbance_has_three_spellings(tmp_path):
    word, null = (load(tmp_path, SPEC.replace("{kind: uniform, half_width: 0.01}", text)) for text in ("none", "null"))
    left_out = load(tmp_path, SPEC.replace("disturbance: {kind: uniform, half_width: 0.01}\n", ""))
    assert len({build_plan(spec).spec_hash for spec in (word, null, left_out)}) == 1
    (cell,) = build_plan(word).data_cells
    record = cell.dataset(0).record
    assert record.samples == pytest.approx(cell.source.signal.generate(0.01 * np.arange(3000)))


def test_what_is_measured_belongs_to_the_identity_and_the_time_limit_does_not(tmp_path):
    (cell,) = build_plan(load(tmp_path, SPEC)).data_cells
    for override, same in (("success.by=9", True), ("success.band=0.02", False), ("tracks.window=[20, 30]", False)):
        (other,) = build_plan(load(tmp_path, SPEC, override)).data_cells
        assert (other.hash == cell.hash) is same
        assert np.array_equal(other.dataset(1).record.samples, cell.dataset(1).record.samples)


def made(t, first, flags=None):
    omega = np.column_stack((first, np.full(t.size, 3.0)))
    return FrequencyTrack(t, omega, np.zeros(t.size, np.uint16) if flags is None else flags, np.zeros(omega.shape))


def test_measures_of_a_made_up_track():
    signal = SumOfSinusoids((Tone((Piece(1.8, until=6.0), Piece(2.0))), Tone(3.0)))
    t = 0.5 * np.arange(32)
    first = np.where(t < 2.0, 5.0, 1.8)  # wrong until 2 s, right until the step, late by 1.5 s after it
    first[t >= 7.5] = 2.01
    flags = np.where(t < 3.0, int(Flag.STARTING), 0).astype(np.uint16)
    # before the step; three that answer to it, two of them one alarm; two periods of 2 rad/s after it
    flags[np.isin(t, (4.0, 7.0, 7.5, 12.0, 13.0))] = int(Flag.CHANGED)
    options = RestartingLeastSquares(tones=2, h=0.7)
    true = signal.frequencies_at(t)
    found = measure_track(made(t, first, flags), true, signal, Measuring(0.05, (9.0, 12.0)), options)
    assert found == {
        "omega_1": 2.01, "omega_2": 3.0, "valid_from": 3.0, "settling_time_1": 2.0, "settling_time_2": 0.0,
        "settling_after_step_1": 1.5, "settling_after_step_2": 0.0, "rms_1": pytest.approx(0.01), "rms_2": 0.0,
        "bias_1": pytest.approx(0.01), "bias_2": 0.0, "false_alarms": 2.0, "valid_share": pytest.approx(100 * 21 / 32),
    }  # fmt: skip
    assert is_settled(found, 0.05, 2.0)
    assert not is_settled(found, 0.05, 1.9)
    first[-1] = 2.2
    never = measure_track(made(t, first), true, signal, Measuring(0.05), options)
    assert (never["settling_time_1"], never["settling_after_step_1"]) == (2.0, None)
    assert not is_settled(never, 0.05, None)


def test_a_packed_track_is_the_track():
    t = 0.01 * np.arange(1001)
    track = thinned(made(t, np.sin(t) + 2), 0.05, 0.01)
    assert track.t.tolist() == t[::5].tolist()
    packed = json.loads(json.dumps(pack_track(track)))
    for name, values in unpack_track(packed).items():
        assert np.array_equal(values, getattr(track, name))


def test_results_are_sealed_and_read_back(tmp_path):
    plan = build_plan(load(tmp_path, SPEC))
    folder = tmp_path / "out"
    summary = run_experiment(plan, folder, jobs=1)
    assert (summary.computed, summary.failed) == (4, 0)
    stored = read_stored(folder)
    (cell,) = plan.data_cells
    wanted = tuple(plan.keys(plan.tasks()[0]))
    outcomes = outcomes_of(Job(cell, 0, 1, wanted))
    assert {outcome.key for outcome in outcomes} < stored.results.keys()
    for outcome in outcomes:
        assert stored.results[outcome.key]["measures"] == outcome.result["measures"]
    tracks = read_tracks(folder)
    (online,) = [outcome for outcome in outcomes if "track" in outcome.result]
    assert list(tracks) == [online.key.id], "of one data set, and none of an estimate of the whole record"
    for name, values in unpack_track(online.result["track"]).items():
        assert np.array_equal(tracks[online.key.id][name], values, equal_nan=True)
    with h5py.File(folder / "runs.h5") as file:
        assert file[f"tracks/{online.key.id}/omega"].attrs["unit"] == "rad/s"
        assert file[f"tracks/{online.key.id}/flags"].attrs["bits"].startswith("1 starting, 2 gap, 4 changed, ")
    flat = export_rows(load_estimates(folder))
    assert {"omega_1", "settling_after_step_2", "rms_2", "false_alarms", "converged"} <= set(flat)
    assert not {"numerator", "delay", "b0", "measures"} & set(flat)
    restarting = flat[flat["estimator"] == "restarting"]
    assert restarting["converged"].all()
    assert (restarting["settling_after_step_1"] < 8).all()
    esprit = flat[flat["estimator"] == "esprit"]
    assert (esprit["valid_share"] == 0).all(), "a step lies in the record"
    again = run_experiment(plan, folder, jobs=1)
    assert (again.computed, again.reused) == (0, 4)


#: Runs the specification in a folder of its own, and says so after each data set that is stored.
RUN = """\
import sys
from pathlib import Path
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec

told = []

def tell(progress):
    while len(told) < progress.done:
        told.append(progress.done)
        print("stored", flush=True)

run_experiment(build_plan(load_spec(Path(sys.argv[1]))), Path(sys.argv[2]), jobs=1, progress=tell)
"""


def test_killed_and_resumed_gives_the_same_bytes_with_all_its_tracks(tmp_path):
    text = SPEC.replace("runs: 2", "runs: 25").replace("tracks: {", "tracks: {runs: 25, ")
    spec, place = load(tmp_path, text), tmp_path / "killed"
    command = [sys.executable, "-c", RUN, str(tmp_path / "spec.yaml"), str(place)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        assert [process.stdout.readline() for _ in range(2)] == ["stored\n"] * 2
        os.killpg(process.pid, signal.SIGKILL)
    assert not (place / "runs.h5").exists()
    stored = len(read_tracks(place))
    assert 2 <= stored < 25, "of every data set that was stored, from the journal"
    resumed = run_experiment(build_plan(spec), place, jobs=1)
    # The other estimates of a data set may not have been stored when it was killed.
    assert resumed.reused >= stored
    assert resumed.reused + resumed.computed == 50
    run_experiment(build_plan(spec), tmp_path / "undisturbed", jobs=2)
    assert (place / "runs.h5").read_bytes() == (tmp_path / "undisturbed" / "runs.h5").read_bytes()
    assert len(read_tracks(place)) == 25


def test_a_sealed_file_alone_has_the_tracks_and_the_measures(tmp_path):
    folder = tmp_path / "out"
    run_experiment(build_plan(load(tmp_path, SPEC)), folder, jobs=1)
    tracks, rows = read_tracks(folder), read_stored(folder).rows()
    (folder / "journal.sqlite").unlink()
    again = read_stored(folder).rows()
    assert [row["measures"] for row in again] == [row["measures"] for row in rows]
    alone = read_tracks(folder)
    assert alone.keys() == tracks.keys()
    for name, columns in tracks.items():
        for column, values in columns.items():
            assert np.array_equal(alone[name][column], values, equal_nan=True)
            assert alone[name][column].dtype == values.dtype
