"""How hard to try: each attack once; SNAKESIM_ATTACK=full, as in `make attack`, repeats and prolongs."""

import os
from collections.abc import Callable

FULL = os.environ.get("SNAKESIM_ATTACK") == "full"
# Pytest's `record_property`: what was measured is told at the end.
Record = Callable[[str, object], None]


def effort(quick: int, full: int) -> int:
    """How often, how many, how long."""
    return full if FULL else quick
