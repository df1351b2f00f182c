"""Hypothesis has no time limit per example here: these machines are shared, and a slow moment is no failure.

It tries the same examples each time, so that the same code gives the same result; `make test-all` tries new ones.
"""

import os

from hypothesis import HealthCheck, Phase, settings

import tests  # noqa: F401 - before anything else: it sets a state folder apart

settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same", settings.get_profile("explore"), derandomize=True, database=None)
# For tests/mutation: the first failure is enough.
settings.register_profile("mutants", settings.get_profile("same"), phases=[Phase.explicit, Phase.generate])
settings.load_profile(os.environ.get("SNAKESIM_HYPOTHESIS", "same"))
