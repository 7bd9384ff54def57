"""Specifications of sums of submodels and of loops: what is accepted, and what is said about what is not."""

import json

import pytest

from ctid_cli.canonical import canonical_json
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.sampling import geometric_sizes
from ctid_cli.specification.load import spec_from_canonical
from tests.specification.written import changed, load, problems

CLOSED = """\
experiment: additive/one
system:
  additive:
    - {numerator: [3], denominator: [0.25, 0.25, 1]}
    - {numerator: [1], denominator: [0.025, 0.01, 1]}
loop:
  controller: {pid: {kp: 0.0115, ki: 0.00725, kd: 0.00454}}
  reference: {kind: gaussian, standard_deviation: 1.0}
sampling: {kind: regular, interval: 0.05, samples: 500}
noise: {kind: white, variance: 0.01}
estimators:
  both: {kind: additive_srivc, terms: [{poles: 2, zeros: 0}, {poles: 2, zeros: 0}], instruments: closed_loop}
  one: {kind: srivc, poles: 4, zeros: 2, instruments: closed_loop}
starts: {parameters: {relative_uniform: 0.05}}
monte_carlo: {runs: 2, seed: 1}
success: {parameter_relative_error: 0.1}
"""

MEASURED = """\
experiment: measured
data: {file: record.csv, reference: r}
loop: {controller: {numerator: [0.5, -0.4], denominator: [1, -1]}}
estimators:
  one: {kind: additive_srivc, terms: [{poles: 1, zeros: 0}], instruments: closed_loop}
"""

RECORD = "t,u,y,r\n" + "".join(f"{k / 10},{(k // 5) % 2},{(k * 7) % 11},{(k // 3) % 2}\n" for k in range(50))


MODE = "{numerator: [3], denominator: [0.25, 0.25, 1]}"
REFERENCE = "{kind: gaussian, standard_deviation: 1.0}"
PID = "{pid: {kp: 0.0115, ki: 0.00725, kd: 0.00454}}"
WHITE = "{kind: white, variance: 0.01}"

