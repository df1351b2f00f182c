"""A robot whose emulated drives a test turns as a person would by hand."""

import json
from pathlib import Path

from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot import RobotFile
from snakesim_testing.benches.workbench import read_example_from_docs
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.bench import lab_folder
from snakesim_testing.runs.in_process_command import snakesim

JOINTS = 4


BACKEND = "./held.py:Held"


HELD = '''

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
    """A lab's folder: robot file with a comment, scenario, backend."""
    return lab_folder(folder, JOINTS, SCENARIO, {"held.py": read_example_from_docs() + HELD})


def robot(home: Path) -> RobotFile:
    """The robot file as it stands."""
    return decode_table(read_table_with_base(str(home / "snake.toml"), "robots"), RobotFile)


def wait_for_published_angle(home: Path, endpoint: str, angle_rad: float) -> None:
    """Wait until the host publishes an angle of joint_1."""

    def published() -> bool:
        output = snakesim(
            "topic", "echo", "sensor/joints", "--count", "1", "--endpoint", endpoint, cwd=home
        ).out
        return abs(json.loads(output)["message"]["angle_rad"][0] - angle_rad) < 1e-3

    wait_until(published, f"joint_1 at {angle_rad} rad")
