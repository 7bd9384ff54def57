"""Settings of all tests: property-based tests use the same examples on every machine; what takes long begins first."""

from hypothesis import settings

from ctid_cli.cli import _progress

# Commands in tests say nothing of their progress, however slow the machine is.
_progress.SILENT = 3600.0

# No deadline, since the first call of a compiled kernel takes seconds; derandomised, since a test that fails only
# sometimes does not show which change caused the failure.
settings.register_profile("ctid", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("ctid")

#: Tests that take a third of the time. If others began first, one worker would wait for the other at the end.
SLOW = ("tests/identification/", "tests/running/", "tests/test_", "tests/cli/test_tutorial")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: not item.nodeid.startswith(SLOW))
