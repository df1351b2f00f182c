"""Writes a robot with emulated drives, and bends it into the shapes that `snakesim robot shape check` requests.

The drives are emulated in the process of the host. The file pose.txt contains the pose into which the scripted
operator bends them.
"""

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.commissioning.shape.design import (
    PLACEMENT_TOLERANCE_RAD,
    design_poses,
)
from snakesim_testing.runs.bench_host import write_lab_folder
from snakesim_testing.runs.command import run_in_background

JOINT_COUNT = 4
POSE_FILE = "pose.txt"
OPERATOR_ERROR_RAD = 0.9 * PLACEMENT_TOLERANCE_RAD  # of each joint, at most
SCENARIO = """
robot = "./snake.toml"
scene = "flat"
controller = "hold"
clock_mode = "realtime"
rate_hz = 50
seed = 1

[start]
on_route = false

[services.control]
latency_ticks = 2

[backends."{backend}"]
physics_model = "inertia"
physics_model_settings = {{ hand_file = "pose.txt" }}
"""
REAL = '''
import msgspec

from snakesim_serial_backend.feetech.backend import FeetechBackend


class Real(FeetechBackend):
    """Emulated servos, described as real ones. They have no IMU and report no serial numbers."""

    def describe(self):
        described = super().describe()
        return msgspec.structs.replace(described, emulated=False, hardware="/dev/ttyACM0")
'''


def make_bent_folder(folder: Path, backend: str) -> Path:
    """Write a robot without IMUs, its scenario, and a backend whose servos are described as real into a folder."""
    return write_lab_folder(
        folder, JOINT_COUNT, SCENARIO.format(backend=backend), {"real.py": REAL}
    )


class ScriptedOperator:
    """Bends the emulated robot as `snakesim robot shape check` asks, within the tolerance of a person."""

    def __init__(
        self,
        home: Path,
        endpoint: str,
        drive_order: Sequence[int] = range(JOINT_COUNT),
        shake_answers: Sequence[str] = ("no",) * JOINT_COUNT,
    ) -> None:
        """Prepare to check the robot of a folder.

        Args:
            home: The folder.
            endpoint: Endpoint of the robot's host.
            drive_order: For each drive, the index of the joint on which it really is.
            shake_answers: Answers in order to the question whether a link moves before its drive does.
        """
        self._home = home
        self._endpoint = endpoint
        self._drive_order = list(drive_order)
        self._shake_answers = list(shake_answers)
        robot = decode_table(read_table_with_base(str(home / "snake.toml"), "robots"), RobotFile)
        self._poses = {pose.name: pose for pose in design_poses(robot.joint_table)}
        self._rng = np.random.default_rng(1)

    def check(self) -> tuple[int, str]:
        """Run the check, bend the robot at every request, and return the exit code and the output of the check."""
        arguments = ("robot", "shape", "check", "snake.toml", "--endpoint", self._endpoint)
        with run_in_background(self._home, *arguments, stdin=subprocess.PIPE) as process:
            assert process.stdout is not None and process.stdin is not None
            printed_lines: list[str] = []
            for line in process.stdout:
                printed_lines.append(line)
                if "Then press Enter" in line:
                    shape = re.search(r"into shape (\w)", line)
                    pose_name = "straight" if shape is None else shape[1]
                    self._bend_robot(self._poses[pose_name].angle_rad)
                    process.stdin.write("\n")
                    process.stdin.flush()
                elif "press Enter" in line:
                    process.stdin.write(f"{self._shake_answers.pop(0)}\n")
                    process.stdin.flush()
            return process.wait(20), "".join(printed_lines)

    def _bend_robot(self, angles_rad: Floats) -> None:
        """Bend the robot into a pose, with the errors of a person."""
        relative_errors = self._rng.uniform(-1.0, 1.0, len(angles_rad))
        placed_rad = angles_rad + relative_errors * OPERATOR_ERROR_RAD
        text = " ".join(f"{placed_rad[joint]:.4f}" for joint in self._drive_order)
        (self._home / "new.txt").write_text(text)
        (self._home / "new.txt").replace(self._home / POSE_FILE)
