"""Rows of a sum of submodels: compiled pass, general method, and direct simulation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.filtering.bank import Chains, Modes
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.kernels import BLOCK
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate, simulate_additive
from ctid_cli.filtering.submodels import OPEN_LOOP, LoopData, SubmodelFilter
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

INTERVAL = 0.1
#: Sums with every kind of submodel; the numbers are a_1 … a_n, b_0 … b_m of each in turn.
SUMS = {
    "mode": ([Term(2, 0)], [0.1, 0.25, 2.0]),
    "third order": ([Term(3, 2)], [0.8, 0.35, 0.1, 1.0, 0.3, -0.05]),
    "biproper": ([Term(2, 2)], [0.1, 0.25, 2.0, 0.3, 0.05]),
    "biproper, leading coefficient zero": ([Term(1, 1)], [0.7, 2.0, 0.0]),
    "gain": ([Term(0, 0), Term(2, 0)], [0.4, 0.1, 0.25, 2.0]),
    "mixed": (
        [Term(1, 1), Term(2, 0), Term(3, 1)],
        [0.7, 2.0, 0.2, 0.01, 0.05, 0.4, 0.8, 0.35, 0.1, 1.0, 0.3],
    ),
    "integrator": ([Term(0, 0, 1), Term(2, 0)], [0.3, 0.1, 0.25, 2.0]),
    "rigid body with zero and mode": ([Term(2, 2, 2), Term(1, 0)], [0.1, 0.25, 0.03, -0.2, 0.1, 0.7, 2.0]),
    "biproper integrator": ([Term(1, 0), Term(1, 2, 1)], [0.7, 2.0, 0.2, 0.3, 0.1, 0.04]),
    "biproper, integrators only": ([Term(0, 2, 2), Term(2, 1)], [0.03, 0.1, 0.2, 0.1, 0.25, 2.0, 0.1]),
    "three integrators": ([Term(1, 1, 3)], [0.7, 0.002, 0.001]),
}
ALL_SUMS = pytest.mark.parametrize(("terms", "theta"), SUMS.values(), ids=SUMS.keys())
WEAK = DiscreteController.from_pid(0.02, 0.004, 0.03)
DIRECT = DiscreteController([0.3], [1.0])
NO_DIRECT = DiscreteController([0.1, -0.02], [1.0, -0.5, 0.06])


def record(seed=1, n=300, hold="zoh", interval=INTERVAL, masked=()):
    """Return a record of noise: the equalities below hold for any data."""
    rng = np.random.default_rng(seed)
    t = 3.0 + interval * np.arange(n)
    y = rng.standard_normal(n)
    y[list(masked)] = np.nan
    return Record(t, y, HeldSignal(t, rng.standard_normal(n), hold))


def feedback(controller, n, enters="controller", seed=7):
    """Return a loop in the layout of the pass."""
    return LoopData(np.random.default_rng(seed).standard_normal(n), controller, enters == "controller")


def assert_rows(rows, expected, tolerance):
    """Compare psi, phi, error and output, or some of them: each column relative to its rms."""
    for place, (one, other) in enumerate(zip(rows, expected, strict=True)):
        one, other = one.reshape(len(one), -1), other.reshape(len(other), -1)
        assert one.shape == other.shape
        size = np.sqrt(np.mean(other**2, axis=0))
        difference = np.abs(one - other).max(axis=0) / np.where(size > 0, size, 1.0)
        assert difference.max(initial=0.0) <= tolerance, (
            f"rows {place}, column {difference.argmax()}: {difference.max():.1e}"
        )


def output_of(terms, theta, delay, signal, times):
    return simulate_additive(AdditiveModel.from_theta(theta, terms, delay), signal, times)


def central_differences(response, theta):
    """Return derivatives of a response by extrapolated central differences."""
    columns = []
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = 1e-3 * max(abs(theta[k]), 0.1)
        one, two = ((response(theta + s * step) - response(theta - s * step)) / (2 * s * step[k]) for s in (1, 2))
        half = (response(theta + 0.5 * step) - response(theta - 0.5 * step)) / step[k]
        columns.append((64 * half - 20 * one + two) / 45)
    return np.column_stack(columns)


@given(st.data(), st.floats(0, 2), st.sampled_from(["zoh", "foh"]), st.booleans(), st.integers(0, 2**31))
def test_compiled_pass_is_the_general_route_for_any_sum(draw, delay, hold_output, closed, seed):
    terms, theta, magnitude, biproper = [], [], 0.3, False
    rng = np.random.default_rng(seed)
    for k in range(draw.draw(st.integers(1, 3))):
        integrators = draw.draw(st.integers(0, 2)) if k == 0 else 0
        poles = []
        for _ in range(draw.draw(st.integers(1, 2))):
            magnitude *= draw.draw(st.floats(1.3, 2.5))
            angle = draw.draw(st.sampled_from([0.0, 0.55, 0.8])) * np.pi
            poles += [-magnitude] if angle == 0 else [magnitude * np.exp(s * 1j * angle) for s in (1, -1)]
        term = Term(len(poles), draw.draw(st.integers(0, len(poles) + integrators - int(biproper))), integrators)
        biproper |= term.zeros == term.order
        polynomial = np.poly(poles).real
        terms.append(term)
        theta += [*(polynomial / polynomial[-1])[-2::-1], *(rng.uniform(0.1, 1.0, term.zeros + 1) * 0.1)]
    data = filter_data(record(seed, n=200), delay, hold_output)
    loop = feedback(WEAK, 200, seed=seed) if closed else OPEN_LOOP
    submodels, theta = SubmodelFilter(data, terms, delay, loop), np.array(theta)
    assert isinstance(submodels._pooled(theta).model, Modes)
    assert_rows(submodels.rows(theta), submodels.rows(theta, "chain"), 1e-7)


@pytest.mark.parametrize("delay", [0.0, 0.3, 0.5371])
@pytest.mark.parametrize(("hold", "hold_output"), [("zoh", "foh"), ("foh", "zoh")])
@ALL_SUMS
def test_rows_are_the_signals_that_a_simulation_gives(terms, theta, hold, hold_output, delay):
    # Definition of the rows: transfer functions applied to the input, or to the output minus the other submodels.
    r = record(n=120, hold=hold)
    data = filter_data(r, delay, hold_output)
    model = AdditiveModel.from_theta(theta, terms, delay)
    error = r.y - simulate_additive(model, r.input, r.t)
    phi = []
    for part in model.submodels:
        term, a = part.term(), np.asarray(part.denominator)
        transfer = part.transfer_function()
        x = simulate(TransferFunction(transfer.numerator, transfer.denominator, delay), r.input, r.t)
        left = HeldSignal(r.t, error + x, hold_output)
        power = [np.append(1.0, np.zeros(k)) for k in range(max(term.poles, term.zeros) + 1)]
        phi += [-simulate(TransferFunction(p, a), left, r.t) for p in power[1 : term.poles + 1]]
        whole = np.append(a, np.zeros(term.integrators))
        phi += [simulate(TransferFunction(p, whole, delay), r.input, r.t) for p in power[: term.zeros + 1]]
    psi = central_differences(lambda values: output_of(terms, values, delay, r.input, r.t), np.array(theta))
    expected = psi, np.column_stack(phi), error, r.y - error
    rows = SubmodelFilter(data, terms, delay).rows(np.array(theta))
    expected = [part[data.use] for part in expected]
    assert_rows(rows[:1], expected[:1], 1e-6)
    assert_rows(rows[1:], expected[1:], 1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.5371])
@pytest.mark.parametrize(("controller", "enters"), [(WEAK, "controller"), (NO_DIRECT, "controller"), (DIRECT, "input")])
@ALL_SUMS
def test_closed_loop_instruments_are_sensitivities_to_the_input_of_the_loop_of_the_model(
    terms, theta, controller, enters, delay
):
    # Derivatives of G(theta) z with fixed z, the input of the noise-free loop; the regressors use the record.
    # With a biproper submodel, no delay and a controller that acts at once, the loop is algebraic.
    r = record(n=200)
    data = filter_data(r, delay)
    loop = feedback(controller, 200, enters)
    model = AdditiveModel.from_theta(theta, terms, delay)
    z = simulate_loop(model, controller, loop.reference, 0.0, INTERVAL, enters)
    source = HeldSignal(r.t, z.u)
    psi, phi, error, output = SubmodelFilter(data, terms, delay, loop).rows(np.array(theta))
    expected = central_differences(lambda values: output_of(terms, values, delay, source, r.t), np.array(theta))
    _, open_phi, open_error, _ = SubmodelFilter(data, terms, delay).rows(np.array(theta))
    assert_rows([psi], [expected[data.use]], 1e-6)
    assert_rows((phi, error, output), (open_phi, open_error, z.x[data.use]), 1e-9)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("name", ["mixed", "rigid body with zero and mode", "biproper integrator"])
def test_moments_are_the_products_of_the_rows(name, closed):
    terms, theta = SUMS[name]
    n = 3 * BLOCK + 17
    data = filter_data(record(n=n, masked=(0, BLOCK, BLOCK + 1, 2 * BLOCK - 1, n - 1)), 0.25)
    submodels = SubmodelFilter(data, terms, 0.25, feedback(WEAK, n) if closed else OPEN_LOOP)
    psi, phi, error, output = submodels.rows(np.array(theta))
    moments = submodels.moments(np.array(theta))
    left, right = np.linalg.norm(psi, axis=0), np.linalg.norm(phi, axis=0)
    for found, expected, scale in (
        (moments.instrument_regressor, psi.T @ phi, np.outer(left, right)),
        (moments.hessian, psi.T @ psi, np.outer(left, left)),
        (moments.instrument_error, psi.T @ error, left * np.linalg.norm(error)),
        (moments.squared_error, error @ error, error @ error),
        (moments.output_power, output @ output, output @ output),
    ):
        assert np.abs((found - expected) / scale).max() <= 1e-11


@ALL_SUMS
def test_clock_that_is_not_recognised_as_regular_gives_the_same(terms, theta):
    data = filter_data(record(hold="foh"), 0.25)
    regular, irregular = (SubmodelFilter(d, terms, 0.25) for d in (data, data._replace(interval=0.0)))
    assert_rows(irregular.rows(np.array(theta)), regular.rows(np.array(theta)), 1e-9)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 0.0])
def test_repeated_poles_are_the_limit_of_separate_ones(gap, closed):
    # (p + 2)(p + 2 + gap), with an oscillating submodel: the rows hardly change.
    polynomial = np.poly([-2.0, -2.0 - gap])
    theta = np.array([*(polynomial / polynomial[-1])[-2::-1], 1.0, 0.2, 0.1, 0.05, 0.4])
    terms = [Term(2, 1), Term(2, 0)]
    submodels = SubmodelFilter(filter_data(record()), terms, 0.0, feedback(WEAK, 300) if closed else OPEN_LOOP)
    assert_rows(submodels.rows(theta), submodels.rows(theta, "chain"), 1e-6)
    if gap == 0.0:
        assert isinstance(submodels._pooled(theta).model, Chains)


@pytest.mark.parametrize(("closed", "hold", "delay"), [(False, "zoh", 0.37), (False, "foh", 0.0), (True, "zoh", 0.37)])
@ALL_SUMS
def test_free_responses_add_to_the_forced_ones(terms, theta, delay, hold, closed):
    # The error decreases by the free response, and psi has its sensitivities: -d eps in open loop, for all parameters.
    data = filter_data(record(n=200, hold=hold), delay)
    loop = feedback(WEAK, 200) if closed else OPEN_LOOP
    forced = SubmodelFilter(data, terms, delay, loop)
    free = SubmodelFilter(data, terms, delay, loop, "estimated")
    order = sum(term.order for term in terms)
    assert free.free == order
    whole = np.concatenate((theta, 0.1 * np.random.default_rng(4).standard_normal(order)))
    at_rest = np.concatenate((theta, np.zeros(order)))
    p = len(theta)
    assert_rows(
        [part[:, :p] if part.ndim == 2 else part for part in free.rows(at_rest)], forced.rows(np.array(theta)), 1e-12
    )
    psi, _, error, output = free.rows(whole)
    _, _, forced_error, forced_output = forced.rows(np.array(theta))
    np.testing.assert_allclose(error + output, forced_error + forced_output, atol=1e-9)
    derivative = -central_differences(lambda values: free.rows(values)[2], whole)
    columns = slice(p, None) if closed else slice(None)
    assert_rows([psi[:, columns]], [derivative[:, columns]], 1e-6)


@pytest.mark.parametrize(
    "theta",
    [
        [0.1, 0.0, 2.0],  # loses a pole
        [0.0, 0.0, 2.0],
        [0.1, np.nan, 2.0],
        [0.1, np.inf, 2.0],
        [-1e-3, 1e-4, 2.0],  # unstable, grows beyond all numbers within the record
        [1e-300, 1e-310, 2.0],
        [1e300, 1e300, 1e300],
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("initial_state", "closed"),
    [("rest", False), ("estimated", False), ("rest", True), ("estimated", True)],
)
def test_parameters_without_a_finite_response_give_nothing(theta, initial_state, closed):
    data = filter_data(record(n=2000))
    loop = feedback(WEAK, 2000) if closed else OPEN_LOOP
    submodels = SubmodelFilter(data, [Term(2, 0)], 0.0, loop, initial_state)
    assert submodels.moments(np.concatenate((theta, np.zeros(submodels.free)))) is None


@pytest.mark.parametrize("polynomial", [[1.0, 4.0, 4.0], [1.3, 4.0, 4.0]], ids=["double pole", "two poles"])
def test_loop_that_grows_beyond_all_numbers_gives_nothing(polynomial):
    # In both methods of simulation: an iteration then halves its step.
    theta = np.array([polynomial[1], polynomial[0], 50.0 * polynomial[2]]) / polynomial[2]
    loop = feedback(DiscreteController([3.0], [1.0]), 3000)
    assert SubmodelFilter(filter_data(record(n=3000)), [Term(2, 0)], 0.0, loop).moments(theta) is None
