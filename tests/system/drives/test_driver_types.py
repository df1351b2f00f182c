"""examples/driver_types.py runs one controller unchanged on the simulator and on drives of every driver type."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "examples" / "driver_types.py"
RESULT_PATTERN = re.compile(
    r"(\w+) +moved ([0-9.]+) m, propulsion joints ([0-9 ]+|none), torque correlation (-?[0-9.]+), complete"
)


@pytest.mark.slow  # each driver type alone is in tests/contract, several at once in test_mounted_drives.py
def test_controller_advances_equally_on_every_driver_type() -> None:
    result = subprocess.run(
        [sys.executable, str(SCRIPT), "2"], capture_output=True, text=True, check=False, timeout=110
    )
    assert result.returncode == 0, result.stderr
    rows = [
        match.groups()
        for line in result.stdout.splitlines()
        if (match := RESULT_PATTERN.match(line))
    ]
    assert [row[0] for row in rows] == [
        "sim",
        "can",
        "odrive",
        "moteus",
        "cia402",
        "dynamixel",
        "mixed",
    ], result.stdout
    advances_m = [float(advance_m) for _, advance_m, _, _ in rows]
    propulsion_joints = {joints for _, _, joints, _ in rows}
    assert min(advances_m) > 0.8 * max(advances_m), result.stdout
    assert 0.8 * max(advances_m) > 0.1, result.stdout
    assert len(propulsion_joints) == 1
    simulator_correlation = float(rows[0][3])
    assert simulator_correlation == 1.0