#: (what is replaced, by what, line, column, key, part of the message); the only problem of the specification.
BROKEN = {
    "system in two forms": ("  additive:", "  numerator: [1]\n  additive:", 3, 3, "system.numerator", "a second time"),
    "no submodel": ("    - " + MODE + "\n    - {numerator: [1], denominator: [0.025, 0.01, 1]}\n", "    []\n", 4, 5,
                    "system.additive", "empty list"),
    "submodel is a number": (MODE, "3", 4, 7, "system.additive[0]", "mapping with the keys numerator, denominator"),
    "submodel without denominator": (", denominator: [0.25, 0.25, 1]", "", 4, 7, "system.additive[0].denominator",
                                     "is missing"),
    "misspelt key of a submodel": ("[0.25, 0.25, 1]", "[0.25, 0.25, 1], integrator: 1", 4, 54,
                                   "system.additive[0].integrator", "did you mean 'integrators'?"),
    "negative integrators": ("[0.25, 0.25, 1]", "[0.25, 0.25, 1], integrators: -1", 4, 67,
                             "system.additive[0].integrators", "at least 0"),
    "improper submodel": ("[3]", "[1, 2, 3, 4]", 4, 19, "system.additive[0].numerator",
                          "more zeros (3) than poles (2)"),
    "pole at the origin": ("[0.25, 0.25, 1]", "[0.25, 0.25, 0]", 4, 37, "system.additive[0].denominator",
                           "as integrators"),
    "leading zero": ("[0.25, 0.25, 1]", "[0, 0.25, 1]", 4, 37, "system.additive[0].denominator", "leading zeros"),
    "submodel that overflows": ("[0.25, 0.25, 1]", "[0.25, 0.25, 1e-310]", 4, 37, "system.additive[0].denominator",
                                "scale the coefficients"),
    "submodel without output": ("[3]", "[0]", 4, 19, "system.additive[0].numerator", "leave it out"),
    "unstable submodel": ("[0.25, 0.25, 1]", "[0.25, -0.25, 1]", 4, 7, "system.additive[0]",
                          "poles at 0.5-1.936j, 0.5+1.936j rad/s"),
    "common poles": ("[0.025, 0.01, 1]", "[0.25, 0.25, 1]", 4, 5, "system.additive", "in common"),
    "two integrating submodels": (
        MODE + "\n    - {numerator: [1],", "{numerator: [3], denominator: [1, 1], integrators: 1}\n"
        "    - {numerator: [1], integrators: 2,", 4, 5, "system.additive", "at the origin"
    ),
    "two biproper submodels": (
        "[3], denominator: [0.25, 0.25, 1]}\n    - {numerator: [1]", "[1, 2, 3], denominator: [0.25, 0.25, 1]}\n"
        "    - {numerator: [1, 1, 1]", 4, 5, "system.additive", "g1 and g2 have as many zeros as poles"
    ),
    "loop and excitation": ("sampling:", "excitation: {kind: gaussian}\nsampling:", 9, 1, "excitation",
                            "keep one of the two"),
    "no reference": (f"  reference: {REFERENCE}\n", "", 6, 1, "loop.reference", "is missing"),
    "no controller": (f"  controller: {PID}\n", "", 6, 1, "loop.controller", "is missing"),
    "unknown reference": ("kind: gaussian", "kind: gausian", 8, 21, "loop.reference.kind", "did you mean 'gaussian'?"),
    "controller in two forms": (PID, PID[:-1] + ", numerator: [1]}", 7, 61, "loop.controller.numerator",
                                "a second time"),
    "controller that is none": (PID, "3", 7, 15, "loop.controller", "mapping with the keys numerator, denominator"),
    "controller of the future": (PID, "{numerator: [1, 2, 3], denominator: [1, 0]}", 7, 3, "loop.controller",
                                 "samples of the future"),
    "controller with a leading zero": (PID, "{numerator: [1], denominator: [0, 1]}", 7, 45,
                                       "loop.controller.denominator", "leading zeros"),
    "controller that is zero": (PID, "{pid: {kp: 0}}", 7, 3, "loop.controller", "there is no loop"),
    "misspelt gain": ("kp:", "kP:", 7, 22, "loop.controller.pid.kP", "allowed: kp, ki, kd"),
    "gain that is no number": ("0.0115", "high", 7, 26, "loop.controller.pid.kp", "a number [input unit/output unit]"),
    "enters nowhere": ("sampling:", "  enters: output\nsampling:", 9, 11, "loop.enters", "'controller', 'input'"),
    "unstable loop": ("0.0115", "0.575", 7, 3, "loop.controller",
                      "its largest pole has the magnitude 1.00868"),
    "irregular loop": ("regular, interval: 0.05", "uniform_intervals, low: 0.04, high: 0.06", 9, 18, "sampling.kind",
                       "the controller is discrete"),
    "ratio in a loop": (WHITE, "{kind: white, snr_db: 10}", 10, 30, "noise.snr_db", "the noise feeds back"),
    "ratios in a loop": (WHITE, "{kind: white, snr_db: [10, 20]}", 10, 30, "noise.snr_db", "the noise feeds back"),
    "coloured ratio in a loop": (
        WHITE, "{kind: arma, numerator: [1], denominator: [1, -0.5], snr_db: 10}", 10, 69, "noise.snr_db",
        "or its innovation_variance"
    ),
    "two levels": (WHITE, "{kind: white, variance: 0.01, snr_db: 10}", 10, 1, "noise",
                   "snr_db and variance were given"),
    "unstable noise": (WHITE, "{kind: arma, numerator: [1], denominator: [1, -1.5], variance: 1}", 10, 50,
                       "noise.denominator", "magnitude 1.5"),
    "noise without a filter": (WHITE, "{kind: arma, numerator: [1], variance: 1}", 10, 1, "noise.denominator",
                               "is missing"),
    "reference that cannot be sampled": (
        REFERENCE, "{kind: step, time: 100}", 8, 3, "loop.reference", "too late"
    ),
    "reference file that is missing": (REFERENCE, "{kind: file, file: none.csv}", 8, 33, "loop.reference.file",
                                       "no such file"),
    "no terms": ("terms: [{poles: 2, zeros: 0}, {poles: 2, zeros: 0}]", "terms: []", 12, 39, "estimators.both.terms",
                 "empty list"),
    "term without zeros": ("[{poles: 2, zeros: 0}, {", "[{poles: 2}, {", 12, 40, "estimators.both.terms[0].zeros",
                           "is missing"),
    "swept term": ("[{poles: 2, zeros: 0}, {", "[{poles: [1, 2], zeros: 0}, {", 12, 48,
                   "estimators.both.terms[0].poles", "cannot be swept"),
    "improper term": ("[{poles: 2, zeros: 0}, {", "[{poles: 2, zeros: 4}, {", 12, 58, "estimators.both.terms[0].zeros",
                      "more zeros than poles"),
    "refused terms": (
        "[{poles: 2, zeros: 0}, {poles: 2,", "[{poles: 2, zeros: 0, integrators: 1}, {poles: 2, integrators: 1,",
        12, 39, "estimators.both.terms", "integrators in one submodel only"
    ),
    "start of another structure": (
        "[{poles: 2, zeros: 0}, {", "[{poles: 2, zeros: 1}, {", 14, 10, "starts.parameters[0]",
        "{poles: 2, zeros: 1}, {poles: 2, zeros: 0} of estimator 'both'"
    ),
    "start of another order": ("poles: 4", "poles: 3", 14, 10, "starts.parameters[0]",
                               "4 poles and 2 zeros as one fraction"),
    "start with too many zeros": ("zeros: 2", "zeros: 1", 14, 10, "starts.parameters[0]", "of estimator 'one'"),
    "start of no kind": ("{relative_uniform: 0.05}", "0.05", 14, 22, "starts.parameters", "{relative_uniform: frac"),
    "starts of two kinds": ("{relative_uniform: 0.05}", "{relative_uniform: 0.05, additive: []}", 14, 10,
                            "starts.parameters", "{additive: [submodels]}"),
    "start that changes signs": ("0.05}}", "1.0}}", 14, 41, "starts.parameters.relative_uniform", "below 1"),
    "start without range": ("0.05}}", "0}}", 14, 41, "starts.parameters.relative_uniform", "above 0"),
    "start twice": ("{relative_uniform: 0.05}", "[{relative_uniform: 0.05}, {relative_uniform: 0.05}]", 14, 49,
                    "starts.parameters[1]", "twice"),
    "given start with a common pole": (
        "{relative_uniform: 0.05}", "{additive: [{numerator: [1], denominator: [1, 1]}, "
        "{numerator: [1], denominator: [1, 1]}]}", 14, 33, "starts.parameters.additive", "in common"
    ),
    "no starts": ("{parameters: {relative_uniform: 0.05}}", "{}", 14, 1, "starts", "give initial_delay, parameters"),
    "relative error of a zero": ("numerator: [3]", "numerator: [3, 0]", 16, 37, "success.parameter_relative_error",
                                 "g1_b0 is zero"),
    "geometric with two numbers": ("samples: 500", "samples: {geometric: [500, 900]}", 9, 64,
                                   "sampling.samples.geometric", "three whole numbers"),
    "geometric downwards": ("samples: 500", "samples: {geometric: [900, 500, 3]}", 9, 64,
                            "sampling.samples.geometric", "below the last"),
    "geometric too dense": ("samples: 500", "samples: {geometric: [500, 502, 9]}", 9, 64,
                            "sampling.samples.geometric", "no 9 different sizes"),
    "geometric without end": ("samples: 500", "samples: {geometric: [500, 900, 1000000000]}", 9, 75,
                              "sampling.samples.geometric[2]", "too many"),
    "geometric with a fraction": ("samples: 500", "samples: {geometric: [500.5, 900, 3]}", 9, 65,
                                  "sampling.samples.geometric[0]", "whole number"),
    "geometric misspelt": ("samples: 500", "samples: {geometric: [500, 900, 3], base: 2}", 9, 79,
                           "sampling.samples.base", "allowed: geometric"),
    "swept over a mapping": ("interval: 0.05", "interval: {geometric: [1, 2, 2]}", 9, 27, "sampling.interval",
                             "a number [s], not a mapping"),
}  # fmt: skip

