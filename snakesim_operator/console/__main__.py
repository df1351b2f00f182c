"""`python -m snakesim_operator.console`: the console of a run."""

import sys

from snakesim_hal.terminal import exit_code
from snakesim_operator.console.command import main

if __name__ == "__main__":
    sys.exit(exit_code("snakesim console", main))
