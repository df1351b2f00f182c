"""Hypothesis has no time limit per example here: these machines are shared, and a slow moment is no failure."""

import os

from hypothesis import HealthCheck, Phase, settings

import tests  # noqa: F401 - before anything else: it sets a state folder apart

settings.register_profile("snakesim", deadline=None, suppress_health_check=[HealthCheck.too_slow])
# For tests/mutation: always the same examples, nothing remembered, and the first failure is enough.
settings.register_profile(
    "mutants",
    settings.get_profile("snakesim"),
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
)
settings.load_profile(os.environ.get("SNAKESIM_HYPOTHESIS", "snakesim"))
