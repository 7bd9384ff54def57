"""Specifications: what is accepted, and what is said, with line and column, about what is not."""

import hashlib
import json
import shutil
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.canonical import canonical_json, content_hash
from ctid_cli.errors import SpecError, UsageError
from ctid_cli.kinds import KINDS, classes
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import json_schema, load_spec, spec_from_canonical
from tests.specification.written import changed, load, problems

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

SIMULATED = """\
experiment: study/one
system: {numerator: [2], denominator: [0.25, 0.7, 1], delay: 8.0}
excitation:
  kind: prbs
  stages: 10
  clock_period: 0.05
sampling: {kind: regular, interval: 0.05, samples: 4000}
noise: {kind: white, snr_db: [5, 15]}
estimators:
  one:
    kind: td_srivc
    poles: 2
    zeros: 0
    delay_bounds: [0, 15]
    lowpass: {cutoff: 0.2, order: 2}
starts: {initial_delay: [0, 3, {uniform: [0, 9]}]}
monte_carlo: {runs: 10, seed: 1}
success: {delay_relative_error: 0.01}
"""

MEASURED = """\
experiment: measured
data: {file: record.csv, offset: remove, estimation_samples: 30}
estimators:
  one: {kind: srivc, poles: 1, zeros: 0}
"""

RECORD = "t,u,y\n" + "".join(f"{k / 10},{(k // 5) % 2},{(k * 7) % 11}\n" for k in range(50))


