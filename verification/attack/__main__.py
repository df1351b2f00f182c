"""Run every attack with full effort: `python -m verification.attack [PYTEST_ARGUMENT ...]`.

All arguments are passed to pytest: `-k a4` selects the attacks on the emergency stop. The exit code is that of pytest.
"""

import os
import sys
from pathlib import Path

import pytest

if __name__ == "__main__":
    os.environ["SNAKESIM_ATTACK"] = "full"
    test_folder = str(Path(__file__).parent)
    sys.exit(pytest.main([test_folder, "--timeout", "900", "-m", "", *sys.argv[1:]]))
