"""Automatic choices without options, on records with a known result."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ctid_cli import Given, HeldSignal, Record, TransferFunction, choose, identify, simulate
from ctid_cli.errors import DataError, OptionError
from ctid_cli.identification import criterion
from ctid_cli.identification.choice import Ranking
from ctid_cli.identification.criterion import independent_share, judged, ranked

SECOND = TransferFunction([2.0], [1.0, 1.2, 4.0], 0.23)
DRIVE = TransferFunction([1.5], [1.0, 0.5, 0.0], 0.4)


def binary(rng, count, width=8):
    return np.repeat(rng.choice([-1.0, 1.0], count // width + 1), width)[:count]


def record_of(
    model, *, seed=0, u=None, past=0, offset=0.0, drift=0.0, colour=0.0, deviation=0.05, count=300, hold="zoh"
):
    """Return samples of a model; those before the record cause an initial state."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(count + past)
    u = binary(rng, t.size) if u is None else u
    e = deviation * rng.standard_normal(t.size)
    for k in range(1, t.size):
        e[k] += colour * e[k - 1]
    y = offset + drift * t / t[-1] + e + simulate(model, HeldSignal(t, u, hold), t)
    return Record(t[past:] - t[past], y[past:], HeldSignal(t[past:] - t[past], u[past:]), name="made")


#: Few candidates: the whole grid takes ten times as long.
FEW = Given(poles=(1, 3), zeros=0)
ONE = Given(poles=2, zeros=0, integrators=0)


@cache
def choice_of(model, given=None, **made):
    """Return the choice for a record that several tests use."""
    return choose(record_of(model, **made), given)


def step(lead, count=300):
    return np.where(np.arange(count) < lead, 0.0, 1.0)


COLOURED = {"colour": 0.9, "deviation": 0.03}


@pytest.mark.parametrize(
    ("model", "made", "given", "expected"),
    [
        (SECOND, {}, None, (2, 0, 0)),
        (SECOND, COLOURED, Given(poles=(1, 4), zeros=(0, 1), integrators=0), (2, 0, 0)),
        (DRIVE, {}, FEW, (1, 0, 1)),
        pytest.param(SECOND, COLOURED, None, (2, 0, 0), marks=pytest.mark.slow),
        pytest.param(DRIVE, {}, None, (1, 0, 1), marks=pytest.mark.slow),
    ],
    ids=["white", "coloured", "integrating", "coloured, whole grid", "integrating, whole grid"],
)
def test_the_structure_that_made_a_record_is_found(model, made, given, expected):
    choice = choice_of(model, given, **made)
    options = choice.options
    assert (options.poles, options.zeros, options.integrators) == expected
    assert options.delay_bounds[0] <= model.delay <= options.delay_bounds[1] < 6.0
    assert options.initial_state == "rest"
    assert choice.ranking.best.options.order + 2 <= max(each.options.order for each in choice.ranking.candidates)


@pytest.mark.parametrize(
    ("made", "state", "offset"),
    [
        # An estimated state is never without an offset, which a step response would otherwise hide in it.
        ({"past": 37}, "estimate", "estimate"),
        ({"offset": 3.0}, "rest", "estimate"),
        ({"drift": 1.0}, "rest", "drift"),
    ],
)
def test_state_and_offset_are_those_that_were_made(made, state, offset):
    assert (choice_of(SECOND).options.initial_state, choice_of(SECOND).options.offset) == ("rest", "none")
    options = choice_of(SECOND, ONE, **made).options
    assert (options.initial_state, options.offset) == (state, offset)


