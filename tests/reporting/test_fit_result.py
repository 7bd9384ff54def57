"""A fit as text, as JSON, and as a figure."""

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.canonical import plain
from ctid_cli.errors import DataError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import identify
from ctid_cli.estimators.identification_warnings import of_status
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.fit_result import FitResult, derived_of, parameters_of
from ctid_cli.reporting.identification_plot import identification_drawing
from ctid_cli.reporting.records import Records
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)
UNITS = Units("ms", "V", "mA")


def measurement(seed=0, *, n=800, units=("ms", "V", "mA"), notes=()):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    signal = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], n // 5), 5))
    y = simulate(SYSTEM, signal, t) + 0.1 * rng.standard_normal(n)
    return Measurement(Record(t, y, signal, name=f"file{seed}.csv"), *units, "t", "u", "y", notes=notes)


def content_of(result, measurements, other=None):
    return dict(plain(FitResult(result, Records(measurements, other)).content()))


@pytest.fixture(scope="module")
def fitted():
    one = measurement(notes=("A note.",))
    other = measurement(1)
    return identify(DelayProfile(2, 0, (0, 3)), [one.record], other.record), [one], other


def test_parameters_carry_the_units_of_the_record(fitted):
    result, _, _ = fitted
    units = {item.name: item.unit for item in parameters_of(result, UNITS)}
    assert units == {"b0": "mA/V/ms^2", "a1": "1/ms", "a2": "1/ms^2", "delay": "ms"}


def test_units_of_states_and_offsets():
    assert [Units().of(name, 3, 1) for name in ("x1", "x2_2", "x3", "offset_1", "b1")] == [
        "out",
        "out/s",
        "out/s^2",
        "out",
        "out/in/s^3",
    ]


def test_frequencies_called_hertz_are_in_hertz(fitted):
    result, _, _ = fitted
    rows = {row.name: row for row in derived_of(result, UNITS)}
    radians = rows["natural_frequency_1"]
    assert radians.unit == "rad/ms"
    hertz = rows["natural_frequency_1_hz"]
    assert (hertz.estimate, hertz.unit) == (pytest.approx(1000 * radians.estimate / (2 * math.pi)), "Hz")
    assert hertz.standard_error == pytest.approx(1000 * radians.standard_error / (2 * math.pi))
    assert rows["static_gain"].unit == "mA/V"
    assert "natural_frequency_1_hz" not in {row.name for row in derived_of(result, Units("fortnight"))}


def test_the_object_holds_the_numbers_of_the_fit(fitted):
    result, measurements, other = fitted
    content = content_of(result, measurements, other)
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    fit = result.fit
    assert content["model"] == {
        "numerator": fit.model.numerator.tolist(),
        "denominator": fit.model.denominator.tolist(),
        "delay": fit.model.delay,
    }
    assert (content["fit_percent"], content["r2"], content["cost"]) == (fit.fit_percent, fit.r2, fit.cost)
    assert content["status"] == "CONVERGED"
    assert content["initial_state"] == {"treatment": "rest", "values": [[]]}
    assert content["offset"] == {"treatment": "none", "output": [0.0], "input": [0.0]}
    (mode,) = content["modes"]
    assert mode["frequency_hz"] == pytest.approx(1000 * math.sqrt(fit.model.denominator[2]) / (2 * math.pi))
    assert mode["damping"] == pytest.approx(fit.model.denominator[1] / 2 / math.sqrt(fit.model.denominator[2]))
    assert content["validation"]["r2"] == result.validation.r2
    assert content["notes"] == ["A note."]
    assert content["criteria"]["bic"] == pytest.approx(800 * math.log(fit.cost) + 4 * math.log(800))
    for item in content["parameters"]:
        assert item["low"] < item["estimate"] < item["high"]


def test_what_is_not_finite_is_null_and_a_dash():
    one = measurement()
    result = identify(DelayProfile(2, 0, (0, 0.5)), [one.record])
    content = content_of(result, [one])
    delay = next(item for item in content["parameters"] if item["name"] == "delay")
    assert (delay["standard_error"], delay["relative_percent"], delay["status"]) == (None, None, "at bound")
    assert content["validation"] is None
    (line,) = (line for line in FitResult(result, Records([one])).summary().splitlines() if line.startswith("delay "))
    assert line.split()[1:4] == ["0.5", "-", "-"]


def test_a_model_of_noise_has_no_standard_errors():
    one = measurement()
    noise = Record(one.record.t, np.random.default_rng(4).standard_normal(800), one.record.input)
    one = replace(one, record=noise)
    result = identify(DelayProfile(1, 0, (0, 3)), [one.record])
    content = content_of(result, [one])
    answer = content["answer"]
    assert (answer["seen"], answer["explained"] < answer["by_chance"]) == (False, True)
    assert answer["p_value"] > 0.05
    assert {item["status"] for item in content["parameters"]} == {"undetermined"}
    assert "There are no standard errors, as no answer" in FitResult(result, Records([one])).summary()


