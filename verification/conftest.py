"""Every test runs with a state folder of its own and tries the same examples each time."""

import snakesim_testing.isolation  # noqa: F401 - first: it fixes the arithmetic before NumPy is imported
from snakesim_testing.hypothesis_profiles import load_profile

load_profile()
