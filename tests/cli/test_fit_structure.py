"""``ctid fit`` with submodels, integrators, known parameters and loops."""

import json

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, load_fit
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate_additive
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import DiscreteController
from tests.cli.records import write

STEP = 0.05
MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
RIGID = AdditiveModel([Submodel([0.5], [1.0], 1), Submodel([2.0], [0.3, 0.2, 1.0])])
PLANT = TransferFunction([2.0], [1.0, 1.5])
CONTROLLER = DiscreteController([0.8, -0.7], [1.0, -1.0])
LOOP = "loop:\n  controller: {numerator: [0.8, -0.7], denominator: [1.0, -1.0]}\n"


def record(file, system, n=800, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(n)
    u = rng.standard_normal(n)
    y = simulate_additive(system, HeldSignal(t, u), t) + noise * rng.standard_normal(n)
    return write(file, (t, u, y))


@pytest.fixture
def closed(tmp_path):
    (tmp_path / "loop.yaml").write_text(LOOP, encoding="utf-8")
    rng = np.random.default_rng(4)
    t = STEP * np.arange(1500)
    r = np.repeat(rng.choice([-1.0, 1.0], 150), 10)
    noise = np.zeros(1500)
    for k in range(1, 1500):
        noise[k] = 0.95 * noise[k - 1] + 0.05 * rng.standard_normal()
    found = simulate_loop(PLANT, CONTROLLER, r, noise, STEP)
    spoilt = found.u + 0.1 * rng.standard_normal(1500)
    return write(tmp_path / "closed.csv", (t, found.u, found.x + noise, r, spoilt), "t,u [V],y [rpm],r [rpm],v [V]")


def fitted(ctid, *arguments):
    return json.loads(ctid("fit", *arguments, "--json").stdout)


def near(content, expected, errors=5.0):
    """Whether parameters are within so many standard errors of what they should be."""
    found = {item["name"]: item for item in content["parameters"]}
    for name, value in expected.items():
        assert found[name]["estimate"] == pytest.approx(value, abs=errors * found[name]["standard_error"])
        assert found[name]["standard_error"] < 0.2 * abs(value) + 0.01


def test_a_sum_of_submodels_is_printed_written_and_read_back(ctid, tmp_path):
    file, other = record(tmp_path / "one.csv", MODES), record(tmp_path / "other.csv", MODES, seed=1)
    arguments = (file, "--model", "additive", "--terms", "2/0,2/0", "--validate", other, "--out", tmp_path)
    content = fitted(ctid, *arguments)
    near(content, {"g1_b0": 3.0, "g1_a1": 0.25, "g1_a2": 0.25, "g2_b0": 1.0, "g2_a2": 0.025})
    assert [len(part["denominator"]) for part in content["model"]["submodels"]] == [3, 3]
    assert content["validation"]["r2"] > 0.99
    assert content["warnings"] == []
    text = ctid("fit", *arguments).stdout
    assert "sum of 2 submodels with poles/zeros 2/0, 2/0; delay known, 0 s" in text
    assert (tmp_path / "fit.svg").read_bytes().startswith(b"<?xml")
    again = load_fit(tmp_path / "fit.json")
    assert again.fit.additive.parameters == {
        item["name"]: item["estimate"] for item in content["parameters"] if item["name"] != "delay"
    }
    assert np.mean(again.fit.residuals[0] ** 2) == pytest.approx(content["cost"], rel=1e-12)
    assert again.validation.applied.residuals[0].size == 800


@pytest.mark.parametrize("state", ["estimate", "periodic"])
def test_the_state_before_the_record(ctid, tmp_path, state):
    file = record(tmp_path / "one.csv", MODES)
    content = fitted(ctid, file, "--model", "additive", "--terms", "2,2", "--initial-state", state, "--out", tmp_path)
    states = [item["name"] for item in content["parameters"] if item["name"].startswith("x")]
    assert states == (["x1", "x2", "x3", "x4"] if state == "estimate" else [])


def test_integrators_belong_to_the_first_submodel(ctid, tmp_path):
    file = record(tmp_path / "rigid.csv", RIGID)
    options = ("--model", "additive", "--terms", "0/0,2/0", "--integrators", 1, "--out", tmp_path)
    content = fitted(ctid, file, *options)
    near(content, {"g1_b0": 0.5, "g2_b0": 2.0, "g2_a1": 0.2, "g2_a2": 0.3})
    assert content["parameters"][0]["unit"] == "out/in/s"
    assert content["warnings"] == []
    # An integrator beside poles needs no other options.
    file = record(tmp_path / "one.csv", AdditiveModel([Submodel([1.0], [0.5, 1.0], 1)]))
    content = fitted(ctid, file, "--poles", 1, "--integrators", 1, "--out", tmp_path)
    near(content, {"a1": 2.0, "b0": 2.0})
    assert content["modes"][-1]["damping"] is None


def test_a_pole_next_to_the_origin_is_named_with_the_remedy_that_was_tried(ctid, tmp_path):
    file = record(tmp_path / "drive.csv", AdditiveModel([Submodel([1.0], [0.5, 1.0], 1)]))
    warnings = fitted(ctid, file, "--poles", 2, "--delay", "0:0.2", "--out", tmp_path)["warnings"]
    words = "indistinguishable from an integrator: with --poles 1 --zeros 0 --integrators 1 the held-back fit is"
    assert words in warnings[0]
    one = fitted(ctid, file, "--poles", 1, "--out", tmp_path)["warnings"][0]
    assert "with --integrators 1 the held-back fit is" in one


def test_fixed_parameters_have_their_values_and_no_errors(ctid, tmp_path):
    file = record(tmp_path / "one.csv", MODES)
    options = ("--model", "additive", "--terms", "2/0,2/0", "--fix", "g1_a2=0.25", "--fix", "g2_b0=1")
    content = fitted(ctid, file, *options, "--out", tmp_path)
    found = {item["name"]: item for item in content["parameters"]}
    for name, value in (("g1_a2", 0.25), ("g2_b0", 1.0)):
        assert (found[name]["estimate"], found[name]["status"]) == (value, "fixed")
        assert found[name]["standard_error"] is None
    assert content["criteria"]["parameters"] == 4
    plain = fitted(ctid, file, "--poles", 4, "--zeros", 2, "--fix", "a4=160", "--out", tmp_path)
    assert plain["model"]["denominator"][-1] == 160.0


def test_a_loop_removes_the_bias_that_coloured_noise_makes(ctid, closed, tmp_path):
    options = (closed, "--input", "u", "--poles", 1, "--out", tmp_path)
    content = fitted(ctid, *options, "--loop", tmp_path / "loop.yaml", "--reference", "r")
    near(content, {"a1": 1.5, "b0": 2.0}, errors=3.0)
    stored = load_fit(tmp_path / "fit.json")
    assert stored.records[0].loop.controller.numerator.tolist() == [0.8, -0.7]
    assert np.mean(stored.fit.residuals[0] ** 2) == pytest.approx(content["cost"], rel=1e-12)
    assert not any("follows the output" in warning for warning in content["warnings"])
    ignored = fitted(ctid, *options, "--loop", tmp_path / "loop.yaml", "--direct")
    assert any("direct method" in note for note in ignored["notes"])
    direct = fitted(ctid, *options)
    estimates, plain = ({one["name"]: one["estimate"] for one in each["parameters"]} for each in (ignored, direct))
    assert estimates == plain
    # What is known to be biased has no standard error; without the loop nobody knows.
    assert all(one["standard_error"] is None for one in ignored["parameters"])
    assert "estimate is biased" in ignored["covariance"]["reason"]


KNOWN_LOOP = ("--loop", "loop.yaml", "--reference", "r")


def test_a_loop_whose_controller_is_not_known(ctid, closed, tmp_path):
    options = (closed, "--input", "u", "--poles", 1, "--out", tmp_path)
    content = fitted(ctid, *options, "--reference", "r")
    near(content, {"a1": 1.5, "b0": 2.0}, errors=3.0)
    assert fitted(ctid, *options, "--loop", "unknown", "--reference", "r")["parameters"] == content["parameters"]
    assert load_fit(tmp_path / "fit.json").records[0].loop.controller is None
    direct = fitted(ctid, *options, "--loop", "unknown")
    assert any("direct method" in note for note in direct["notes"])
    assert all(one["standard_error"] is None for one in direct["parameters"])


ADDITIVE = ("--model", "additive", "--terms", "2/0")
REFUSED = {
    "terms alone": (("--terms", "2/0"), "add --model additive"),
    "no terms": (("--model", "additive"), "--model additive needs --terms"),
    "degrees twice": ((*ADDITIVE, "--poles", 2), "drop --poles"),
    "bad terms": (("--model", "additive", "--terms", "2-0"), "for example 2/0,2/1"),
    "too many zeros": (("--model", "additive", "--terms", "1/2"), "more zeros than poles"),
    "a searched delay in a loop": ((*ADDITIVE, *KNOWN_LOOP, "--delay", "0:2"), "give one value, --delay VALUE"),
    "a robust loss in a loop": ((*ADDITIVE, *KNOWN_LOOP, "--loss", "huber"), "drop --loss"),
    "an estimated offset in a loop": ((*ADDITIVE, *KNOWN_LOOP, "--offset", "estimate"), "use --offset remove"),
    "no pole": (("--model", "additive", "--terms", "0/0"), "terms must have a pole to search"),
    "feedthrough beside a searched delay": (
        ("--model", "additive", "--terms", "1/1,2/0", "--delay", "0:2"),
        "while the delay is estimated",
    ),
    "a negative coefficient": ((*ADDITIVE, "--fix", "g1_a1=-1"), "must be above zero"),
    "negative integrators": (("--poles", 1, "--integrators", -1), "--integrators must be 0 to 3"),
    "a fixed delay": (("--poles", 1, "--fix", "delay=1"), "--delay VALUE"),
    "a fixed word": (("--poles", 1, "--fix", "a1"), "NAME=VALUE"),
    "an unknown name": (("--poles", 1, "--fix", "a2=1"), "there are a1 and b0"),
    "a mean of an integrating output": (
        ("--poles", 1, "--integrators", 1, "--offset", "remove"),
        "use --offset estimate",
    ),
    "nothing left": (("--poles", 1, "--fix", "a1=1", "--fix", "b0=1"), "nothing to estimate"),
    "the other half": (("--poles", 1, "--loop", "loop.yaml"), "add --reference COLUMN"),
    "no loop": (("--poles", 1, "--direct"), "add --loop FILE or --loop unknown"),
    "a delay to search without the controller": (
        ("--poles", 1, "--reference", "r", "--delay", "0:1"),
        "give one value",
    ),
    "a known coefficient in a loop": (("--poles", 1, *KNOWN_LOOP, "--fix", "a1=1"), "--model additive"),
    "a loop that repeats": (("--poles", 1, *KNOWN_LOOP, "--initial-state", "periodic"), "use rest or estimate"),
    "a drift in a loop": (("--poles", 1, *KNOWN_LOOP, "--offset", "drift"), "use estimate, remove or none"),
    "a loss in a loop": (("--poles", 1, *KNOWN_LOOP, "--loss", "huber"), "drop --loss"),
    "as many zeros as poles": (
        ("--poles", 1, "--zeros", 1, *KNOWN_LOOP, "--delay", "0:1"),
        "while the delay is estimated",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_options_that_do_not_go_together_are_one_sentence(ctid, tmp_path, case):
    options, said = REFUSED[case]
    file = record(tmp_path / "one.csv", MODES, n=100)
    done = ctid("fit", file, *options, "--out", tmp_path / "out", code=2)
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


LOOPS = {
    "an input of another origin": ("v", "r", LOOP, "the input is not what the controller makes"),
    "a reference that is the output": ("u", "y", LOOP, "cannot be both the output and the reference"),
    "a column that is not there": ("u", "q", LOOP, "there is no column 'q'"),
    "a reference in another unit": ("u", "v", LOOP, "is in V, and the output"),
    "a relay": ("u", "r", "loop: {controller: {relay: {amplitude: 1.0}}}\n", "no relay"),
    "no loop in the file": ("u", "r", "experiment: x\n", "there is no section loop"),
    "another sign": ("u", "r", LOOP.replace("0.8", "-0.8"), "the input is not what the controller makes"),
    "a key that is not there": ("u", "r", "loop:\n  control: {}\n", "controller"),
}


@pytest.mark.parametrize("case", LOOPS)
def test_a_loop_that_does_not_fit_the_record_is_refused(ctid, closed, tmp_path, case):
    column, reference, text, said = LOOPS[case]
    (tmp_path / "loop.yaml").write_text(text, encoding="utf-8")
    options = ("--input", column, "--output", "y", "--poles", 1, "--loop", tmp_path / "loop.yaml")
    done = ctid("fit", closed, *options, "--reference", reference, "--out", tmp_path / "out", code=2)
    assert said in done.stderr
    assert not (tmp_path / "out").exists()
