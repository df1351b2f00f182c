"""Gives every test a separate state folder, and makes Hypothesis try the same examples each time."""

import snakesim_testing.isolation  # noqa: F401 - first: it fixes the arithmetic before NumPy is imported
from snakesim_testing.hypothesis_profiles import load_profile

load_profile()