@pytest.mark.slow
def test_outliers_are_left_out_of_the_choice_and_given_another_loss():
    record = record_of(SECOND)
    given = replace(ONE, delay_bounds=(0.0, 1.0), initial_state="rest", offset="none")
    y, clean = record.y.copy(), choice_of(SECOND, given)
    y[[30, 90, 250]] += (30.0, -40.0, 25.0)
    choice = choose(replace(record, y=y), given)
    assert " ".join(choice.words()) == " ".join(clean.words()).replace(" --hold", " --loss tukey --hold")
    assert choice.options == replace(clean.options, loss="tukey")
    assert choice.sentences[0].startswith("Loss: tukey (--loss), as 3 output samples are outliers")
    typed = Given(poles=2, zeros=0, delay_bounds=(0.0, 1.0), initial_state="rest", offset="none", loss="squares")
    assert choose(replace(record, y=y), typed).options.loss == "squares"


@pytest.mark.parametrize("lead", [1, 5, 15])
def test_an_early_step_is_a_step_from_rest(lead):
    choice = choose(record_of(SECOND, u=step(lead), offset=1.0), FEW)
    assert choice.options.initial_state == "rest"
    model = choice.ranking.best.fit.model
    assert model.numerator[-1] / model.denominator[-1] == pytest.approx(0.5, abs=0.03)


def test_a_record_that_begins_with_its_step_needs_the_level_before():
    record = record_of(SECOND, u=np.ones(300))
    with pytest.raises(DataError, match="input_before"):
        choose(record)
    choice = choose(record, replace(FEW, input_before=0.0))
    assert choice.options.poles == 2
    assert choice.words()[-4:] == ["--input-before", "0", "--hold", "zoh"]


def test_a_step_at_the_beginning_does_not_tell_an_integrator_from_a_drift():
    # The output rises to the end; a ramp may be due to an integrator or a drift.
    record = record_of(SECOND, u=np.ones(300))
    drifting = Record(record.t, record.y + 0.02 * record.t, record.input)
    choice = choose(drifting, replace(FEW, input_before=0.0))
    assert choice.options.integrators == 0
    assert any(sentence.startswith("Integrators: not tried") for sentence in choice.sentences)
    without_drift = choose(record_of(DRIVE, u=np.ones(300)), replace(FEW, input_before=0.0, offset="none"))
    assert without_drift.options.integrators == 1


def test_a_pair_that_may_follow_the_noise_is_not_taken_and_tells_nothing_of_the_noise():
    best, other, *_ = (each for each in choice_of(SECOND).ranking.candidates if each.is_proper)
    held = replace(best.fit, held_poles=(complex(-best.fit.box.least_damping, 1.0),), cost=0.0)
    estimated = replace(best, fit=held)
    assert not estimated.is_proper
    fast = replace(best.fit, held_poles=(complex(-best.fit.box.least_damping, 10.0),))
    assert replace(best, fit=fast).is_proper
    records = choice_of(SECOND).fitted
    ranking = ranked([estimated, other], records)
    assert ranking.best.options == other.options
    assert ranking.noise.innovation_variance == ranked([other], records).noise.innovation_variance


def errors_of(monkeypatch, sizes):
    """Replace the mean squared errors of blocks by given ones for each number of poles."""
    monkeypatch.setattr(criterion, "_block_errors", lambda each, records, blocks: sizes[each.options.poles])


@pytest.mark.parametrize(
    ("two", "three", "chosen"),
    [
        # The smallest whose errors are not larger by a standard error than those of the least criterion.
        (np.ones(10), np.ones(10), 2),
        (np.full(10, 1.5), np.ones(10), 3),
        (np.tile([0.7, 1.5], 5), np.full(10, 2.0), 2),
        (np.full(10, 1.5), np.full(10, 1.5), 4),
        # Quiet blocks do not decide.
        (np.where(np.arange(10) > 0, 0.01, 9.0), np.full(10, 2.0), 2),
    ],
)
def test_the_smallest_structure_that_predicts_as_well_is_taken(monkeypatch, two, three, chosen):
    record = record_of(SECOND, count=600)
    best = choice_of(SECOND, ONE, count=600).taken
    grid = [
        replace(best, options=replace(best.options, poles=poles), size=poles, criterion=10.0 * k)
        for k, poles in enumerate((4, 2, 3))
    ]
    errors_of(monkeypatch, {4: np.ones(10), 3: three, 2: two})
    ranking, taken = judged(Ranking(tuple(grid), ranked([best], [record]).noise), [record])
    assert taken.options.poles == chosen
    assert ranking.best.options.poles == 4
    assert [each.held_back is not None for each in ranking.candidates] == [True] * 3


