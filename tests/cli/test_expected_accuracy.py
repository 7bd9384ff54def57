"""``ctid accuracy``: the numbers of theory, the formula that they come from, and where there are none."""

import json
import re

import numpy as np
import pytest

from ctid_cli.inference.bounds import cramer_rao_bound, limiting_accuracy
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.specification.load import load_spec

# The simulation examples of Gonzalez, Classens, Rojas, Welsh and Oomen, sections 6.1 and 6.2.
OPEN = """\
experiment: open
system:
  additive:
    - {numerator: [0.2], denominator: [0.0300105, 0.01020353, 1]}
    - {numerator: [3], denominator: [0.50135365, 0.25067683, 1]}
    - {numerator: [0.4], denominator: [0.09991907, 0.02997572, 1]}
    - {numerator: [0.05], denominator: [0.00999499, 0.00999499, 1]}
excitation:  {kind: gaussian}
sampling:    {kind: regular, interval: 0.05, samples: [2000, 7368, 100000]}
noise:       {kind: arma, numerator: [1, 0.5], denominator: [1, -0.85], innovation_variance: 0.02}
estimators:
  sum:       {kind: additive_srivc, terms: [TERM, TERM, TERM, TERM]}
  srivc:     {kind: srivc, poles: 8, zeros: 6}
monte_carlo: {runs: 2, seed: 1}
""".replace("TERM", "{poles: 2, zeros: 0}")
CLOSED = """\
experiment: closed
system:
  additive:
    - {numerator: [3], denominator: [0.25, 0.25, 1]}
    - {numerator: [1], denominator: [0.025, 0.01, 1]}
loop:        {controller: {pid: {kp: 0.0115, ki: 0.00725, kd: 0.00454}}, reference: {kind: gaussian}}
sampling:    {kind: regular, interval: 0.05, samples: [500, 19650]}
noise:       {kind: white, variance: 0.01}
estimators:
  sum:       {kind: additive_srivc, instruments: closed_loop, terms: [TERM, TERM]}
  direct:    {kind: srivc, poles: 4, zeros: 2}
  clsrivc:   {kind: srivc, poles: 4, zeros: 2, instruments: closed_loop}
monte_carlo: {runs: 2, seed: 1}
""".replace("TERM", "{poles: 2, zeros: 0}")
# One mode, small enough for all that is tried below.
ONE = """\
experiment: one
system:      {numerator: [2], denominator: [0.25, 0.7, 1], delay: 0.35}
excitation:  {kind: gaussian}
sampling:    {kind: regular, interval: 0.1, samples: 6000}
noise:       {kind: white, snr_db: 10}
estimators:
  known:     {kind: srivc, poles: 2, zeros: 0, delay: 0.35}
monte_carlo: {runs: 2, seed: 1}
"""

#: Warnings about what these experiments do on purpose.
EXPECTED = re.compile("direct: ignores the loop|: is taken as |can only come near|do not hold the delay")


@pytest.fixture
def accuracy(ctid, tmp_path):
    """The JSON, or the text, of a check: ``accuracy(OPEN, "--set", "noise.snr_db=5")``."""

    def call(content, *arguments, text=False):
        file = tmp_path / "spec.yaml"
        file.write_text(content, encoding="utf-8")
        done = ctid("accuracy", file, *arguments, *([] if text else ["--json"]))
        assert all(EXPECTED.search(line) for line in done.stderr.splitlines())
        return done.stdout if text else json.loads(done.stdout)

    return call


def entries(content, estimator):
    return [entry for entry in content["estimates"] if entry["estimator"] == estimator]


def variances(entry, letter):
    """N times the variances of the parameters whose name ends so."""
    return [entry["samples"] * p["standard_error"] ** 2 for p in entry["parameters"] if p["name"].endswith(letter)]


