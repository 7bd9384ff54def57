"""Workers have their next job ready: what becomes of it when the one before it goes wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from ctid_cli.running.executor import Begun, Computed, Done, Lost, Message
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.pool import LokyPool
from ctid_cli.running.retry import Stock
from ctid_cli.running.todo import Todo
from tests.running.fakes import FakePlan, Toy
from tests.running.hostile import Hostile


def jobs(toy: Toy, runs: int = 2) -> list[Job]:
    """Jobs of which the first one, replicate 0, does what the toy does there."""
    plan: Any = FakePlan(toy, levels=(5,), runs=runs)
    return list(Todo(plan, Stock()).jobs())


@pytest.fixture
def pool_of() -> Iterator[Callable[..., LokyPool]]:
    made: list[LokyPool] = []

    def make(*arguments: Any) -> LokyPool:
        made.append(LokyPool(*arguments))
        return made[-1]

    yield make
    for pool in made:
        pool.close()


def heard(pool: LokyPool, enough: Callable[[list[Message]], bool]) -> list[Message]:
    """All messages until there are enough."""
    messages: list[Message] = []
    deadline = time.monotonic() + 120
    while not enough(messages):
        messages += pool.collect(0.05)
        assert time.monotonic() < deadline
    return messages


def computed(messages: list[Message], job: Job) -> int:
    return sum(len(message.outcomes) for message in messages if isinstance(message, Computed) and message.job is job)


@pytest.mark.parametrize(
    ("toy", "limits", "cause"),
    [
        (Toy("die", at=0), Limits(), "crash"),
        (Hostile("be killed", at=0), Limits(), "machine"),
        (Hostile("loop", at=0), Limits(wall_seconds=2), "time"),
    ],
)
def test_the_job_that_is_ready_is_not_to_blame(
    pool_of: Callable[..., LokyPool], toy: Toy, limits: Limits, cause: str
) -> None:
    pool, (first, second) = pool_of(1, limits), jobs(toy)
    assert pool.room == 2
    pool.submit(first)
    pool.submit(second)
    assert pool.room == 0
    messages = heard(pool, lambda found: any(isinstance(message, Done) for message in found))
    (lost,) = (message for message in messages if isinstance(message, Lost))
    assert (lost.job, lost.cause, len(lost.keys)) == (first, cause, 1)
    assert computed(messages, second) == len(second.wanted)
    assert [message.job for message in messages if isinstance(message, Begun)] == [first, second]


def test_a_worker_with_nothing_to_do_takes_what_another_has_ready(pool_of: Callable[..., LokyPool]) -> None:
    pool, (hangs, *others) = pool_of(2), jobs(Hostile("sleep", at=0), runs=4)
    for job in (hangs, *others):
        pool.submit(job)
    messages = heard(pool, lambda found: sum(isinstance(message, Done) for message in found) == 3)
    assert all(computed(messages, job) == len(job.wanted) for job in others)
    assert not any(isinstance(message, Lost) for message in messages)


def test_what_is_to_be_alone_waits_for_a_new_process(pool_of: Callable[..., LokyPool]) -> None:
    pool, (first, second, third) = pool_of(1), jobs(Toy(), runs=3)
    pool.submit(first)
    pool.submit(second)
    pool.submit(third, alone=True)
    assert pool.room == 0
    messages = heard(pool, lambda found: sum(isinstance(message, Done) for message in found) == 3)
    assert [message.job for message in messages if isinstance(message, Done)] == [first, second, third]
