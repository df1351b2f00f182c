"""Runs the console of a run: `python -m snakesim_operator.features.console`."""

import sys

from snakesim_hal.base.terminal import run_tool
from snakesim_operator.features.console.command import main

if __name__ == "__main__":
    sys.exit(run_tool("snakesim console", main))
