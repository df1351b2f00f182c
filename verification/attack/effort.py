"""Chooses how often and how long an attack is repeated.

By default each attack runs once and briefly. `SNAKESIM_ATTACK=full`, which `make attack` sets, repeats and prolongs it.
"""

import os
from collections.abc import Callable

FULL_EFFORT = os.environ.get("SNAKESIM_ATTACK") == "full"

# The type of pytest's fixture `record_property`. What tests record is printed after the last test.
RecordProperty = Callable[[str, object], None]


def choose_effort(quick: int, full: int) -> int:
    """Return the count or duration that this run of the tests uses.

    Args:
        quick: Value for a run that tries each attack once.
        full: Value for a run with full effort.
    """
    if FULL_EFFORT:
        return full
    return quick
