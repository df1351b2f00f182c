"""`python -m verification.attack [-k a4]`: every attack in full; further arguments are those of pytest."""

import os
import sys
from pathlib import Path

import pytest

if __name__ == "__main__":
    os.environ["SNAKESIM_ATTACK"] = "full"
    sys.exit(pytest.main([str(Path(__file__).parent), "--timeout", "900", "-m", "", *sys.argv[1:]]))
