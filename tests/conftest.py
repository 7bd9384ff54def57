"""Settings of all tests: property-based tests use the same examples on every machine."""

from hypothesis import settings

# No deadline, since the first call of a compiled kernel takes seconds; derandomised, since a test that fails only
# sometimes does not show which change caused the failure.
settings.register_profile("ctid", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("ctid")
