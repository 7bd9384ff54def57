"""The Python interface gives the results printed by the commands."""

import io
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ctid_cli
from ctid_cli import (
    CtidError,
    DataError,
    DelayProfile,
    Flag,
    FrequencyTrack,
    Given,
    Record,
    Srivc,
    TransferFunction,
    identify,
    read_record,
    read_results,
    run_experiment,
    simulate,
)
from tests.cli.records import rows, write

SPEC = {
    "experiment": "group/study",
    "system": {"numerator": [2], "denominator": [1, 1]},
    "excitation": {"kind": "gaussian"},
    "sampling": {"kind": "regular", "interval": 0.1, "samples": 200},
    "noise": {"kind": "white", "variance": np.float64(0.01)},
    "estimators": {
        "one": {"kind": "srivc", "poles": 1, "zeros": 0},
        "other": {"kind": "svf", "poles": 1, "zeros": 0, "svf_cutoff": 2.0},
    },
    "monte_carlo": {"runs": 6, "seed": 1},
}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    place = tmp_path_factory.mktemp("out")
    run_experiment(SPEC, place, jobs=1)
    return place


def test_results_are_those_of_the_commands(out, ctid, tmp_path):
    def shown(command):
        return pd.read_csv(io.StringIO(ctid(f"{command} --format csv --out", out).stdout))

    results = read_results(out / "group" / "study")
    assert list(results.estimates["id"]) == list(shown("export group/study")["id"])
    assert results.estimates.attrs["units"]["delay"] == "s"
    np.testing.assert_allclose(results.measures("rmse")["value"], shown("table group/study --measure rmse")["value"])
    assert set(results.measures()["measure"]) == {"bias", "rmse"}
    compared = shown("table group/study --compare one,other")
    np.testing.assert_allclose(results.compare("one", "other")["value"], compared["value"])
    assert results.surprises == []
    ctid("figure group/study --kind box --out", out, "--file", tmp_path / "box.svg")
    assert len(results.figure("box").axes) == 2
    with pytest.raises(CtidError, match=r"there is no kind of figure 'boxes'; did you mean 'box'\? there are meas"):
        results.figure("boxes")
    assert results.summary().strip() == ctid("table group/study --out", out).stdout.strip()
    assert repr(results).startswith("group/study: 12 of 12 estimates by one, other, 0 failed\n  in 1 data cell")
    assert "<td" in results._repr_html_()
    # A mapping and a file with equal content are one experiment.
    again = run_experiment(out / "group" / "study" / "spec.yaml", out, jobs=1)
    assert set(again.estimates["id"]) == set(results.estimates["id"])


def test_a_fit_is_shown_as_by_the_command(ctid, tmp_path):
    record = write(tmp_path / "record.csv", rows())
    printed = ctid("fit --poles 2 --zeros 0 --integrators 0 --out", tmp_path, record).stdout
    found = identify(read_record(record), Given(poles=2, zeros=0, integrators=0))
    assert found.summary().split("\n\n")[3:5] == printed.split("\n\n")[3:5]
    assert len(found.plot().axes) == 4
    assert found._repr_html_().count("<table") == 4
    found.plot(tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").read_bytes().startswith(b"\x89PNG")
    fit = found.fit
    assert found.fit_percent == fit.fit_percent
    assert found.parameters == fit.parameters | {"delay": found.options.delay_bounds[0]} | fit.parameters
    assert found.validate(found.records[0]).fit_percent == pytest.approx(fit.fit_percent)
    frame = fit.to_frame()
    assert frame["estimate"].to_dict() == fit.parameters
    assert frame["standard_error"].to_dict() == fit.standard_errors
    assert list(frame["unit"])[:4] == ["1/s", "1/s^2", "out/in/s^2", "s"]
    assert f"fit {fit.fit_percent:.5g} % of {fit.count} samples" in fit.summary()
    assert fit._repr_html_().count("<tr>") == 1 + len(fit.parameters)
    with pytest.raises(CtidError, match=r"a single MeasuredFit does not hold the record .* identify\("):
        fit.plot()


def test_a_track_as_text_as_a_table_and_as_a_figure(snapshot):
    flags = np.zeros(40, np.uint16)
    flags[:10] = int(Flag.GAP)
    omega = 2 * np.pi * np.column_stack((np.linspace(9.0, 11.0, 40), np.full(40, 30.0)))
    online = FrequencyTrack(0.1 * np.arange(40), omega, flags)
    assert online.summary() == snapshot
    assert online.to_frame().shape == (40, 6)
    assert online._repr_html_().count("<tr>") == 3
    assert {"tone 1 [Hz]", "tone 2 [Hz]"} <= {axes.get_ylabel() for axes in online.plot().axes}


def test_completion_knows_the_public_names_and_no_others():
    stub = Path(ctid_cli.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    names = [name for line in re.findall(r"^from .*", stub, re.MULTILINE) for name in re.findall(r" as (\w+)", line)]
    assert set(names) == set(ctid_cli.__all__) == {name for name in dir(ctid_cli) if name[0] != "_"}
    assert len(names) == len(set(names))
    for name in names:
        assert getattr(ctid_cli, name).__name__ == name


T = np.arange(5.0)
RECORD, PROFILE = Record.from_arrays(T, T, T), DelayProfile(1, 0, (0.0, 0.0))


@pytest.mark.parametrize(
    ("mistaken", "message"),
    [
        (lambda: Record(T, T, T), "inputs must be a HeldSignal, such as HeldSignal.t, u., or .*, not ndarray"),
        (
            lambda: simulate(TransferFunction([1], [1, 1]), T, T),
            "input of a simulation must be a HeldSignal, .*, not ndarray",
        ),
        (lambda: PROFILE.fit(T), "records must be a Record or a list of these, not ndarray"),
        (lambda: identify(PROFILE, [RECORD]), "records must be a Record or a list of these, not DelayProfile"),
        (lambda: identify([RECORD], Srivc(1, 0)), "options of identify must be .*, not Srivc; any estimator fits by"),
        (lambda: Srivc(1, 0).fit(RECORD, 0.5), "start must be a Start, .*, not float"),
    ],
)
def test_what_is_no_record_signal_or_start_is_refused_by_its_type(mistaken, message):
    with pytest.raises((DataError, TypeError), match=message):
        mistaken()
