"""Compute the digests of short runs of shipped scenarios, and write them to tests/golden.json: `make golden`.

Every computer with the common arithmetic gets these digests, so a changed digest means that a robot moves differently.
Run this command after a change that is meant to do so, and examine the differences, which it marks with `*`.
"""

import json
import sys
from pathlib import Path

from snakesim_hal.base import arithmetic
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate

GOLDEN_PATH = Path(__file__).parents[1] / "tests" / "golden.json"
SCENARIOS = ("triplet", "peg_row", "jam", "clutter", "mamba_flat")
DURATION_S = 3
DIGEST_CHARACTERS = 16
GOLDEN: dict[str, str] = json.loads(GOLDEN_PATH.read_text()) if GOLDEN_PATH.exists() else {}


def compute_digest(scenario: str) -> str:
    """Simulate the first seconds of a scenario, and return the digest of all its commands."""
    config = load_scenario(scenario, [parse_set_option(f"duration_s={DURATION_S}")]).config
    return simulate(config).summary.command_digest[:DIGEST_CHARACTERS]


def has_common_arithmetic() -> bool:
    """Return whether other computers would compute the same digests. If not, print the reason."""
    if not arithmetic.make_common_arithmetic_env():
        print("this processor has no AVX2 or no FMA: nothing is written")
        return False
    measured = arithmetic.measure_arithmetic()
    differing = arithmetic.find_differing_parts(measured)
    if not differing:
        return True
    print(
        f"{' and '.join(differing)} of this computer round differently than COMMON in "
        "snakesim_hal/base/arithmetic.py."
    )
    print(
        "If the lock contains another version of NumPy, change COMMON there, and try again:",
        json.dumps(measured, indent=4),
    )
    return False


def main() -> int:
    """Write the digests. Return 1, without writing, if other computers would compute different ones."""
    if not has_common_arithmetic():
        return 1
    digests: dict[str, str] = {}
    for scenario in SCENARIOS:
        digest = compute_digest(scenario)
        old_digest = GOLDEN.get(scenario, "new")
        mark = "" if digest == old_digest else "  *"
        print(f"{scenario:<12}{old_digest:<18}{digest}{mark}")
        digests[scenario] = digest
    GOLDEN_PATH.write_text(json.dumps(digests, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