def test_open_loop_with_coloured_noise(accuracy):
    content = accuracy(OPEN)
    assert content["experiment"] == "open"
    assert content["left_out"] == 0
    short, *long = entries(content, "sum")
    # submodels by rising natural frequency, although the specification begins with the third
    for entry in long:
        np.testing.assert_allclose(variances(entry, "b0"), [35.60, 2.700, 0.4405, 0.2240], rtol=3e-4)
        assert entry["scales"]
        assert entry["formula"].startswith("the limit for long records, M^-1 Sigma M^-1 / N")
        assert "as the input is white Gaussian noise" in entry["formula"]
    assert [entry["samples"] for entry in (short, *long)] == [2000, 7368, 100000]
    assert not short["scales"]
    assert short["formula"].endswith("averaged over the first 10 data sets, as there are fewer than 5000 samples")
    ratios = np.array(variances(short, "b0")) / variances(long[0], "b0")
    assert (np.abs(ratios - 1) < 0.4).all()
    assert np.abs(ratios - 1).max() > 1e-3
    unconstrained = entries(content, "srivc")[-1]
    np.testing.assert_allclose(variances(unconstrained, "b0"), [36.75, 3.645, 0.5341, 0.2322], rtol=3e-4)
    first = unconstrained["parameters"][0]
    assert first["name"] == "g1_a1"
    assert first["value"] == pytest.approx(0.25067683)
    assert first["relative_percent"] == pytest.approx(100 * first["standard_error"] / 0.25067683)
    assert first["half_width_95"] == pytest.approx(1.96 * first["standard_error"], rel=1e-4)
    # what is zero in truth has no relative error
    (spare,) = [p for p in unconstrained["parameters"] if p["name"] == "g1_b1"]
    assert spare["value"] == 0.0
    assert spare["relative_percent"] is None


def test_closed_loop(accuracy):
    content = accuracy(CLOSED)
    short, long = entries(content, "sum")
    np.testing.assert_allclose(variances(long, "a2"), [0.035010, 1.52180e-5], rtol=1e-4)
    assert "psi the sensitivities of the output to the parameters in the noise-free loop" in long["formula"]
    assert "as the reference is white Gaussian noise" in long["formula"]
    # the records begin at rest, and the memory of the loop is not short against 500 samples
    assert (np.array(variances(short, "a2")) > 1.2 * np.array(variances(long, "a2"))).all()
    assert not short["formula"].startswith("the Cram")
    direct, cl = entries(content, "direct"), entries(content, "clsrivc")
    np.testing.assert_allclose(variances(cl[1], "a2"), [0.090118, 2.49911e-5], rtol=1e-4)
    np.testing.assert_allclose(1.01 * np.array(variances(direct[1], "b0")), variances(cl[1], "b0"), rtol=1e-6)
    assert "in the loop, noise included" in direct[0]["formula"]
    assert direct[0]["formula"].startswith("the Cramér-Rao bound")
    assert np.array(variances(direct[0], "b0")) != pytest.approx(variances(cl[0], "b0"), rel=1e-4)


def test_where_the_reference_enters(accuracy):
    # Before the controller, whose gain is a few hundredths, it says far less.
    spec = CLOSED.replace("reference: {kind: gaussian}", "reference: {kind: gaussian}, enters: input")
    plant = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
    expected = limiting_accuracy(
        plant,
        0.05,
        DiscreteController.from_pid(0.0115, 0.00725, 0.00454),
        standard_deviation=1.0,
        innovation_variance=0.01,
        samples=19650,
        enters="input",
    )
    found = entries(accuracy(spec), "sum")
    np.testing.assert_allclose([p["standard_error"] for p in found[1]["parameters"]], expected.standard_errors)
    before = entries(accuracy(CLOSED), "sum")
    for one, other in zip(found, before, strict=True):
        assert 5 * one["parameters"][2]["standard_error"] < other["parameters"][2]["standard_error"]


def test_text(accuracy, snapshot):
    assert accuracy(CLOSED, text=True) == snapshot


