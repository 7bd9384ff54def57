"""Assignment of data sets to shards."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import UsageError
from ctid_cli.storage.manifest import Shard, owner
from ctid_cli.storage.merge import shards_text


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 60))
def test_every_shard_gets_its_share(cells: int, runs: int, of: int) -> None:
    dealt = Counter(owner(cell, replicate, cells, of) for replicate in range(runs) for cell in range(cells))
    counts = [dealt[number] for number in range(1, of + 1)]
    assert sum(counts) == cells * runs
    assert max(counts) - min(counts) <= 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1/0", "1", "a/b", "1/3/5", "-1/3", " 1/3", "1/٣", ""])
def test_an_invalid_shard_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="write k/n, for example 2/3"):
        Shard.read(text)


def test_numbers_are_written_as_job_arrays_take_them() -> None:
    assert [shards_text(some, 9) for some in ([7, 1, 3, 2], [4])] == ["shards 1-3,7 of 9", "shard 4 of 9"]
    assert Shard.read("2/3").folder("a/b") == "a/b.shard-2-of-3"
