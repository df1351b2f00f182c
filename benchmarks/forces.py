"""`python -m benchmarks.forces`: every controller in the case study, and why desired and measured forces differ."""

import sys

from snakesim_testing.runs.desired_and_measured_forces import main

if __name__ == "__main__":
    sys.exit(main())