def test_estimators_that_can_do_the_same_share_a_table(accuracy):
    two = ONE.replace("estimators:\n", "estimators:\n  svf:  {kind: svf, poles: 2, zeros: 0}\n").replace(
        "monte_carlo", "  again: {kind: srivc, poles: 2, zeros: 0, delay: 0.35, max_iterations: 7}\nmonte_carlo"
    )
    text = accuracy(two, "--set", "noise.snr_db=[5, 10]", text=True)
    assert "known (srivc) and again (srivc): standard errors at SNR 5 dB\n" in text
    assert text.count("half width\n") == 2
    assert "\nsvf: no theory: the estimate is biased, as svf is least squares, the start of other estimators" in text


def test_a_level_relative_to_the_output_is_that_of_long_records(accuracy):
    limit = accuracy(ONE)["estimates"][0]
    assert limit["scales"]
    found = accuracy(ONE.replace("kind: gaussian", "kind: gaussian, clock_period: 0.1"))["estimates"][0]
    assert found == limit
    # the same from data sets, whose input is another kind of white noise
    prbs = accuracy(ONE.replace("kind: gaussian", "kind: prbs, stages: 12, clock_period: 0.1"))["estimates"][0]
    assert not prbs["scales"]
    assert prbs["formula"].endswith("as the input is not white Gaussian noise held from sample to sample")
    errors = [[p["standard_error"] for p in entry["parameters"]] for entry in (limit, prbs)]
    np.testing.assert_allclose(errors[0], errors[1], rtol=0.05)


def test_an_estimated_delay(accuracy, tmp_path):
    spec = ONE.replace("kind: srivc, poles: 2, zeros: 0, delay: 0.35", "kind: KIND").replace("6000", "3000")
    search = "td_srivc, poles: 2, zeros: 0, delay_bounds: [0, 2]"
    found = accuracy(spec.replace("KIND", search))["estimates"][0]
    assert [p["name"] for p in found["parameters"]] == ["a1", "a2", "b0", "delay"]
    assert found["formula"].startswith("the Cramér-Rao bound sigma^2 (psi' psi)^-1")
    assert found["formula"].endswith("averaged over the first 6 data sets, as the delay is estimated too")
    plan = build_plan(load_spec(tmp_path / "spec.yaml"))
    bounds = []
    for replicate in range(6):
        record = plan.data_cells[0].dataset(replicate).record
        level = np.sqrt(np.mean(record.noise_free**2) / 10)
        bounds.append(cramer_rao_bound(TransferFunction([2.0], [0.25, 0.7, 1.0], 0.35), record, level, 2.0))
    expected = np.sqrt(np.diag(np.mean(bounds, axis=0)))
    np.testing.assert_allclose([p["standard_error"] for p in found["parameters"]], expected, rtol=1e-6)
    other = accuracy(spec.replace("KIND", "delay_profile, poles: 2, zeros: 0, delay_bounds: [0, 2]"))["estimates"][0]
    assert other["parameters"] == found["parameters"]
    known = accuracy(spec.replace("KIND", "delay_profile, poles: 2, zeros: 0, delay_bounds: [0.35, 0.35]"))
    assert [p["name"] for p in known["estimates"][0]["parameters"]] == ["a1", "a2", "b0"]


def test_irregular_clock_and_coloured_noise(accuracy, tmp_path):
    irregular = ONE.replace(
        "{kind: regular, interval: 0.1, samples: 6000}",
        "{kind: uniform_intervals, low: 0.05, high: 0.15, samples: 4000}",
    ).replace("white, snr_db: 10", "arma, numerator: [1], denominator: [1, -0.9], variance: 0.1")
    found = accuracy(irregular)["estimates"][0]
    assert found["formula"].startswith("(psi' psi)^-1 psi' R psi (psi' psi)^-1, R the covariance matrix of the noise")
    assert found["formula"].endswith("as the clock is irregular")
    white = accuracy(irregular.replace("denominator: [1, -0.9]", "denominator: [1]"))["estimates"][0]
    ratio = [
        p["standard_error"] / q["standard_error"] for p, q in zip(found["parameters"], white["parameters"], strict=True)
    ]
    # noise of one sign for ten samples hurts the gain most
    assert min(ratio) > 1.2
    assert ratio[2] > 2
    assert ArmaNoise((1.0,), (1.0, -0.9), variance=0.1).variance_of() == pytest.approx(0.1)