#: (what is replaced, by what, line, column, key, part of the message); the only problem of the specification.
BROKEN = {
    "misspelt section": ("success:", "sucess:", 18, 1, "sucess", "did you mean 'success'?"),
    "misspelt key": ("delay: 8.0", "delay: 8, dealy: 8", 2, 65, "system.dealy", "did you mean 'delay'?"),
    "unknown key names the known ones": (
        "cutoff: 0.2,", "cutoff: 0.2, ripple: 3,", 15, 28, "estimators.one.lowpass.ripple", "allowed: cutoff, order"
    ),
    "missing key": ("interval: 0.05, ", "", 7, 1, "sampling.interval", "is missing; add it: Sampling interval [s]."),
    "missing nested key": ("cutoff: 0.2, ", "", 15, 5, "estimators.one.lowpass.cutoff", "[rad/s]"),
    "missing kind": ("  kind: prbs\n", "", 3, 1, "excitation.kind", "prbs, gbn, multisine, chirp, gaussian, step"),
    "unknown kind": ("kind: prbs", "kind: prsb", 4, 9, "excitation.kind", "did you mean 'prbs'?"),
    "kind is a list": ("kind: white", "kind: [white]", 8, 15, "noise.kind", "one_over_f, outliers, not a list"),
    "unknown estimator": (
        "kind: td_srivc", "kind: tdsrivc", 11, 11, "estimators.one.kind",
        "additive_srivc, not the text 'tdsrivc'; did you mean 'td_srivc'?",
    ),
    "text for a number": ("stages: 10", "stages: ten", 5, 11, "excitation.stages", "whole number, not the text 'ten'"),
    "quoted number": ("0.05, samples", "'0.05', samples", 7, 37, "sampling.interval", "a number [s], not the text"),
    "number with a unit": ("delay: 8.0", "delay: 8 s", 2, 62, "system.delay", "without quotes, underscores or a unit"),
    "true for a number": ("poles: 2", "poles: true", 12, 12, "estimators.one.poles", "whole number, not true"),
    "number with a point for a whole one": ("stages: 10", "stages: 10.0", 5, 11, "excitation.stages", "write 10"),
    "null for a number": ("clock_period: 0.05", "clock_period:", 6, 16, "excitation.clock_period", "nothing (null)"),
    "infinite": ("delay: 8.0", "delay: .inf", 2, 62, "system.delay", "finite"),
    "not a number, inside a list": ("0.7, 1]", ".nan, 1]", 2, 46, "system.denominator[1]", "finite"),
    "too large for any number": ("delay: 8.0", "delay: " + "9" * 400, 2, 62, "system.delay", "finite"),
    "number for a name": ("study/one", "12", 1, 13, "experiment", "write it in quotes: '12'"),
    "name that climbs": ("study/one", "../one", 1, 13, "experiment", "no '..'"),
    "name with a blank": ("study/one", "study one", 1, 13, "experiment", "letters, digits"),
    "absolute name": ("study/one", "/study", 1, 13, "experiment", "letters, digits"),
    "section is a text": ("{kind: white, snr_db: [5, 15]}", "white", 8, 8, "noise", "must be a mapping"),
    "list that cannot be swept": ("[0, 15]", "[[0, 15]]", 14, 20, "estimators.one.delay_bounds[0]",
                                  "a number [s], not a list"),
    "number for a list": ("numerator: [2]", "numerator: 2", 2, 21, "system.numerator",
                          "a list, not 2: coefficients of B"),
    "empty sweep": ("[5, 15]", "[]", 8, 30, "noise.snr_db", "sweeps nothing"),
    "value twice in a sweep": ("[5, 15]", "[5, 15, 5.0]", 8, 38, "noise.snr_db[2]", "twice"),
    "bad value in a sweep": ("[5, 15]", "[5, loud]", 8, 34, "noise.snr_db[1]", "a number [dB]"),
    "option refused": ("stages: 10", "stages: 30", 5, 11, "excitation.stages", "from 2 to 20, not 30"),
    "option refused in a sweep": ("stages: 10", "stages: [4, 30]", 5, 15, "excitation.stages[1]", "not 30"),
    "nested option refused": ("order: 2", "order: 40", 15, 35, "estimators.one.lowpass.order", "from 1 to 20, not 40"),
    "options that exclude each other": (
        "[5, 15]", "[5, 15], standard_deviation: 1", 8, 1, "noise", "snr_db and standard_deviation were given"
    ),
    "zeros not fewer than poles": ("zeros: 0", "zeros: 2", 13, 12, "estimators.one.zeros", "strictly proper"),
    "zeros not fewer than poles in a sweep": (
        "zeros: 0", "zeros: [0, 1, 2]", 13, 19, "estimators.one.zeros[2]", "got 2 zeros and 2 poles"
    ),
    "system not strictly proper": ("[2]", "[2, 1, 1]", 2, 1, "system", "2 zeros and 2 poles"),
    "unstable system": ("0.7, 1]", "-0.7, 1]", 2, 1, "system", "poles at 1.4-1.428j, 1.4+1.428j rad/s"),
    "integrator": ("0.7, 1]", "0.7, 0]", 2, 1, "system", "unstable"),
    "system without output": ("numerator: [2]", "numerator: [0]", 2, 21, "system.numerator", "zero"),
    "leading zero": ("[0.25,", "[0,", 2, 39, "system.denominator", "leading zeros"),
    "denominator that overflows": ("[0.25,", "[1e-310,", 2, 39, "system.denominator", "scale"),
    "negative delay": ("delay: 8.0", "delay: [8, -1]", 2, 66, "system.delay[1]", "at least 0"),
    "delay longer than the record": ("delay: 8.0", "delay: 200", 2, 62, "system.delay", "not shorter than the record"),
    "delay bounds reversed": ("[0, 15]", "[15, 0]", 14, 19, "estimators.one.delay_bounds", "the smaller"),
    "delay bounds longer than the record": (
        "[0, 15]", "[0, 300]", 14, 19, "estimators.one.delay_bounds", "not shorter than the record (199.95 s)"
    ),
    "start outside the bounds": (
        "[0, 3, {uniform: [0, 9]}]", "[0, 16]", 16, 29, "starts.initial_delay[1]", "outside the delay bounds [0, 15]"
    ),
    "random start outside the bounds": ("[0, 9]", "[0, 19]", 16, 32, "starts.initial_delay[2]", "19 s is outside"),
    "random start reversed": ("[0, 9]", "[9, 0]", 16, 42, "starts.initial_delay[2].uniform", "must be below"),
    "start twice": ("[0, 3,", "[0, 0.0,", 16, 29, "starts.initial_delay[1]", "twice"),
    "start that is none": ("[0, 3,", "[0, soon,", 16, 29, "starts.initial_delay[1]", "{uniform: [low, high]}"),
    "no starts": ("[0, 3, {uniform: [0, 9]}]", "[]", 16, 25, "starts.initial_delay", "empty list"),
    "no runs": ("runs: 10", "runs: 0", 17, 21, "monte_carlo.runs", "at least 1"),
    "no seed": (", seed: 1", "", 17, 1, "monte_carlo.seed", "is missing"),
    "no monte_carlo": ("monte_carlo: {runs: 10, seed: 1}\n", "", 1, 1, "monte_carlo", "is missing"),
    "two numbers of data sets": (
        "runs: 10", "runs: 10, until: {percent_half_width: 1}, at_most: 500", 17, 25, "monte_carlo.until", "keep runs"
    ),
    "no most data sets": (
        "runs: 10", "until: {percent_half_width: 1}", 17, 1, "monte_carlo.at_most", "for example at_most: 5000"
    ),
    "few data sets": (
        "runs: 10", "until: {percent_half_width: 1}, at_most: 100", 17, 56, "monte_carlo.at_most", "at least 200"
    ),
    "most data sets of no rule": ("runs: 10", "at_most: 500", 17, 15, "monte_carlo.at_most", "goes with until"),
    "neither number nor rule": ("runs: 10, ", "", 17, 1, "monte_carlo.runs", "for example runs: 100"),
    "no precision": ("runs: 10", "until: {}, at_most: 500", 17, 15, "monte_carlo.until", "rmse_relative: 0.05"),
    "no system": ("system: {numerator: [2], denominator: [0.25, 0.7, 1], delay: 8.0}\n", "", 1, 1, "system", "missing"),
    "empty success": ("{delay_relative_error: 0.01}", "{}", 18, 1, "success", "leave the section out"),
    "success that is always true": ("0.01", "0", 18, 33, "success.delay_relative_error", "above 0"),
    "relative error of no delay": ("delay: 8.0", "delay: 0", 18, 33, "success.delay_relative_error", "above zero"),
    "estimator twice": (
        "starts:", "  one: {kind: svf, poles: 2, zeros: 0}\nstarts:", 16, 3, "estimators.one", "first on line 10"
    ),
    "estimator name": ("  one:", "  o ne:", 10, 3, "estimators.o ne", "letters, digits"),
    "tab": ("    poles: 2", "\tpoles: 2", 12, 1, "", "indent with spaces"),
    "too many samples": ("4000", "1000000000", 7, 52, "sampling.samples", "not supported"),
    "clock too fast": ("clock_period: 0.05", "clock_period: 1e-9", 6, 17, "excitation.clock_period", "clock periods"),
    "two experiments": ("starts:", "---\nstarts:", 16, 1, "", "more than one YAML document"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_specifications(tmp_path, name):
    old, new, line, column, key, message = BROKEN[name]
    (problem,) = problems(tmp_path, changed(SIMULATED, (old, new)))
    assert (problem.line, problem.column, problem.key) == (line, column, key)
    assert message in problem.message


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("empty", "", "the file is empty"),
        ("comment", "# nothing\n", "the file is empty"),
        ("list", "- a\n- b\n", "not a list"),
        ("text", "experiment", "not the text"),
    ],
)
def test_files_that_hold_no_mapping(tmp_path, name, text, message):
    (problem,) = problems(tmp_path, text)
    assert (problem.line, problem.column) == (1, 1)
    assert message in problem.message


