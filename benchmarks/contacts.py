"""`python -m benchmarks.contacts [SCENARIO[,KEY=VALUE|,-KEY...]...]`: the contact estimate against the truth.

True contacts of one side within 8 cm are one push, because the estimate cannot tell them apart. With `backend=can` it
is held against the force sensors of the emulated modules, and gets the IMU readings of the tick.
"""

import sys

from tests.physics.contact_score import MIN_FORCE_N, score

SCENARIOS = ("triplet", "peg_row", "jam", "mamba_hills")


def main() -> int:
    """Print a table."""
    print(f"| run | pushes >= {MIN_FORCE_N:g} N | median error | 75 % below | >= 10 N | missed | ghosts | place |")
    print("|---|---|---|---|---|---|---|---|")
    for given in sys.argv[1:] or SCENARIOS:
        scenario, *settings = given.split(",")
        print(score(scenario, *settings).row(given), flush=True)
        print(score(scenario, *settings, with_pose=False).row(f"{given}, no pose"), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
