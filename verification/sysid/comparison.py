"""Identifies robots with all methods, and keeps the results in a file."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from verification.identification_trials import draw_hidden_robot, record_motion
from verification.sysid.equations import identify_by_equations
from verification.sysid.estimates import IdentificationResult
from verification.sysid.rollout_fit import identify_by_rollouts

# Robots and records are small, because mujoco.sysid simulates the record once for each parameter of each joint.
SMALL_ROBOT_OPTIONS = ("robot.chain.modules=3", "duration_s=12")
OURS = "robot identify"
OURS_WITHOUT_IMUS = "robot identify, without IMUs"
THEIRS = "mujoco.sysid"


@dataclass(frozen=True)
class RobotComparison:
    """The result of every method for one robot."""

    number: int  # of the robot; also the seed of its hidden parameters
    loose: int | None  # index of the joint with backlash
    by_method: Mapping[str, IdentificationResult]


def compare_robot(number: int, sets: Sequence[str], *, backlash: bool) -> RobotComparison:
    """Identify one robot with every method, from one record.

    Args:
        number: Number of the robot, which is its seed.
        sets: Changes of the scenario, as `snakesim run --set` takes them.
        backlash: Whether one of its joints has backlash.
    """
    robot = draw_hidden_robot(number, *SMALL_ROBOT_OPTIONS, *sets, backlash=backlash)
    columns, link_rates = record_motion(robot)
    by_method = {
        OURS: identify_by_equations(robot, columns, link_rates),
        OURS_WITHOUT_IMUS: identify_by_equations(robot, columns, None),
        THEIRS: identify_by_rollouts(robot, columns),
    }
    return RobotComparison(number, robot.loose_joint, by_method)


def append_result(path: Path, robot: RobotComparison) -> None:
    """Append the result of one robot to a file, as one line of JSON. An interval may be infinite."""
    with path.open("a") as file:
        file.write(json.dumps(dataclasses.asdict(robot)) + "\n")


def read_results(path: Path) -> list[RobotComparison]:
    """Return the results in a file, or an empty list if the file does not exist."""
    if not path.exists():
        return []
    return [
        msgspec.convert(json.loads(line), RobotComparison) for line in path.read_text().splitlines()
    ]