def test_a_precision_needs_something_that_it_is_the_precision_of(tmp_path):
    asked = "until: {percent_half_width: 1, rmse_relative: 0.05}, at_most: 500"
    text = changed(SIMULATED, ("runs: 10", asked), ("success: {delay_relative_error: 0.01}\n", ""))
    (problem,) = problems(tmp_path, text)
    assert (problem.key, problem.line) == ("monte_carlo.until.percent_half_width", 17)
    assert "add success" in problem.message
    (tmp_path / "record.csv").write_text(RECORD, encoding="utf-8")
    (problem,) = problems(tmp_path, MEASURED + f"monte_carlo: {{{asked}, seed: 1}}\n")
    assert problem.key == "monte_carlo.until"
    assert "runs: 1" in problem.message


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(UsageError, match="does not exist"):
        load_spec(tmp_path / "none.yaml")
    with pytest.raises(UsageError, match="folder"):
        load_spec(tmp_path)


def test_a_specification_without_data(tmp_path):
    found = problems(tmp_path, "experiment: a\nestimators: {one: {kind: svf, poles: 1, zeros: 0}}\n")
    assert [(p.line, p.column) for p in found] == [(1, 1)]
    assert "system, excitation and sampling" in found[0].message


def test_everything_wrong_is_reported_at_once_in_the_order_of_the_file(tmp_path):
    text = changed(
        SIMULATED,
        ("delay: 8.0", "dela: 8.0"),
        ("clock_period", "clok_period"),
        ("samples: 4000", "samples: many"),
        ("delay_bounds: [0, 15]", "delay_bounds: [15, 0]"),
        ("seed: 1", "seed: -1"),
        ("starts", "  two: {kind: srivc, poles: 2, zeros: 0, delay: 300}\nstarts"),
    )
    found = problems(tmp_path, text)
    assert [(p.line, p.column, p.key) for p in found] == [
        (2, 55, "system.dela"),
        (3, 1, "excitation.clock_period"),
        (6, 3, "excitation.clok_period"),
        (7, 52, "sampling.samples"),
        (14, 19, "estimators.one.delay_bounds"),
        (18, 31, "monte_carlo.seed"),
    ]
    # Sections that are right are still held against each other.
    found = problems(tmp_path, text.replace("samples: many", "samples: 4000"))
    assert (16, 49, "estimators.two.delay") in [(p.line, p.column, p.key) for p in found]


