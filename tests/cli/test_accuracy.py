"""``ctid accuracy``: theoretical values, their formula, and cases without a theory."""

import re

import pytest

from tests.running.accuracy_cases import CASES, specification

#: Intended warnings of these experiments.
EXPECTED = re.compile(": is biased: ")


@pytest.mark.parametrize("case", CASES)
def test_printed(ctid, tmp_path, snapshot, case):
    done = ctid("accuracy", specification(case, tmp_path))
    assert all(EXPECTED.search(line) for line in done.stderr.splitlines())
    assert done.stdout == snapshot
