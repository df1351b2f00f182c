"""How hard to try: each attack once in `make test`; SNAKESIM_ATTACK=full, as in `make attack`, repeats and prolongs."""

import os

FULL = os.environ.get("SNAKESIM_ATTACK") == "full"


def effort(quick: int, full: int) -> int:
    """How often, how many, how long."""
    return full if FULL else quick