def test_the_decrease_of_the_criterion_is_that_of_a_model():
    choice = choice_of(SECOND, FEW, **COLOURED)
    noise, best = choice.ranking.noise, choice.ranking.best
    assert noise.order
    at_fit = sum(float(np.sum(noise.innovations(e)[noise.order :] ** 2)) for e in best.fit.residuals)
    promised = criterion.squared_innovations(
        best.fit.residuals, [psi @ best.fit.tangent for psi in best.fit.sensitivities], noise
    )
    count, parameters = criterion.innovations_count(best.fit.residuals, noise), best.size
    squared = count * np.exp((best.criterion - 1.5 * parameters * np.log(count)) / count)
    # The search counts the first samples too.
    assert promised * (1 - 1e-4) <= squared <= at_fit * (1 + 1e-9)


def choices_of(integrators, own, state="rest"):
    """Return the integrators of the model chosen after few changes, for own criteria without and with one."""
    best = choice_of(SECOND, ONE).taken
    before = "first" if state == "rest" else None
    pair = [
        replace(best, options=replace(best.options, integrators=k, initial_state=state, input_before=before), size=k)
        for k in (0, 1)
    ]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(criterion, "own_criterion", lambda each: own[each.options.integrators])
        return criterion.after_few_changes(pair, integrators).options.integrators


@pytest.mark.parametrize(
    ("blocks", "own", "state", "chosen"),
    [
        (1, (0.0, 5.0), "rest", 1),
        (0, (5.0, 0.0), "rest", 0),
        # With an estimated state only very strong evidence is one of an integrator.
        (1, (5.0, 0.0), "estimate", 0),
        (0, (15.0, 0.0), "estimate", 1),
    ],
)
def test_after_a_few_changes_blocks_decide_on_the_integrator_from_rest(blocks, own, state, chosen):
    assert choices_of(blocks, own, state) == chosen


def test_another_number_of_integrators_that_fits_as_well_is_named():
    # A short step response of an integrator with little lag is also that of a slow pole.
    record = record_of(TransferFunction([0.2], [1.0, 0.002]), u=step(30, 200), deviation=0.05, count=200)
    choice = choose(record, Given(zeros=0, delay_bounds=(0.0, 0.0)))
    (said,) = (text for text in choice.sentences if "fits as well: the criterion of" in text)
    assert f"(--integrators {1 - choice.options.integrators})" in said


def test_more_than_six_poles_are_tried_if_asked():
    made = TransferFunction([1.0], np.poly([-1.0, -1.1, -1.2, -1.3]))
    tried = choose(record_of(made, deviation=1e-5), Given(poles=(6, 7), zeros=0, integrators=0)).ranking.candidates
    assert {each.options.poles for each in tried} == {6, 7}
    assert Given().span.orders(unasked=True)[-1] == 6


