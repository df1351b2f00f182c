"""`python -m benchmarks.forces`: every controller in the case study, and why desired and measured forces differ."""

import sys

from snakesim_testing.runs.solved_and_measured import main

if __name__ == "__main__":
    sys.exit(main())
