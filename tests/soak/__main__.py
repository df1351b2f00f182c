"""`python -m tests.soak --minutes 30`: run, and print what happened. Exit code 1 when anything was wrong."""

import argparse
import tempfile
from pathlib import Path

from tests.soak.run import soak, summary


def main() -> int:
    """0 when the robot came through it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--backend", default="sim", help="sim or can")
    parser.add_argument("--out", type=Path, help="folder of the run, the events beside it (default: a temporary one)")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="snakesim-soak-") as temporary:
        out = (asked.out or Path(temporary) / "run").resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        found = soak(out, asked.minutes, asked.seed, asked.backend)
    print(summary(found))
    return 1 if found.violations else 0


if __name__ == "__main__":
    raise SystemExit(main())