@pytest.mark.parametrize(("repeated", "least", "most"), [(1.0, 0.1, 0.12), (0.0, 0.6, 1.0)])
def test_a_residual_that_repeats_with_the_input_counts_once(repeated, least, most):
    # Ten half periods of a square wave.
    u = np.where(np.arange(400) // 40 % 2, -1.0, 1.0)
    record = record_of(SECOND, u=u, count=400)
    rng = np.random.default_rng(3)
    half, white = rng.standard_normal(40), rng.standard_normal(400)
    e = repeated * u * np.tile(half, 10) + (1 - repeated) * white
    fit = choose(record, Given(2, 0, 0, (0.0, 0.0), "rest", "none")).taken.fit
    share = independent_share(replace(fit, residuals=(e,), used=(np.ones(400, dtype=bool),)), [record])
    assert least <= share <= most


def test_the_hold_is_compared_where_the_input_moves_continuously():
    u = np.sin(np.outer(0.1 * np.arange(600), [0.7, 1.9, 3.1, 5.3, 8.0]) + np.arange(5)).sum(axis=1)
    made = choose(record_of(SECOND, u=u, hold="foh", deviation=0.003, count=600), Given(poles=2, zeros=0))
    assert made.records[0].input.hold != "zoh"
    assert any(sentence.startswith("Hold: ") for sentence in made.sentences)


def test_the_input_of_a_loop_is_held():
    u = np.sin(np.outer(0.1 * np.arange(600), [0.7, 1.9, 3.1]) + np.arange(3)).sum(axis=1)
    record = replace(record_of(SECOND, u=u, hold="foh", deviation=0.003, count=600), feedback=True)
    assert choose(record, Given(poles=2, zeros=0)).records[0].input.hold == "zoh"


def test_what_is_given_is_kept():
    given = Given(poles=3, zeros=1, delay_bounds=(0.1, 0.6), initial_state="estimate", offset="drift", hold="foh")
    choice = choose(record_of(SECOND), given)
    options = choice.options
    assert (options.poles, options.zeros, options.integrators, options.delay_bounds) == (3, 1, 0, (0.1, 0.6))
    assert (options.initial_state, options.offset, choice.records[0].input.hold) == ("estimate", "drift", "foh")
    with pytest.raises(OptionError, match="zeros"):
        choose(record_of(SECOND), Given(poles=2, zeros=3))


def test_the_choice_typed_out_is_the_same_model():
    choice = choice_of(SECOND, ONE, offset=3.0, count=600)
    words = dict(zip(choice.words()[::2], choice.words()[1::2], strict=True))
    low, high = map(float, words["--delay"].split(":"))
    typed = Given(
        int(words["--poles"]),
        int(words["--zeros"]),
        0,
        (low, high),
        words["--initial-state"],
        words["--offset"],
        None if words["--input-before"] == "first" else float(words["--input-before"]),
        words["--hold"],
    )
    again = identify(record_of(SECOND, offset=3.0, count=600), typed)
    np.testing.assert_allclose(again.fit.theta, choice.ranking.best.fit.theta, rtol=1e-9)


def test_a_validation_record_has_a_state_and_an_offset_of_its_own():
    other = record_of(SECOND, seed=1, past=37, offset=-4.0)
    found = identify([record_of(SECOND), record_of(SECOND, seed=2)], Given(poles=2, zeros=0), validation=other)
    assert found.options.initial_state == "rest"
    assert found.validation.options.initial_state == "estimate"
    assert found.validation.fit_percent > 85


def test_a_validation_record_does_not_change_the_model(monkeypatch):
    record, asked = record_of(SECOND), []
    monkeypatch.setattr("ctid_cli.identification.identify.choose", lambda *of: asked.append(of) or choice_of(SECOND))
    other = record_of(TransferFunction([-2.0], [1.0, 1.2, 4.0], 0.23), seed=1)
    alone, validated = (identify(record, validation=each) for each in (None, other))
    # The choice gets nothing of the other record.
    assert asked == [([record], Given(), "s")] * 2
    assert alone.choices[: len(choice_of(SECOND).sentences)] == choice_of(SECOND).sentences
    first, *others = validated.warnings
    assert "does not generalise" in first
    assert (validated.choices, validated.options, others) == (alone.choices, alone.options, list(alone.warnings))
    np.testing.assert_array_equal(validated.fit.theta, alone.fit.theta)


def test_no_response_is_no_model():
    noise = record_of(SECOND)
    noise = Record(noise.t, np.random.default_rng(5).standard_normal(300), noise.input)
    with pytest.raises(DataError, match="No model"):
        identify(noise, Given(zeros=0))


@pytest.mark.slow
def test_a_part_of_a_long_record_is_looked_at():
    choice = choose(record_of(SECOND, count=12_000), FEW)
    assert choice.fitted[0].n_samples == 2500
    assert choice.records[0].n_samples == 12_000
    assert choice.options.poles == 2
