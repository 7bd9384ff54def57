"""Experiments on the frequencies of a signal: specification, measures, storage."""

import json

import numpy as np
import pytest

from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.frequency.flags import Flag
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.sinusoids import Piece, SumOfSinusoids, Tone
from ctid_cli.simulation.frequency_measures import (
    Measuring,
    is_settled,
    measure_track,
)
from ctid_cli.specification.load import spec_from_canonical
from tests.specification.written import SIGNAL as SPEC
from tests.specification.written import load


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
    for override, same in (("success.by=9", True), ("success.band=0.02", False), ("success.window=[20, 30]", False)):
        (other,) = build_plan(load(tmp_path, SPEC, override)).data_cells
        assert (other.hash == cell.hash) is same
        assert np.array_equal(other.dataset(1).record.samples, cell.dataset(1).record.samples)


def made(t, first, flags=None):
    omega = np.column_stack((first, np.full(t.size, 3.0)))
    return FrequencyTrack(t, omega, np.zeros(t.size, np.uint16) if flags is None else flags)


def test_measures_of_a_made_up_track():
    signal = SumOfSinusoids((Tone((Piece(1.8, until=6.0), Piece(2.0))), Tone(3.0)))
    t = 0.5 * np.arange(32)
    first = np.where(t < 2.0, 5.0, 1.8)  # wrong until 2 s, right until the step, late by 1.5 s after it
    first[t >= 7.5] = 2.01
    flags = np.where(t < 3.0, int(Flag.STARTING), 0).astype(np.uint16)
    # before the step; three responses to it, two of them one alarm; two periods of 2 rad/s after it
    flags[np.isin(t, (4.0, 7.0, 7.5, 12.0, 13.0))] = int(Flag.CHANGED)
    true = signal.frequencies_at(t)
    found = measure_track(made(t, first, flags), t, true, signal, Measuring(0.05, (9.0, 12.0)), alarms=True)
    assert found == {
        "omega_1": 2.01, "omega_2": 3.0, "valid_from": 3.0, "settling_time_1": 2.0, "settling_time_2": 0.0,
        "settling_after_step_1": 1.5, "settling_after_step_2": 0.0, "rms_1": pytest.approx(0.01), "rms_2": 0.0,
        "bias_1": pytest.approx(0.01), "bias_2": 0.0, "false_alarms": 2.0, "valid_share": pytest.approx(100 * 21 / 32),
    }  # fmt: skip
    assert is_settled(found, 0.05, 2.0)
    assert not is_settled(found, 0.05, 1.9)
    first[-1] = 2.2
    never = measure_track(made(t, first), t, true, signal, Measuring(0.05), alarms=True)
    assert (never["settling_time_1"], never["settling_after_step_1"]) == (2.0, None)
    assert not is_settled(never, 0.05, None)