def test_fewer_samples_than_parameters(tmp_path):
    text = changed(
        SIMULATED, ("samples: 4000", "samples: [5, 4000]"), ("delay: 8.0", "delay: 0.01"),
        ("delay_bounds: [0, 15]", "delay_bounds: [0, 0.06]"), ("[0, 3, {uniform: [0, 9]}]", "0"),
    )  # fmt: skip
    (problem,) = problems(tmp_path, text)
    assert (problem.line, problem.column, problem.key) == (10, 3, "estimators.one")
    assert "3 samples after the first 0.06 s are too few for 4 parameters" in problem.message
    assert "(with sampling.samples = 5)" in problem.message
    # One more is enough: as many equations as unknowns and one to spare.
    assert load(tmp_path, text.replace("samples: [5, 4000]", "samples: 7"))


def test_two_names_for_one_estimator(tmp_path):
    two = "  two: {poles: 2, kind: td_srivc, zeros: 0, delay_bounds: [0, 15.0], lowpass: {cutoff: 0.2}}\n"
    (problem,) = problems(tmp_path, changed(SIMULATED, ("starts:", two + "starts:")))
    assert (problem.line, problem.column, problem.key) == (16, 3, "estimators.two")
    assert "the same settings as 'one'" in problem.message


def test_excitation_and_sampling_are_tried_together(tmp_path):
    step = ("  kind: prbs\n  stages: 10\n  clock_period: 0.05\n", "  kind: step\n  time: [3, 1e3]\n")
    (problem,) = problems(tmp_path, changed(SIMULATED, step))
    assert (problem.line, problem.column, problem.key) == (3, 1, "excitation")
    assert "too late" in problem.message
    assert "(with excitation.time = 1000.0)" in problem.message


def test_nothing_random_needs_no_monte_carlo(tmp_path):
    changes = [
        ("  kind: prbs\n  stages: 10\n  clock_period: 0.05\n", "  kind: step\n"),
        ("monte_carlo: {runs: 10, seed: 1}\n", ""),
        (", {uniform: [0, 9]}]", "]"),
    ]
    (problem,) = problems(tmp_path, changed(SIMULATED, *changes))
    assert problem.key == "monte_carlo"
    assert "the noise is random" in problem.message
    plan = build_plan(load(tmp_path, changed(SIMULATED, *changes), "noise=null"))
    assert plan.runs == 1
    assert plan.data_cells[0].dataset(0).record.n_samples == 4000
    (problem,) = problems(tmp_path, changed(SIMULATED, *changes[:2]), "noise=null")
    assert problem.key == "starts.initial_delay[2]"
    assert "needs a seed" in problem.message