def test_integrators(accuracy):
    body = OPEN.replace(
        "{numerator: [3], denominator: [0.50135365, 0.25067683, 1]}",
        "{numerator: [3], denominator: [2, 1], integrators: 1}",
    )
    body = body.replace("terms: [{poles: 2, zeros: 0}", "terms: [{poles: 1, zeros: 0, integrators: 1}")
    content = accuracy(body, "--set", "sampling.samples=6000")
    found = entries(content, "sum")[0]
    assert found["formula"].endswith("as the system integrates, and what it knows grows with the record")
    assert [p["name"] for p in found["parameters"]][:3] == ["g1_a1", "g1_b0", "g2_a1"]
    # one fraction has the integrator's pole among its coefficients, and stays one fraction
    assert entries(content, "srivc")[0]["parameters"][0]["name"] == "a1"
    # a loop keeps it in place
    loop = CLOSED.replace(
        "{numerator: [3], denominator: [0.25, 0.25, 1]}", "{numerator: [0.3], denominator: [0.3, 1], integrators: 1}"
    )
    loop = loop.replace("terms: [{poles: 2, zeros: 0}", "terms: [{poles: 1, zeros: 0, integrators: 1}")
    loop = loop.replace("{kp: 0.0115, ki: 0.00725, kd: 0.00454}", "{kp: 0.5, kd: 0.5}")
    content = accuracy(loop)
    assert entries(content, "sum")[1]["scales"]
    assert not entries(content, "clsrivc")[1]["scales"]


def test_a_fraction_and_its_submodels(accuracy):
    text = ONE.replace("numerator: [2], denominator: [0.25, 0.7, 1]", "numerator: [3, 5], denominator: [1, 3, 2]")
    text = text.replace(
        "monte_carlo",
        "  sum: {kind: additive_srivc, terms: [{poles: 1, zeros: 0}, {poles: 1, zeros: 0}], delay: 0.35}\nmonte_carlo",
    )
    content = accuracy(text.replace("zeros: 0, delay: 0.35}\n  sum", "zeros: 1, delay: 0.35}\n  sum"))
    one, two = content["estimates"]
    # as many parameters in both forms: nothing is won by the sum
    assert [p["name"] for p in one["parameters"]] == ["g1_a1", "g1_b0", "g2_a1", "g2_b0"]
    for p, q in zip(one["parameters"], two["parameters"], strict=True):
        assert p["name"] == q["name"]
        assert p["standard_error"] == pytest.approx(q["standard_error"])
    np.testing.assert_allclose([p["value"] for p in two["parameters"]], [1, 2, 0.5, 0.5])


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("poles: 2, zeros: 0, delay: 0.35", "poles: 1, zeros: 0, delay: 0.35", "it cannot hold the system"),
        ("poles: 2, zeros: 0, delay: 0.35", "poles: 3, zeros: 0, delay: 0.35", "no data determine the poles in excess"),
        ("poles: 2, zeros: 0, delay: 0.35", "poles: 2, zeros: 0, delay: 0.4", "taken as 0.4 s"),
        (
            "srivc, poles: 2, zeros: 0, delay: 0.35",
            "td_srivc, poles: 2, zeros: 0, delay_bounds: [0.5, 2]",
            "sought from 0.5 to 2 s and the true one is 0.35 s",
        ),
        (
            "srivc, poles: 2, zeros: 0, delay: 0.35",
            "delay_profile, poles: 2, zeros: 2, delay_bounds: [0.35, 0.35]",
            "as many zeros as poles",
        ),
        ("white, snr_db: 10", "white, standard_deviation: 0", ""),
        (
            "srivc, poles: 2, zeros: 0,",
            "additive_srivc, terms: [{poles: 1, zeros: 0}, {poles: 1, zeros: 0}],",
            "room for 0",
        ),
    ],
)
def test_what_theory_does_not_cover_is_said(accuracy, old, new, reason):
    found = accuracy(ONE.replace(old, new))["estimates"][0]
    if reason:
        assert reason in found["reason"]
        assert found["parameters"] == []
        assert not found["scales"]
    else:
        assert [p["standard_error"] for p in found["parameters"]] == [0, 0, 0]


