"""Writes a robot whose drives report serial numbers, so that its joints can be checked against its file."""

from pathlib import Path

from snakesim_testing.runs.bench_host import write_lab_folder

REAL = '''
from pathlib import Path

import msgspec

from snakesim_sim_backend.backend import SimBackend


class Real(SimBackend):
    """The simulator, described as a real robot whose drives report their serial numbers."""

    def describe(self):
        described = super().describe()
        serials = Path("serials").read_text().split()
        joints = [
            msgspec.structs.replace(joint, serial=serial)
            for joint, serial in zip(described.joints, serials, strict=True)
        ]
        return msgspec.structs.replace(described, backend="real", hardware="can0", emulated=False, joints=joints)
'''


SCENARIO = """
robot = "./snake.toml"
scene = "flat"
controller = "hold"
clock_mode = "lockstep"
rate_hz = 100
seed = 1

[start]
on_route = false

[services.control]
latency_ticks = 2
"""


JOINT_COUNT = 3


def make_checked_folder(folder: Path) -> Path:
    """Write the robot, its scenario and its backend `real.py` into a folder, and return the folder."""
    return write_lab_folder(folder, JOINT_COUNT, SCENARIO, {"real.py": REAL, "serials": "A1 B2 C3"})