def test_slow_sampling_is_a_warning(tmp_path):
    # Poles at 2 rad/s: the limit is pi / 2 = 1.5708 s.
    exact = "sampling.input_record=exact"
    assert load(tmp_path, changed(SIMULATED, ("interval: 0.05", "interval: 1.57")), exact).warnings == ()
    (warning,) = load(tmp_path, changed(SIMULATED, ("interval: 0.05", "interval: [0.05, 1.58]")), exact).warnings
    assert warning.startswith(f"{tmp_path / 'spec.yaml'}:7:37: sampling.interval: ")
    assert "slower than twice the fastest pole" in warning
    assert "(with interval = 1.58)" in warning
    random = ("{kind: regular, interval: 0.05,", "{kind: uniform_intervals, low: 1.0, high: 2.2,")
    assert len(load(tmp_path, changed(SIMULATED, random), exact).warnings) == 1


def test_starts_that_nobody_uses_are_a_warning(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    assert "no estimator here uses a start" in load(tmp_path, MEASURED + "starts: {initial_delay: 1}\n").warnings[0]


def test_overrides_are_checked_like_the_file(tmp_path):
    spec = load(tmp_path, SIMULATED, "noise.snr_db=20", "estimators.one.variant=plain", "success.fit_percent=9e1")
    canonical = spec.canonical()
    assert canonical["noise"]["snr_db"] == 20.0
    assert canonical["estimators"]["one"]["variant"] == "plain"
    assert (canonical["success"]["delay_relative_error"], canonical["success"]["fit_percent"]) == (0.01, 90.0)
    found = problems(tmp_path, SIMULATED, "noise.snr_db=[5,abc]", "nois.snr_db=5", "noise.snr=1")
    assert [(p.file, p.line, p.column, p.key) for p in found] == [
        ("--set", 1, 17, "noise.snr_db[1]"),
        ("--set", 2, 1, "nois"),
        ("--set", 3, 1, "noise.snr"),
    ]
    assert "did you mean 'noise'?" in found[1].message


def test_canonical_form_fills_defaults_and_comes_back(tmp_path):
    spec = load(tmp_path, SIMULATED)
    canonical = spec.canonical()
    assert canonical["excitation"] == {"kind": "prbs", "stages": 10, "clock_period": 0.05, "amplitude": 1.0}
    assert canonical["noise"] == {"kind": "white", "snr_db": [5.0, 15.0], "standard_deviation": None, "variance": None}
    assert canonical["starts"] == {"initial_delay": [0.0, 3.0, {"uniform": [0.0, 9.0]}], "parameters": None}
    assert canonical["data"] is None
    assert spec.text == SIMULATED
    again = spec_from_canonical(json.loads(canonical_json(canonical)))
    assert again.canonical() == canonical
    assert spec_from_canonical(json.loads(again.text)).canonical() == canonical
    with pytest.raises(SpecError, match="did you mean 'noise'"):
        spec_from_canonical({**canonical, "nois": None})


def test_one_and_one_point_zero_are_the_same_number_and_minus_zero_is_zero(tmp_path):
    spec = load(tmp_path, SIMULATED)
    text = changed(SIMULATED, ("delay: 8.0", "delay: 8"), ("[2]", "[2.0e+0]"), ("[0, 3,", "[-0.0, 3.0,"))
    assert content_hash(load(tmp_path, text).canonical()) == content_hash(spec.canonical())


def reordered(node, draw):
    if isinstance(node, dict):
        keys = draw(st.permutations(list(node)))
        return {key: reordered(node[key], draw) for key in keys}
    return node


@given(st.data())
def test_the_hash_ignores_key_order_comments_and_layout(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("spec")
    tree = reordered(yaml.safe_load(SIMULATED), data.draw)
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=data.draw(st.sampled_from([None, True, False])))
    if not text.startswith("{"):
        comment = "#" + data.draw(st.text("abc: {}[]#'", max_size=10)) + "\n"
        text = "".join(data.draw(st.sampled_from(["", comment, "\n"])) + line for line in text.splitlines(True))
    assert content_hash(load(folder, text).canonical()) == content_hash(load(folder, SIMULATED).canonical())


@pytest.mark.parametrize(
    "override",
    [
        "system.delay=7",
        "excitation.amplitude=2",
        "sampling.samples=4001",
        "noise.snr_db=[5,16]",
        "estimators.one.tolerance=1e-4",
        "estimators.one.lowpass=null",
        "monte_carlo.seed=2",
        "starts.initial_delay=[1]",
    ],
)
def test_the_hash_sees_every_change(tmp_path, override):
    before, after = load(tmp_path, SIMULATED), load(tmp_path, SIMULATED, override)
    assert content_hash(before.canonical()) != content_hash(after.canonical())


def test_hashes_are_what_they_were():
    """Identity is forever: another hash of the same content would leave all earlier results aside."""
    assert canonical_json({"b": [1.0, 1e-3, None], "a": "é"}) == '{"a":"é","b":[1.0,0.001,null]}'
    assert content_hash({"b": [1.0, 1e-3, None], "a": "é"}) == "1700a7aeb6dfa5c8"
    with pytest.raises(ValueError, match="JSON compliant"):
        canonical_json([float("nan")])


# -- measured records and files ---------------------------------------------------------------------------------------


def test_a_measured_record(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    spec = load(tmp_path, MEASURED)
    # as it was written: results must not depend on where the command was typed
    assert (spec.data.file, spec.folder) == ("record.csv", tmp_path)
    assert spec.measured.file == (tmp_path / "record.csv").as_posix()
    assert len(spec.data.sha256) == 64
    assert spec.warnings == ()


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (None, "there is no such file"),
        ("", "the file is empty"),
        ("t,u,y\n", "no data"),
        ("t,u,z\n0,0,0\n", "y"),
        ("t,u,y\n0,0,0\n1,1,x\n", "record.csv:3"),
        ("t,u,y\n" + "".join(f"{k % 7},{k % 2},{k}\n" for k in range(50)), "record.csv:9"),
        ("t,u,y\n" + "".join(f"{k},1,{k}\n" for k in range(50)), "the input 'u' is constant (1)"),
        ("t,u,y\n" + "".join(f"{k},{k % 2},\n" for k in range(50)), "no sample of the output"),
        ("t,u,y\n" + "".join(f"{k},{k % 2},{k if k > 30 else ''}\n" for k in range(50)), "used for estimation"),
        ("t,u,y\n" + "".join(f"{k},{k % 2},{k}\n" for k in range(20)), "30 samples are asked for and the file has 20"),
    ],
)
def test_records_that_cannot_be_used(tmp_path, record, message):
    if record is not None:
        (tmp_path / "record.csv").write_text(record)
    (problem,) = problems(tmp_path, MEASURED)
    assert (problem.line, problem.column, problem.key) == (2, 14, "data.file")
    assert message in problem.message