def test_real_poles_are_modes_too():
    one = measurement()
    model = identify(DelayProfile(1, 0, (0, 3)), [one.record])
    (mode,) = content_of(model, [one])["modes"]
    assert mode == {
        "frequency_hz": pytest.approx(1000 * model.fit.model.denominator[1] / (2 * math.pi)),
        "damping": 1.0,
    }


def test_text(fitted, snapshot):
    result, measurements, other = fitted
    text = FitResult(result, Records(measurements, other), ["Hold: zoh, for a reason."]).summary()
    assert max(map(len, text.splitlines())) <= 100
    # Three digits do not depend on the processor.
    assert re.sub(r"\d+\.\d+", lambda found: f"{float(found[0]):.3g}", text) == snapshot


def test_forms(fitted):
    result, measurements, _ = fitted
    found = FitResult(result, Records(measurements))
    assert found.write("md").count("|:--|") == 6
    assert found.write("latex").count(r"\begin{tabular}") == 4
    assert found.write("csv").splitlines()[0] == ",".join(["name", *found.to_frame().columns])
    assert json.loads(found.write("json")) == content_of(result, measurements)


def test_units_of_several_files():
    assert Records([measurement(), measurement(units=(None, None, None))]).units == UNITS
    assert Records([measurement(units=(None, None, None))]).units == Units("s", "in", "out")
    with pytest.raises(DataError, match=r"file1.csv: the time is in s, that of another file in ms"):
        _ = Records([measurement(), measurement(1, units=("s", "V", "mA"))]).units


def test_the_figure_is_the_same_every_time_and_names_its_axes(fitted):
    result, measurements, _ = fitted
    figure = identification_drawing(result, measurements, UNITS).saved()
    assert figure == identification_drawing(result, measurements, UNITS).saved()
    root = ElementTree.fromstring(figure)
    assert root.tag.endswith("svg")
    # Text is drawn as outlines; what it says stands in comments beside them.
    for label in ("y [mA]", "t [ms]", "residual [mA]", "delay [ms]", "lag [samples]"):
        assert f"<!-- {label} -->".encode() in figure


def test_the_figure_of_several_experiments_and_a_known_delay():
    files = [measurement(seed) for seed in range(4)]
    result = identify(DelayProfile(2, 0, (0.73, 0.73)), [item.record for item in files])
    figure = identification_drawing(result, files, UNITS).saved()
    assert b"<!-- experiment 3 of 4 -->" in figure
    assert b"experiment 4" not in figure
    assert b"known delay 0.73 ms" in figure


def test_a_loss_names_the_samples_that_count_for_little():
    one = measurement(n=300)
    y = one.record.y.copy()
    y[[30, 200]] += 9.0
    files = [replace(one, record=Record(one.record.t, y, one.record.input))]
    result = identify(DelayProfile(2, 0, (0.73, 0.73), loss="tukey"), [files[0].record])
    loss = content_of(result, files)["loss"]
    assert (loss["kind"], loss["outliers"]) == ("tukey", [[pytest.approx(3.0), pytest.approx(20.0)]])
    assert loss["scales"] == [pytest.approx(0.1, rel=0.3)]
    text = " ".join(FitResult(result, Records(files)).summary().split())
    assert "2 of 300 samples have no weight, at 3, 20 ms; fit 8" in text
    assert f"fit {loss['fit_percent']:.5g} % without them" in text
    assert b"counts for little" in identification_drawing(result, files, UNITS).saved()
    squares = content_of(identify(DelayProfile(2, 0, (0.73, 0.73)), [one.record]), files)["loss"]
    assert squares == {"kind": "squares", "scales": None, "outliers": [[]], "fit_percent": None}


def test_starts_bounds_and_poles_at_infinity_are_said(fitted):
    result, files, _ = fitted
    text, content = FitResult(result, Records(files)).summary(), content_of(result, files)
    starts = result.fit.starts
    assert content["starts"] == {"tried": starts.tried, "agree": starts.agree}
    assert "the best of " in text
    assert ", reached " in text
    assert content["box"]["poles"] == pytest.approx([1e-4 / 79.9, 10 / 0.1])
    assert content["box"]["delay"] == [0, 3]
    assert content["poles_at_infinity"] == 0
    # No bound is active, so that the text need not name any.
    assert "admissible" not in text
    lost = replace(result.fit, poles_at_infinity=2, status=Status.AT_BOUND)
    text = FitResult(replace(result, fit=lost), Records(files)).summary()
    assert "poles from 1.252e-06 to 100 rad/ms, imaginary parts up to 31.38 rad/ms" in text
    assert of_status(lost)[0].startswith("2 poles run to infinity")
