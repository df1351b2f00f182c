"""`python -m benchmarks.forces`: every controller in the case study, and why desired and measured forces differ."""

import sys

from tests.physics.solved_and_felt import main

if __name__ == "__main__":
    sys.exit(main())
