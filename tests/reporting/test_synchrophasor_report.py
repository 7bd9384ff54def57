"""Words, columns and figures of synchrophasors and of their check."""

import csv
import io

import h5py
import numpy as np
import pytest

from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.synchrophasor import measure_synchrophasors
from ctid_cli.frequency.synchrophasor_check import CheckedLimit, SynchrophasorCheck
from ctid_cli.frequency.synchrophasor_limits import limits_of
from ctid_cli.reporting.layout import csv_text
from ctid_cli.reporting.result_views import plot, summary, to_frame
from ctid_cli.reporting.synchrophasor_check_report import check_object, check_report
from ctid_cli.reporting.synchrophasor_plot import synchrophasor_drawing
from ctid_cli.reporting.synchrophasor_report import (
    synchrophasor_bytes,
    synchrophasor_object,
    synchrophasor_table,
    synchrophasor_text,
)
from ctid_cli.signals.sampled_signal import SampledSignal

RATE = 1000.0
T = np.arange(1000) / RATE


def signal(name="va", phase=0.0, step=0.0):
    y = 325.0 * np.cos(2 * np.pi * 50.1 * T + phase + step * (T > 0.6))
    return SampledSignal(y, 1 / RATE, 0.0, "mains.csv", name, "t", "s", "V")


def measured(*signals, **options):
    return measure_synchrophasors(np.column_stack([each.samples for each in signals]), 1 / RATE, **options)


THREE = [signal(name, -2 * np.pi * k / 3) for k, name in enumerate(("va", "vb", "vc"))]


def test_columns_of_one_phase_and_of_three():
    table = synchrophasor_table(measured(THREE[0]))
    columns = ["t", "magnitude", "angle", "frequency_hz", "rocof_hz_per_s", "error_percent", "valid", "flags"]
    assert list(table) == columns
    three = synchrophasor_table(measured(*THREE))
    assert set(three) - set(table) == {f"{what}_{k}" for what in ("magnitude", "angle") for k in (1, 2, 3)}
    assert three["angle_1"] - three["angle_2"] == pytest.approx(2 * np.pi / 3, abs=1e-6)
    assert three["angle"] == pytest.approx(three["angle_1"], abs=1e-6)


def test_units_are_in_hdf5():
    content = synchrophasor_bytes(measured(*THREE), "h5", "V")
    with h5py.File(io.BytesIO(content)) as file:
        units = {name: column.attrs.get("unit") for name, column in file.items()}
    assert units["magnitude"] == units["magnitude_3"] == "V"
    assert units["angle"] == units["angle_2"] == "rad"
    assert (units["frequency_hz"], units["rocof_hz_per_s"], units["t"], units["valid"]) == ("Hz", "Hz/s", "s", None)


def test_text_says_what_the_numbers_are_and_why_rows_are_not_valid():
    stepping = signal(step=0.5)
    text = synchrophasor_text([stepping], measured(stepping))
    assert max(map(len, text.splitlines())) <= 100
    for part in ("Class P at 50 Hz, 50 reports a second", "harmonics above the 9th are folded", "magnitude, rms [V]"):
        assert part in text
    assert "% of the rows are not valid" in text
    assert "a step, another tone" in " ".join(text.split())
    assert "Warnings" not in synchrophasor_text([signal()], measured(signal()))
    assert "positive sequence, 'va' leading" in synchrophasor_text(THREE, measured(*THREE))


def test_exchanged_phases_are_named():
    exchanged = [THREE[0], THREE[2], THREE[1]]
    assert "exchange two of the names" in synchrophasor_text(exchanged, measured(*exchanged))
    assert "exchange" not in synchrophasor_text(THREE, measured(*THREE))


def test_object_holds_ranges_over_the_valid_rows():
    stepping = signal(step=0.5)
    found = measured(stepping)
    content = synchrophasor_object([stepping], found)
    assert content["frequency_hz"]["lowest"] == pytest.approx(50.1, abs=0.02)
    assert content["magnitude"]["median"] == pytest.approx(325 / np.sqrt(2), rel=1e-4)
    assert 80 < content["valid_percent"] < 100
    assert (content["nominal"], content["performance_class"], content["reporting_rate"]) == (50, "P", 50)
    nothing = synchrophasor_object([stepping], measured(signal(), nominal=60))
    assert nothing["frequency_hz"] == {"median": None, "lowest": None, "highest": None}
    assert nothing["warnings"][0] == "No row is valid."


def test_the_figure_leaves_out_what_is_not_valid():
    found = measured(signal(step=0.5))
    assert (found.flags & Flag.CHANGE).any()
    figure = synchrophasor_drawing(found, "V", "mains.csv").figure()
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["frequency [Hz]", "ROCOF [Hz/s]", "magnitude [V]", "angle [rad]"]
    drawn = figure.axes[0].lines[0].get_ydata()
    assert (np.isfinite(drawn) == found.valid).all()
    assert figure.axes[0].collections


def checked(worst):
    limits = limits_of(60, "M", 60)
    rows = tuple(CheckedLimit(limit, worst * (limit.largest or 1.0), "somewhere") for limit in limits)
    return SynchrophasorCheck(60, "M", 60, 7680.0, rows)


def test_the_verdict_comes_first():
    passed, failed = checked(0.5), checked(1.5)
    assert (
        check_report(passed).draw().startswith("PASS: class M at 60 Hz, 60 reports a second: all 29 limits are kept.")
    )
    assert check_report(failed).draw().startswith("NOT PASSED: class M at 60 Hz, 60 reports a second: 29 of 29 limits")
    assert " !" not in check_report(passed).draw()
    assert check_report(failed).draw().count(" ! ") == 29
    assert max(map(len, check_report(failed).draw().splitlines())) <= 100
    assert (check_object(passed)["passed"], check_object(failed)["passed"]) == (True, False)


def test_every_limit_has_its_source_in_the_file():
    rows = list(csv.DictReader(io.StringIO(csv_text(check_object(checked(0.5))["limits"]))))
    assert len(rows) == len(limits_of(60, "M", 60))
    assert all(row["source"].startswith("IEEE C37.118.1") for row in rows)
    unlimited = [row for row in rows if not row["limit"]]
    assert {row["quantity"] for row in unlimited} == {"rfe"}
    assert {row["passed"] for row in rows} == {"True"}


def test_the_same_from_python():
    found = measured(signal(step=0.5))
    assert summary(found).splitlines()[0].split() == ["median", "lowest", "highest"]
    assert "% of the rows are not valid" in summary(found)
    assert found._repr_html_().count("<tr>") == 5
    frame = to_frame(found)
    assert frame.index.name == "t"
    assert frame["frequency_hz"].to_numpy() == pytest.approx(found.frequency, nan_ok=True)
    assert plot(found).startswith(b"<?xml")
    assert summary(checked(0.5)) == check_report(checked(0.5)).draw()
    assert to_frame(checked(0.5)).shape == (len(limits_of(60, "M", 60)), 8)
