"""The digests that runs of shipped scenarios have on every computer with the common arithmetic.

`make golden` writes them again, after a change that is meant to change what robots do: look at the difference first.
"""

import json
import sys
from pathlib import Path

from snakesim_hal.base import arithmetic
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate

FILE = Path(__file__).parents[1] / "tests" / "golden.json"
SCENARIOS = ("triplet", "peg_row", "jam", "clutter", "mamba_flat")
SECONDS = 3
GOLDEN: dict[str, str] = json.loads(FILE.read_text()) if FILE.exists() else {}


def main() -> int:
    """Write the file. Exit code 1 when nobody else would get what this computer computes."""
    if not arithmetic.make_common_arithmetic_env():
        print("this processor lacks AVX2 and FMA: nothing is written")
        return 1
    measured = arithmetic.measure_arithmetic()
    if differing := arithmetic.find_differing_parts(measured):
        print(
            f"{' and '.join(differing)} of this computer round otherwise than COMMON in "
            "snakesim_hal/base/arithmetic.py."
        )
        print(
            "If the lock has another NumPy now, change it there, and try again:",
            json.dumps(measured, indent=4),
        )
        return 1
    found: dict[str, str] = {}
    for name in SCENARIOS:
        found[name] = simulate(
            load_scenario(name, [parse_set_option(f"duration_s={SECONDS}")]).config
        ).summary.command_digest[:16]
        print(
            f"{name:<12}{GOLDEN.get(name, 'new'):<18}{found[name]}{'' if GOLDEN.get(name) == found[name] else '  *'}"
        )
    FILE.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
