"""`python -m snakesim_operator.console`: the console of a run."""

import sys

from snakesim_hal.errors import SnakesimError
from snakesim_hal.terminal import report_error
from snakesim_operator.console.command import main

if __name__ == "__main__":
    try:
        sys.exit(main())
    except SnakesimError as error:
        report_error(error, "snakesim console")
        sys.exit(1)