#: Changes that go with some of them, so that there is one problem only.
TOGETHER = {
    "relative error of a zero": (
        ("[{poles: 2, zeros: 0}, {", "[{poles: 2, zeros: 1}, {"),
        ("poles: 4, zeros: 2", "poles: 4, zeros: 3"),
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_specifications(tmp_path, name):
    old, new, line, column, key, message = BROKEN[name]
    found = problems(tmp_path, changed(CLOSED, (old, new), *TOGETHER.get(name, ())))
    assert [(p.line, p.column, p.key) for p in found] == [(line, column, key)], [str(p) for p in found]
    assert message in found[0].message


def test_it_is_accepted(tmp_path):
    spec = load(tmp_path, CLOSED)
    assert spec.warnings == ()
    plan = build_plan(spec)
    (cell,) = plan.data_cells
    assert isinstance(cell.source.system, AdditiveModel)
    assert cell.source.excitation is None
    assert cell.source.loop.controller.denominator.tolist() == [1.0, -1.0, 0.0]
    assert cell.source.loop.enters == "controller"
    assert plan.estimators[0].estimator.terms == (Term(2, 0), Term(2, 0))
    assert plan.estimators[0].estimator.instruments == "closed_loop"
    assert [start.label for start in plan.starts] == ["parameters(5%)"]
    assert plan.terms == (Term(2, 0), Term(2, 0))


def test_canonical_form_comes_back(tmp_path):
    spec = load(tmp_path, CLOSED)
    canonical = spec.canonical()
    assert canonical["system"]["additive"][0] == {
        "numerator": [3.0], "denominator": [0.25, 0.25, 1.0], "integrators": 0,
    }  # fmt: skip
    assert canonical["loop"] == {
        "controller": {"pid": {"kp": 0.0115, "ki": 0.00725, "kd": 0.00454}},
        "reference": {"kind": "gaussian", "standard_deviation": 1.0, "clock_period": None},
        "enters": "controller",
    }
    assert canonical["starts"] == {"initial_delay": None, "parameters": [{"relative_uniform": 0.05}]}
    assert canonical["success"]["parameter_relative_error"] == 0.1
    again = spec_from_canonical(json.loads(canonical_json(canonical)))
    assert again.canonical() == canonical
    assert build_plan(again).data_cells[0].hash == build_plan(spec).data_cells[0].hash


@pytest.mark.parametrize(
    "override",
    [
        "system.additive=[{numerator: [3], denominator: [0.25, 0.25, 1]}]",
        "loop.controller.pid.kp=0.0116",
        "loop.enters=input",
        "loop.reference.standard_deviation=2",
        "noise.variance=0.02",
        "monte_carlo.seed=2",
    ],
)
def test_other_data_are_other_cells(tmp_path, override):
    more = ["estimators={one: {kind: srivc, poles: 2, zeros: 0}}"] if override.startswith("system") else []
    before, after = build_plan(load(tmp_path, CLOSED)), build_plan(load(tmp_path, CLOSED, override, *more))
    assert before.data_cells[0].hash != after.data_cells[0].hash


def test_what_can_be_swept(tmp_path):
    spec = load(
        tmp_path, CLOSED, "sampling.samples={geometric: [500, 2000, 3]}", "loop.controller.pid.kp=[0.01, 0.0115]",
        "loop.enters=[controller, input]", "loop.reference.standard_deviation=[1, 2]", "noise.variance=[0.01, 0.02]",
        "estimators.one.instruments=[open_loop, closed_loop]",
    )  # fmt: skip
    plan = build_plan(spec)
    assert spec.canonical()["sampling"]["samples"] == geometric_sizes(500, 2000, 3) == [500, 1000, 2000]
    assert len(plan.data_cells) == 3 * 2 * 2 * 2 * 2
    assert plan.data_cells[0].swept == {
        "kp": 0.01, "standard_deviation": 1.0, "enters": "controller", "samples": 500, "variance": 0.01,
    }  # fmt: skip
    last = plan.data_cells[-1].source
    assert last.loop.controller.numerator[0] == pytest.approx(0.0115 + 0.00725 + 0.00454)
    assert (last.loop.enters, last.loop.reference.standard_deviation, last.sampling.samples) == ("input", 2.0, 2000)
    assert [cell.swept for cell in plan.estimators[1:]] == [
        {"instruments": "open_loop"}, {"instruments": "closed_loop"}
    ]  # fmt: skip
    # The list is the sweep, however it was written.
    listed = build_plan(load(tmp_path, CLOSED, "sampling.samples=[500,1000,2000]"))
    spaced = build_plan(load(tmp_path, CLOSED, "sampling.samples={geometric: [500, 2000, 3]}"))
    assert [cell.hash for cell in listed.data_cells] == [cell.hash for cell in spaced.data_cells]
    assert listed.spec_hash == spaced.spec_hash


def test_an_unstable_combination_is_named(tmp_path):
    (problem,) = problems(tmp_path, CLOSED, "loop.controller.pid.kp=[0.0115, 0.575]")
    assert problem.key == "loop.controller"
    assert "lower the gain (with loop.controller.pid.kp = 0.575)" in problem.message
    (problem,) = problems(tmp_path, CLOSED, "loop.controller.pid.ki=0.03", "sampling.interval=[0.05, 0.5]")
    assert "at intervals of 0.05 s its largest pole has the magnitude 1.00533" in problem.message
    assert "(with sampling.interval = 0.05)" in problem.message
    (problem,) = problems(tmp_path, CLOSED, "sampling.interval=1e300")
    assert problem.key == "loop.controller"
    assert "its numbers overflow at intervals of 1e+300 s" in problem.message


def test_open_loop_with_integrators(tmp_path):
    text = changed(
        CLOSED,
        ("numerator: [3], denominator: [0.25, 0.25, 1]", "numerator: [3], denominator: [0.25, 1], integrators: 1"),
        (f"loop:\n  controller: {PID}\n  reference: {REFERENCE}\n", "excitation: {kind: gaussian}\n"),
        ("[{poles: 2, zeros: 0}, {poles: 2, zeros: 0}], instruments: closed_loop",
         "[{poles: 1, zeros: 0, integrators: 1}, {poles: 2, zeros: 0}]"),
        ("zeros: 2, instruments: closed_loop", "zeros: 2"),
    )  # fmt: skip
    plan = build_plan(load(tmp_path, text))
    assert plan.data_cells[0].source.system.terms == (Term(1, 0, 1), Term(2, 0))
    assert plan.terms == (Term(1, 0, 1), Term(2, 0))
    record = plan.data_cells[0].dataset(0).record
    assert record.loop is None
    assert record.n_samples == 500


def test_fractions_are_taken_apart_as_the_sorted_system_is(tmp_path):
    system = "system.additive=[{numerator: [1], denominator: [0.1, 1]}, {numerator: [3], denominator: [0.2, 0.3, 1]}]"
    rest = ["loop=null", "excitation={kind: gaussian}", "starts=null"]
    one = "estimators={one: {kind: srivc, poles: 3, zeros: 2}}"
    assert build_plan(load(tmp_path, CLOSED, system, one, *rest)).terms == (Term(2, 0), Term(1, 0))
    # Nobody asked for submodels.
    fraction = "system={numerator: [1], denominator: [1, 2, 3]}"
    two = "estimators={one: {kind: srivc, poles: 2, zeros: 0}}"
    assert build_plan(load(tmp_path, CLOSED, fraction, two, *rest, "success=null")).terms is None


def test_closed_loop_instruments_need_a_loop(tmp_path):
    text = changed(
        CLOSED, (f"loop:\n  controller: {PID}\n  reference: {REFERENCE}\n", "excitation: {kind: gaussian}\n")
    )
    found = problems(tmp_path, text)
    assert [(p.line, p.column, p.key) for p in found] == [
        (10, 98, "estimators.both.instruments"),
        (11, 55, "estimators.one.instruments"),
    ]
    assert all("instruments need the reference and the controller" in p.message for p in found)
    swept = problems(
        tmp_path, text, "estimators={one: {kind: srivc, poles: 4, zeros: 2, instruments: [open_loop, closed_loop]}}"
    )
    assert '(with instruments = "closed_loop")' in swept[0].message
    # A loop that is wrong by itself is no missing one.
    (problem,) = problems(tmp_path, changed(CLOSED, ("0.0115", "high")))
    assert problem.key == "loop.controller.pid.kp"


def test_a_loop_needs_the_rest_of_a_simulation(tmp_path):
    text = changed(CLOSED, ("sampling: {kind: regular, interval: 0.05, samples: 500}\n", ""))
    assert [p.key for p in problems(tmp_path, text)] == ["sampling"]
    text = changed(CLOSED, ("monte_carlo: {runs: 2, seed: 1}\n", ""))
    assert [p.key for p in problems(tmp_path, text)] == ["monte_carlo"]


def test_too_few_samples_for_the_terms(tmp_path):
    found = problems(tmp_path, CLOSED, "sampling.samples=6")
    assert [p.key for p in found] == ["estimators.both", "estimators.one"]
    assert "6 samples are too few for 6 parameters" in found[0].message
    assert "6 samples are too few for 7 parameters" in found[1].message
    assert load(tmp_path, CLOSED, "sampling.samples=8")


def test_slow_sampling_of_submodels_is_a_warning(tmp_path):
    # The fastest poles are at 6.325 rad/s; with a slow controller, so that the loop stays stable.
    slow = [*(f"loop.controller.pid.k{part}=1e-6" for part in "pid"), "sampling.interval=0.5"]
    (warning,) = load(tmp_path, CLOSED, *slow).warnings
    assert "sampling.interval" in warning
    assert "fastest pole (6.325 rad/s" in warning


def test_starts_and_estimators_of_both_kinds(tmp_path):
    overrides = [
        "starts.initial_delay=[0.1, {uniform: [0, 0.2]}]",
        "estimators.search={kind: td_srivc, poles: 4, zeros: 2, delay_bounds: [0, 0.5]}",
        "estimators.filter={kind: svf, poles: 4, zeros: 2}",
        "starts.parameters=[{relative_uniform: 0.05}, {relative_uniform: 0.2}]",
    ]
    plan = build_plan(load(tmp_path, CLOSED, *overrides))
    labels = {}
    for _, cell, start in plan.keys(plan.tasks()[0]):
        labels.setdefault(cell.name, []).append(start.label)
    assert labels == {
        "both": ["parameters(5%)", "parameters(20%)"],
        "one": ["parameters(5%)", "parameters(20%)"],
        "search": ["0.1", "uniform(0, 0.2)"],
        "filter": ["none"],
    }
    # An estimator that takes parameters makes its own where none are named, and needs no delay.
    plan = build_plan(load(tmp_path, CLOSED, "starts={initial_delay: 0.1}", *overrides[1:2]))
    assert [(cell.name, start.label) for _, cell, start in plan.keys(plan.tasks()[0])] == [
        ("both", "none"), ("one", "none"), ("search", "0.1"),
    ]  # fmt: skip


def test_an_estimator_that_ignores_the_loop_is_a_warning(tmp_path):
    """Also in the loop of a measured record; what knows the loop is not warned of."""
    (warning,) = load(tmp_path, CLOSED, "estimators.one.instruments=open_loop").warnings
    assert "estimators.one: ignores the loop" in warning
    (tmp_path / "record.csv").write_text(RECORD, encoding="utf-8")
    assert load(tmp_path, MEASURED).warnings == ()
    (warning,) = load(tmp_path, MEASURED, "estimators.one={kind: svf, poles: 2, zeros: 0}").warnings
    assert "estimators.one: ignores the loop" in warning


def test_starts_that_nobody_takes_are_a_warning(tmp_path):
    (warning,) = load(tmp_path, CLOSED, "starts.initial_delay=1").warnings
    assert "starts.initial_delay: no estimator here uses a start of this kind" in warning
    only = "estimators={one: {kind: svf, poles: 4, zeros: 2}}"
    loop, warning = load(tmp_path, CLOSED, only).warnings
    assert "estimators.one: ignores the loop" in loop
    assert "starts.parameters: no estimator here uses a start of this kind" in warning


def test_given_parameters(tmp_path):
    given = (
        "{additive: [{numerator: [3.1], denominator: [0.26, 0.25, 1]}, {numerator: [1], denominator: [0.02, 0.01, 1]}]}"
    )
    plan = build_plan(load(tmp_path, CLOSED, f"starts.parameters={given}"))
    (start,) = plan.starts
    assert start.label.startswith("given ")
    model = start.draw(None, 0).model
    assert model.theta.tolist() == [0.25, 0.26, 3.1, 0.01, 0.02, 1.0]
    # Other values are another start: the label is part of the identity of an estimate.
    other = build_plan(load(tmp_path, CLOSED, f"starts.parameters={given.replace('3.1', '3.2')}"))
    assert other.starts[0].label != start.label


def test_parameters_near_those_of_one_fraction(tmp_path):
    # Poles at -1 and -0.5 +- 1.94j: the partial fractions are of the first order, and of the second with a zero.
    fraction = "system={numerator: [3, 1], denominator: [1, 2, 5, 4]}"
    rest = ["loop=null", "excitation={kind: gaussian}", "success=null"]
    estimators = "estimators={both: {kind: additive_srivc, terms: [{poles: 1, zeros: 0}, {poles: 2, zeros: 1}]}}"
    plan = build_plan(load(tmp_path, CLOSED, fraction, estimators, *rest))
    data = plan.data_cells[0].dataset(0)
    model = plan.starts[0].draw(1, 0, data.true_model).model
    assert model.terms == (Term(1, 0), Term(2, 1))
    assert plan.terms == (Term(1, 0), Term(2, 1)), "those of the estimator, since the system has none"
    (problem,) = problems(
        tmp_path, CLOSED, "system={numerator: [1], denominator: [1, 2, 1]}", "loop=null", "excitation={kind: gaussian}",
        "success=null", "estimators={one: {kind: srivc, poles: 2, zeros: 0}}",
    )  # fmt: skip
    assert problem.key == "starts.parameters[0]"
    assert "cannot be written as a sum of submodels: the pole at -1" in problem.message


def test_success_of_the_parameters_of_a_transfer_function(tmp_path):
    rest = ("starts=null", "estimators={one: {kind: srivc, poles: 2, zeros: 0}}")
    spec = load(tmp_path, CLOSED, "system={numerator: [1], denominator: [1, 2, 3]}", *rest)
    assert spec.canonical()["success"]["parameter_relative_error"] == 0.1
    (problem,) = problems(tmp_path, CLOSED, "system={numerator: [1, 0], denominator: [1, 2, 3]}", *rest)
    assert problem.key == "success.parameter_relative_error"
    assert "b1 is zero" in problem.message


def test_coloured_noise(tmp_path):
    noise = "noise={kind: arma, numerator: [1, 0.5], denominator: [1, -0.85], innovation_variance: 0.02}"
    plan = build_plan(load(tmp_path, CLOSED, noise))
    assert plan.data_cells[0].source.noise == ArmaNoise((1.0, 0.5), (1.0, -0.85), innovation_variance=0.02)


# -- measured records -------------------------------------------------------------------------------------------------


@pytest.fixture
def record_file(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    return tmp_path / "record.csv"


def test_a_measured_record_in_a_loop(tmp_path, record_file):
    plan = build_plan(load(tmp_path, MEASURED, "data.estimation_samples=30", "data.offset=remove"))
    (cell,) = plan.data_cells
    assert cell.content["loop"]["controller"] == {"numerator": [0.5, -0.4], "denominator": [1.0, -1.0]}
    data = cell.dataset(0)
    loop = data.record.loop
    reference = [(k // 3) % 2 for k in range(30)]
    assert loop.reference.tolist() == pytest.approx([r - sum(reference) / 30 for r in reference])
    assert loop.controller.numerator.tolist() == [0.5, -0.4]
    assert data.validation.loop is None
    assert build_plan(load(tmp_path, MEASURED, "loop.enters=input")).data_cells[0].hash != cell.hash
    swept = build_plan(load(tmp_path, MEASURED, "loop.enters=[controller, input]"))
    assert [cell.source.loop.enters for cell in swept.data_cells] == ["controller", "input"]


@pytest.mark.parametrize(
    ("changes", "line", "column", "key", "message"),
    [
        ([(", reference: r", "")], 2, 1, "data.reference", "name its column"),
        ([("loop: {controller: {numerator: [0.5, -0.4], denominator: [1, -1]}}\n", "")], 2, 26, "data.reference",
         "needs the controller too"),
        ([("[1, -1]}}", "[1, -1]}, reference: {kind: gaussian}}")], 3, 68, "loop.reference", "data.reference"),
        ([("reference: r", "reference: s")], 2, 14, "data.file", "there is no column 's'"),
        ([("reference: r", "reference: r, hold: foh")], 2, 46, "data.hold", "must be zoh in a loop"),
        ([("reference: r", "reference: 3")], 2, 37, "data.reference", "write it in quotes"),
        (
            [(", reference: r", ""), ("loop: {controller: {numerator: [0.5, -0.4], denominator: [1, -1]}}\n", "")],
            4, 75, "estimators.one.instruments", "data.reference and loop.controller",
        ),
        ([("[1, -1]", "[0, -1]")], 3, 58, "loop.controller.denominator", "leading zeros"),
    ],
)  # fmt: skip
def test_broken_measured_loops(tmp_path, record_file, changes, line, column, key, message):
    (problem,) = problems(tmp_path, changed(MEASURED, *changes))
    assert (problem.line, problem.column, problem.key) == (line, column, key), str(problem)
    assert message in problem.message


def test_a_measured_loop_needs_a_regular_clock(tmp_path, record_file):
    record_file.write_text(RECORD.replace("0.7,", "0.75,", 1))
    (problem,) = problems(tmp_path, MEASURED)
    assert (problem.line, problem.key) == (2, "data.file")
    assert "a closed loop needs a regular clock: its controller is discrete" in problem.message


def test_measured_parameters_are_not_known(tmp_path, record_file):
    found = problems(
        tmp_path, MEASURED + "starts: {parameters: {relative_uniform: 0.1}}\nsuccess: {parameter_relative_error: 0.1}\n"
    )
    assert [p.key for p in found] == ["starts.parameters[0]", "success.parameter_relative_error"]
    assert all("of a measured record are not known" in p.message for p in found)
