"""What every test shares: property-based tests that draw the same examples on every machine."""

from hypothesis import settings

# Without a deadline, since the first call of a compiled kernel takes seconds; derandomised, since a test that
# fails now and then tells nobody what broke it.
settings.register_profile("ctid", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("ctid")