def test_terms_that_are_not_those_of_the_system(accuracy):
    for terms, reason in [
        ("[{poles: 2, zeros: 0}, {poles: 1, zeros: 0}]", "terms (2) do not match the submodels of the system (2)"),
        ("[{poles: 2, zeros: 0}]", "terms (1) do not match"),
        ("[{poles: 2, zeros: 0}, {poles: 2, zeros: 0}, {poles: 2, zeros: 0}]", "terms (3) do not match"),
    ]:
        spec = CLOSED.replace("[{poles: 2, zeros: 0}, {poles: 2, zeros: 0}]", terms)
        assert reason in entries(accuracy(spec), "sum")[0]["reason"]
    # a longer numerator holds the system, at a price
    spec = CLOSED.replace("[{poles: 2, zeros: 0}, ", "[{poles: 2, zeros: 1}, ")
    longer, exact = entries(accuracy(spec), "sum")[1], entries(accuracy(CLOSED), "sum")[1]
    assert [p["name"] for p in longer["parameters"]][3] == "g1_b1"
    assert variances(longer, "a2")[0] > variances(exact, "a2")[0]
    # in another order, where the one given does not fit
    swapped = spec.replace("{numerator: [1], d", "{numerator: [0.1, 1], d")
    names = [p["name"] for p in entries(accuracy(swapped), "sum")[1]["parameters"]]
    assert names == ["g1_a1", "g1_a2", "g1_b0", "g2_a1", "g2_a2", "g2_b0", "g2_b1"]


def test_without_noise_and_with_coloured_noise_in_a_loop(accuracy):
    silent = re.sub(r"noise:.*\n", "", ONE)
    assert "no noise" in accuracy(silent)["estimates"][0]["reason"]
    coloured = CLOSED.replace("kind: white", "kind: arma, numerator: [1], denominator: [1, -0.9]")
    content = accuracy(coloured)
    assert "the input is correlated with the noise" in entries(content, "direct")[0]["reason"]
    assert entries(content, "clsrivc")[0]["parameters"]
    assert "M^-1 Sigma M^-1" in entries(content, "clsrivc")[1]["formula"]


def test_swept_options_of_an_estimator(accuracy):
    swept = ONE.replace("delay: 0.35}\nmonte", "delay: [0.35, 0.4]}\nmonte")
    known, late = accuracy(swept)["estimates"]
    assert (known["options"], late["options"]) == ({"estimator.delay": 0.35}, {"estimator.delay": 0.4})
    assert known["parameters"]
    assert not late["parameters"]
    text = accuracy(swept, text=True)
    assert "\nknown with estimator.delay 0.35 (srivc): standard errors\n" in text
    assert "\nknown with estimator.delay 0.4 (srivc): no theory: the estimate is biased, as the delay" in text


def test_a_handful_of_many(accuracy):
    sizes = accuracy(ONE, "--set", "sampling.samples=[600, 6000, 7000, 8000, 9000, 10000, 20000]")
    assert [entry["samples"] for entry in sizes["estimates"]] == [600, 7000, 9000, 20000]
    assert sizes["left_out"] == 3
    text = accuracy(ONE, "--set", "noise.snr_db=[1, 2, 3, 4, 5, 6, 7, 8]", text=True)
    assert text.count("half width\n") == 6
    assert "Not shown: 2 further combinations" in text


def test_a_measured_record_has_no_known_system(ctid, measured):
    done = ctid("accuracy", measured, code=2)
    assert done.stdout == ""
    assert "measured-tiny is about a measured record, whose true system is not known" in done.stderr


def test_a_wrong_file_is_reported_as_by_the_other_commands(ctid, tmp_path):
    file = tmp_path / "spec.yaml"
    file.write_text(ONE.replace("samples: 6000", "samples: 1"), encoding="utf-8")
    assert "spec.yaml:4:" in ctid("accuracy", file, code=2).stderr
