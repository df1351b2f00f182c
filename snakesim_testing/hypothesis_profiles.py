"""Profiles of Hypothesis: the same examples in every run, unless SNAKESIM_HYPOTHESIS names another profile."""

import os

from hypothesis import HealthCheck, Phase, settings


def load_profile() -> None:
    """Load the profile that SNAKESIM_HYPOTHESIS names: `same` (the default), `explore` or `mutants`."""
    # No time limit for an example: the computers are shared, and a slow moment is no failure.
    settings.register_profile(
        "explore", deadline=None, suppress_health_check=[HealthCheck.too_slow]
    )
    # The same code gives the same result.
    settings.register_profile(
        "same", settings.get_profile("explore"), derandomize=True, database=None
    )
    # For verification/mutation the first failure is enough.
    settings.register_profile(
        "mutants", settings.get_profile("same"), phases=[Phase.explicit, Phase.generate]
    )
    settings.load_profile(os.environ.get("SNAKESIM_HYPOTHESIS", "same"))
