"""Standard rows and their second moments, each by two methods."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.filtering.bank import second_moments, standard_rows
from ctid_cli.filtering.filter_data import filter_data, split_delay
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

CASE_1 = (np.array([1.0, 2.8, 4.0]), np.array([8.0]))
CASE_2 = (np.array([1.0, 5.0, 408.0, 416.0, 1600.0]), np.array([-6400.0, 1600.0]))
RELATIVE_DEGREE_ONE = (np.array([1.0, 3.0, 7.0, 5.0]), np.array([2.0, -1.0, 4.0]))
FIRST_ORDER = (np.array([1.0, 0.5]), np.array([2.0]))
REPEATED = (np.poly([-2.0, -2.0, -2.0]), np.array([1.0, 1.0]))
SYSTEMS = [CASE_1, CASE_2, RELATIVE_DEGREE_ONE, FIRST_ORDER, REPEATED]
#: Partial fractions exist for simple poles only; numerically a triple pole is three close ones.
FORMS = [(system, "chain") for system in SYSTEMS] + [(system, "modal") for system in SYSTEMS[:-1]]
HOLDS = st.sampled_from(["zoh", "foh"])
#: Zero, or delays so long that both clocks' codes place them on the same side of a jump of the input.
DELAYS = st.just(0.0) | st.floats(1e-6, 20)


@st.composite
def systems(draw):
    """Draw stable systems of order 1 to 5 whose poles lie at least 10 % apart."""
    poles, magnitude = [], draw(st.floats(0.1, 0.5))
    order = draw(st.integers(1, 5))
    while len(poles) < order:
        magnitude *= draw(st.floats(1.1, 4.0))
        if len(poles) <= order - 2 and draw(st.booleans()):
            angle = draw(st.floats(0.51, 0.9)) * np.pi
            poles += [magnitude * np.exp(1j * angle), magnitude * np.exp(-1j * angle)]
        else:
            poles.append(-magnitude)
    zeros = draw(st.lists(st.floats(-2, 2), min_size=0, max_size=order - 1))
    return np.poly(poles).real, draw(st.floats(0.5, 3)) * np.atleast_1d(np.poly(zeros))


def record(seed, n=400, interval=0.1, hold="zoh", regular=True, own_breaks=False):
    """Return a record of noise: the equalities below hold for any data."""
    rng = np.random.default_rng(seed)
    t = 3.0 + (interval * np.arange(n) if regular else np.cumsum(rng.uniform(0.2, 1.8, n)) * interval)
    tu = 3.0 + np.concatenate(([0.0], np.cumsum(rng.uniform(0.5, 9, n // 3)) * interval)) if own_breaks else t
    return Record(t, rng.standard_normal(n), HeldSignal(tu, rng.standard_normal(tu.size), hold))


def assert_close(rows, expected, tolerance, where=""):
    """Compare columns relative to their sizes."""
    size = np.abs(expected).max(axis=0)
    error = np.abs(rows - expected).max(axis=0) / np.where(size > 0, size, 1.0)
    assert error.max() <= tolerance, f"{where} column {error.argmax()}: {error.max():.1e}"


@given(systems(), DELAYS, HOLDS, HOLDS, st.integers(0, 2**31), st.sampled_from(["auto", "modal", "chain"]))
def test_irregular_code_on_a_regular_clock_is_the_regular_code(system, delay, hold, hold_output, seed, form):
    regular = filter_data(record(seed, hold=hold), 2.0, hold_output)
    irregular = regular._replace(interval=0.0)
    assert regular.interval > 0.0
    # Partial fractions of three poles 10 % apart lose some digits.
    assert_close(standard_rows(irregular, *system, delay, form), standard_rows(regular, *system, delay, form), 1e-9)


@given(systems(), DELAYS, HOLDS, HOLDS, st.integers(0, 2**31), st.booleans())
def test_partial_fractions_and_the_chain_are_one_filter(system, delay, hold, hold_output, seed, regular):
    data = filter_data(record(seed, hold=hold, regular=regular, own_breaks=not regular), 0.0, hold_output)
    expected = standard_rows(data, *system, delay, "chain")
    assert_close(standard_rows(data, *system, delay, "modal"), expected, 1e-8)
    # The default form is never much worse than the better one.
    assert_close(standard_rows(data, *system, delay), expected, 1e-9)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("delay", [0.0, 0.37, 60.0])
def test_very_different_steps_are_taken_together(hold, delay):
    # Hundreds of breaks between two samples, hundreds of samples between two breaks, and a gap longer than the memory.
    rng = np.random.default_rng(3)
    t = np.sort(np.concatenate((rng.uniform(0, 1, 300), rng.uniform(1, 50, 40), rng.uniform(1e4, 1e4 + 50, 300))))
    tu = np.sort(np.concatenate(([-1.0], rng.uniform(0, 1, 3), rng.uniform(1, 50, 9000), rng.uniform(9900, 10060, 60))))
    held = HeldSignal(tu, rng.standard_normal(tu.size), hold)
    data = filter_data(Record(t, rng.standard_normal(t.size), held))
    for system in SYSTEMS[:-1]:
        expected = standard_rows(data, *system, delay, "chain")
        assert_close(standard_rows(data, *system, delay, "modal"), expected, 1e-10)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("hold_output", ["zoh", "foh"])
@pytest.mark.parametrize("form", ["auto", "chain"])
@pytest.mark.parametrize("system", SYSTEMS)
def test_rows_are_the_signals_that_a_simulation_gives(system, form, hold_output, hold, regular):
    # Each row is a transfer function applied to the delayed input or to the held output.
    a, b = system
    n, delay = a.size - 1, 1.234
    r = record(1, hold=hold, regular=regular, own_breaks=not regular)
    data = filter_data(r, 0.0, hold_output)
    output = HeldSignal(r.t, r.y, hold_output)

    def of_input(numerator, denominator):
        return simulate(TransferFunction(numerator, denominator, delay), r.input, r.t)

    power = [np.append(1.0, np.zeros(k)) for k in range(n)]
    x = of_input(b, a)
    expected = (
        [of_input(p, a) for p in power]
        + [of_input([1.0], [1.0])]
        + [of_input(np.polymul(b, p), np.polymul(a, a)) for p in power]
        + [simulate(TransferFunction(p, a), output, r.t) for p in power]
        + [r.y - x, of_input(np.append(b, 0.0), a)]
    )
    assert_close(standard_rows(data, a, b, delay, form), np.column_stack(expected), 1e-10)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize(("system", "form"), FORMS)
def test_moments_are_the_products_of_the_rows(system, form, regular):
    r = record(2, n=700, regular=regular)  # more than a few blocks of the accumulation, and not a whole number
    y = r.y.copy()
    y[[0, 5, 6, 300, 699]] = np.nan
    data = filter_data(Record(r.t, y, r.input), 2.0)
    rows = standard_rows(data, *system, 1.234, form)
    assert rows.shape == (data.count, 3 * system[0].size)
    moments = second_moments(data, *system, 1.234, form)
    scale = np.sqrt(np.diag(moments))
    assert np.abs((moments - rows.T @ rows) / np.outer(scale, scale)).max() <= 1e-12


@pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 0.0])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("partner", [[], [-0.01], [-100.0], [-1 + 3j, -1 - 3j]])
def test_paths_for_simple_and_for_repeated_poles_agree_near_coalescence(partner, regular, gap):
    a, b = np.poly([-1.0, -1.0 - gap, *partner]).real, np.array([1.0, 2.0])
    data = filter_data(record(3, n=2000, regular=regular, hold="foh"))
    expected = standard_rows(data, a, b, 0.77, "chain")
    assert_close(standard_rows(data, a, b, 0.77), expected, 1e-6, "default")
    if gap >= 1e-2:
        assert_close(standard_rows(data, a, b, 0.77, "modal"), expected, 1e-6, "modal")


@pytest.mark.parametrize("cluster", [1e-1, 1e-3, 1e-5, 1e-7])
def test_close_fast_poles_and_a_slow_one_lose_no_accuracy(cluster):
    # At low frequencies the fast poles have no effect, so their cancellation must be tested at high ones.
    a = np.poly([-0.05, -100.0, -100.0 * (1 + cluster)])
    data = filter_data(record(4, n=4000, interval=0.01, hold="foh"))
    expected = standard_rows(data, a, a[-1:], 0.123, "chain")
    assert_close(standard_rows(data, a, a[-1:], 0.123), expected, 1e-6)


@pytest.mark.parametrize("slowness", [1e-1, 1e-3, 1e-5])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_poles_far_slower_than_the_sampling_lose_no_accuracy(hold, regular, slowness):
    # Against the simulator, which other tests compare with high-precision arithmetic.
    a = np.poly([-slowness, -3.0])
    r = record(5, n=2000, hold=hold, regular=regular)
    rows = standard_rows(filter_data(r), a, a[-1:], 0.123)
    expected = [
        simulate(TransferFunction([1.0], a, 0.123), r.input, r.t),
        simulate(TransferFunction(a[-1:], np.polymul(a, a), 0.123), r.input, r.t),
        simulate(TransferFunction([1.0], a), HeldSignal(r.t, r.y, "foh"), r.t),
    ]
    assert_close(rows[:, [0, 3, 5]], np.column_stack(expected), 1e-9)


@pytest.mark.parametrize("interval", [0.01, 0.05, 0.1, 1 / 3])
def test_whole_delays_are_recognised_however_long(interval):
    # k * interval / interval is k up to its own rounding, which grows with k.
    missed = [k for k in range(0, 200_000, 7) if split_delay(k * interval, interval) != (k, 0.0)]
    assert not missed, f"{len(missed)} of them, the first {missed[0]}"


@given(st.floats(0, 1e4), st.floats(1e-3, 10.0))
def test_split_delays_add_up(delay, interval):
    shift, fraction = split_delay(delay, interval)
    assert 0.0 <= fraction < 1.0
    assert (shift - fraction) * interval == pytest.approx(delay, rel=1e-9, abs=1e-9 * interval)


def test_samples_before_the_longest_delay_are_not_used():
    r = record(11, n=100)  # from 3 s, every 0.1 s
    data = filter_data(r, 2.0)
    assert data.count == 80
    assert np.array_equal(data.y_used, r.y[20:])
    later_input = Record(r.t, r.y, HeldSignal(r.t + 1.0, r.input.values))
    assert filter_data(later_input, 2.0).count == 70
