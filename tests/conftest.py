"""Settings that all tests share."""

from hypothesis import settings

# The same examples in every run: a test that compares floating-point numbers must not fail one night in a hundred.
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=10)
settings.load_profile("repeatable")