def test_what_does_not_go_with_a_measured_record(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    found = problems(tmp_path, MEASURED + "noise: {kind: white, snr_db: 5}\nsuccess: {delay_relative_error: 0.1}\n")
    assert [(p.line, p.key) for p in found] == [(5, "noise"), (6, "success.delay_relative_error")]
    (problem,) = problems(tmp_path, MEASURED + "starts: {initial_delay: [{uniform: [0, 1]}]}\n")
    assert problem.key == "starts.initial_delay[0]"
    assert "needs a seed" in problem.message
    spec = load(tmp_path, MEASURED + "monte_carlo: {runs: 100, seed: 1}\n")
    assert "is run once" in spec.warnings[0]


def test_measured_delay_bounds_and_samples(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    td = changed(
        MEASURED, ("{kind: srivc, poles: 1, zeros: 0}", "{kind: td_srivc, poles: 1, zeros: 0, delay_bounds: [0, 3]}")
    )
    (problem,) = problems(tmp_path, td)
    assert problem.key == "estimators.one.delay_bounds"
    assert "the record (2.9 s)" in problem.message, "the record for estimation ends at sample 30"
    # Samples 0 to 26 come before 2.65 s; three of thirty are left for b0, a1 and the delay.
    (problem,) = problems(tmp_path, td.replace("[0, 3]", "[0, 2.65]"))
    assert "3 samples after the first 2.65 s are too few for 3 parameters" in problem.message


def test_content_hash_of_a_file_is_checked(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    pinned = changed(MEASURED, ("offset", f"sha256: {'0' * 64}, offset"))
    (problem,) = problems(tmp_path, pinned)
    assert (problem.line, problem.key) == (2, "data.sha256")
    good = load(tmp_path, MEASURED).data.sha256
    assert load(tmp_path, pinned.replace("0" * 64, good))


def test_an_input_file(tmp_path):
    from_file = ("  kind: prbs\n  stages: 10\n  clock_period: 0.05\n", "  kind: file\n  file: record.csv\n")
    text = changed(SIMULATED, from_file)
    (problem,) = problems(tmp_path, text)
    assert (problem.line, problem.column, problem.key) == (5, 9, "excitation.file")
    (tmp_path / "record.csv").write_text(RECORD)
    spec = load(tmp_path, text)
    (cell, _) = build_plan(spec).data_cells
    assert "file" not in cell.content["excitation"], "the place of a file is no part of its identity"
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(tmp_path, elsewhere)
    assert build_plan(load(elsewhere, text)).data_cells[0].hash == cell.hash
    assert build_plan(load(elsewhere, text)).spec_hash == build_plan(spec).spec_hash
    (tmp_path / "record.csv").write_text(RECORD + "5.1,1,1\n")
    assert build_plan(load(tmp_path, text)).data_cells[0].hash != cell.hash


def test_the_formula_of_standard_errors_is_part_of_the_identity(tmp_path):
    estimators = {
        formula: build_plan(load(tmp_path, changed(SIMULATED, ("zeros: 0", f"zeros: 0{formula}")))).estimators[0]
        for formula in ("", *(f"\n    covariance: {name}" for name in ("auto", "white", "robust")))
    }
    assert estimators[""].content["covariance"] == "auto"
    assert len({one.hash for one in estimators.values()}) == 3


# -- what is shipped --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", sorted(CONFIGS.rglob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_configs(config):
    spec = load_spec(config)
    meant = ("ignores the loop", "sees the input at its samples only", "covariance: is for white noise")
    assert all(any(words in warning for words in meant) for warning in spec.warnings)
    schema = config.read_text(encoding="utf-8").splitlines()[0].removeprefix("# yaml-language-server: $schema=")
    assert (config.parent / schema).resolve() == CONFIGS / "ctid.schema.json"


def test_the_shipped_schema_is_current():
    assert json.loads((CONFIGS / "ctid.schema.json").read_text(encoding="utf-8")) == json_schema(), (
        "write it anew: ctid schema > configs/ctid.schema.json"
    )


def test_the_schema_knows_every_option_and_its_unit():
    schema = json_schema()
    for name in KINDS:
        for kind, target in classes(name).items():
            section = schema["$defs"][target.__name__]
            assert section["properties"]["kind"]["const"] == kind
            assert set(section["properties"]) - {"kind"} == {option.name for option in fields(target) if option.init}
    interval = schema["$defs"]["RegularSampling"]["properties"]["interval"]
    assert interval["description"] == "Sampling interval [s]."
    assert interval["oneOf"] == [{"type": "number"}, {"type": "array", "items": {"type": "number"}}]
    bounds = schema["$defs"]["TdSrivc"]["properties"]["delay_bounds"]
    assert (bounds["type"], bounds["minItems"], bounds["maxItems"]) == ("array", 2, 2)


def test_the_notice_names_the_shipped_record():
    content = (CONFIGS / "measured" / "buck_converter.csv").read_bytes()
    notice = (CONFIGS / "measured" / "NOTICE.md").read_text(encoding="utf-8")
    assert hashlib.sha256(content).hexdigest() in notice
    assert "Permission is hereby granted" in notice
