"""No structure fits worse than one that it contains, whatever a record brings."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ctid_cli.estimators.delay_profile import DelayProfile
from tests.estimation.optimum.systems import random_model, record_of


@st.composite
def pairs(draw):
    """Poles and zeros of a structure and of one that it contains, in the second case with a pole at infinity."""
    n = draw(st.integers(2, 4))
    m = draw(st.integers(0, n - 1))
    smaller = [(n - 1, m - 1), (n - 1, m), (n, m - 1)]
    return (n, m), draw(st.sampled_from([(k, z) for k, z in smaller if 0 <= z < k]))


@given(
    seed=st.integers(0, 1000),
    pair=pairs(),
    initial_state=st.sampled_from(["rest", "estimate", "periodic"]),
    offset=st.sampled_from(["none", "remove", "estimate"]),
    delayed=st.booleans(),
)
@settings(max_examples=8)
@example(seed=1, pair=((12, 0), (11, 0)), initial_state="rest", offset="remove", delayed=False)
def test_the_cost_never_rises(seed, pair, initial_state, offset, delayed):
    rng = np.random.default_rng(seed)
    model = random_model(rng, int(rng.integers(1, 5)), 0, 0.7 if delayed else 0.0)
    record = record_of(model, rng, samples=80, noise=rng.choice([0.1, 1.0]), offset=2.0)
    bounds = (0.0, 2.0) if delayed else (0.0, 0.0)
    options = {"initial_state": initial_state, "offset": offset, "search": "samples", "nested": True}
    larger, smaller = (DelayProfile(n, m, bounds, **options).fit(record).cost for n, m in pair)
    assert larger <= smaller * (1 + 1e-6)
