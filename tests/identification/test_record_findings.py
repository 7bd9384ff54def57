"""Facts on a record in sentences."""

import numpy as np
import pytest

from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate
from ctid_cli.identification.record_findings import findings
from ctid_cli.inference.record_facts import record_facts
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

T = 0.1 * np.arange(400)
U = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 40), 10)
Y = simulate(TransferFunction([1.0], [1.0, 1.0]), HeldSignal(T, U), T) + 0.05 * np.random.default_rng(1).normal(
    size=400
)


def sentences_of(u=U, y=Y):
    found = findings(record_facts(Record.from_arrays(T[: len(y)], u[: len(y)], y)), "s", "", "")
    return {each.topic: each for each in found}


def test_signals_far_from_zero_are_not_constant_and_keep_the_digits_that_differ():
    found = sentences_of(U + 1e9, Y + 1e9)
    assert "output" not in found
    assert "between 999999999 and 1000000001 and holds" in found["input"].sentence


def test_of_a_constant_output_the_input_is_still_told():
    found = sentences_of(y=np.ones(400))
    assert found["output"].level == "problem"
    assert "% of its power lies from 0." in found["input"].sentence
    assert "response" not in found


def test_an_output_that_diverges_is_a_problem():
    unstable = simulate(TransferFunction([1.0], [1.0, -0.2]), HeldSignal(T, U), T)
    assert sentences_of(y=unstable)["growth"].level == "problem"


@pytest.mark.parametrize(("n", "words"), [(1, "Only 1 output sample:"), (7, "Only 7 output samples:")])
def test_few_samples_are_counted(n, words):
    assert sentences_of(y=Y[:n])["samples"].sentence.startswith(words)


def test_of_a_loop_the_options_that_declare_it_are_named():
    v = 0.3 * np.random.default_rng(2).normal(size=400)
    loop = simulate_loop(TransferFunction([1.0], [1.0, 1.0], 0.1), DiscreteController([1.5], [1.0]), U, v, 0.1)
    found = sentences_of(loop.u, loop.x + v)["feedback"]
    assert found.level == "warning"
    assert "--loop unknown" in found.sentence
