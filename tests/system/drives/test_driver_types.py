"""examples/driver_types.py: one controller, unchanged, on the simulator and on emulated drives of every driver type."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "examples" / "driver_types.py"
LINE = re.compile(
    r"(\w+) +moved ([0-9.]+) m, propulsion joints ([0-9 ]+|none), torque correlation (-?[0-9.]+), complete"
)


@pytest.mark.slow  # each driver type alone is in tests/contract, several at once in test_mounted_drives.py
def test_controller_advances_equally_on_every_drive_family() -> None:
    ended = subprocess.run(
        [sys.executable, str(SCRIPT), "2"], capture_output=True, text=True, check=False, timeout=110
    )
    assert ended.returncode == 0, ended.stderr
    rows = [match.groups() for line in ended.stdout.splitlines() if (match := LINE.match(line))]
    assert [row[0] for row in rows] == [
        "sim",
        "can",
        "odrive",
        "moteus",
        "cia402",
        "dynamixel",
        "mixed",
    ], ended.stdout
    moved_m = [float(row[1]) for row in rows]
    assert min(moved_m) > 0.8 * max(moved_m) > 0.1, ended.stdout
    assert len({row[2] for row in rows}) == 1
    assert float(rows[0][3]) == 1.0
