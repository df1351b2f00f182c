"""Writes a robot whose emulated drives a test turns, as an operator turns the joints of a real robot by hand.

The file drives.json contains the angles of the drives.
"""

import json
from pathlib import Path

from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_testing.benches.workbench import read_example_from_docs
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.bench_host import write_lab_folder
from snakesim_testing.runs.in_process_command import snakesim

JOINT_COUNT = 4
BACKEND = "./held.py:Held"
ANGLE_TOLERANCE_RAD = 1e-3


HELD_BACKEND = '''

import json
from pathlib import Path

from snakesim_drivers.mounting import DriveMounting


class Held(Workbench):
    """Drives that an operator turns by hand: a file has their angles."""

    def sample(self, tick, timestamp_ns):
        drives = np.array(json.loads(Path("drives.json").read_text()))
        self.angle = DriveMounting(self.robot.joint_table).to_joint_angle_rad(drives)
        return super().sample(tick, timestamp_ns)
'''


SCENARIO = """
robot = "./snake.toml"
scene = "flat"
controller = "hold"
clock_mode = "realtime"
rate_hz = 50

[start]
on_route = false

[services.control]
"""


def make_hand_turned_folder(folder: Path) -> Path:
    """Write the robot, its scenario and its backend `held.py` into a folder, and return the folder."""
    return write_lab_folder(
        folder, JOINT_COUNT, SCENARIO, {"held.py": read_example_from_docs() + HELD_BACKEND}
    )


def read_robot_file(home: Path) -> RobotFile:
    """Return the current robot file of a folder."""
    return decode_table(read_table_with_base(str(home / "snake.toml"), "robots"), RobotFile)


def wait_for_published_angle(home: Path, endpoint: str, angle_rad: float) -> None:
    """Wait until the host publishes this angle of joint_1."""

    def is_published() -> bool:
        command = ("topic", "echo", "sensor/joints", "--count", "1", "--endpoint", endpoint)
        sample = json.loads(snakesim(*command, cwd=home).out)["message"]
        return abs(sample["angle_rad"][0] - angle_rad) < ANGLE_TOLERANCE_RAD

    wait_until(is_published, f"joint_1 at {angle_rad} rad")
