"""Defines the profiles of Hypothesis, and the number of random trials of a test.

The tests of a change run a tenth of the trials, always the same ones. `python -m verification trials` runs all.
"""

import math
import os

from hypothesis import HealthCheck, Phase, settings

ALL_EXAMPLES = 100  # of a property whose test sets no other number
CHANGE_FRACTION = 0.1  # of all examples, which are tried with each change


def load_profile() -> None:
    """Load the profile that SNAKESIM_HYPOTHESIS names: `same` (the default), `full`, `explore` or `mutants`."""
    # No time limit for an example: the computers are shared, and a slow moment is no failure.
    settings.register_profile(
        "explore",
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
        max_examples=ALL_EXAMPLES,
    )
    # The same code gives the same result.
    settings.register_profile(
        "full", settings.get_profile("explore"), derandomize=True, database=None
    )
    settings.register_profile(
        "same",
        settings.get_profile("full"),
        max_examples=math.ceil(CHANGE_FRACTION * ALL_EXAMPLES),
    )
    # For verification/mutation the first failure is enough.
    settings.register_profile(
        "mutants", settings.get_profile("full"), phases=[Phase.explicit, Phase.generate]
    )
    settings.load_profile(os.environ.get("SNAKESIM_HYPOTHESIS", "same"))


def choose_trial_count(all_trials: int) -> int:
    """Return how many trials the loaded profile makes of a test's trials, at least one.

    Mark a test that calls this with `trials`, so that the campaign makes all of them. Tests of Hypothesis need no mark.
    """
    return math.ceil(all_trials * settings().max_examples / ALL_EXAMPLES)
