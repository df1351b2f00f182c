"""`snakesim robot shape check`: guides a person through the shapes, judges the joints, and records what is confirmed.

No joint is commanded. The robot's host must run, and be disarmed all the time.
"""

import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import RefusedError
from snakesim_hal.base.terminal import overwrite_lines, print_line
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.network.session import open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_single_robot
from snakesim_operator.features.commissioning.by_hand import (
    HOST_TIMEOUT_MESSAGE,
    HOST_TIMEOUT_S,
    REDRAW_PERIOD_S,
    HandMovedRobot,
    is_enter_pressed,
)
from snakesim_operator.features.commissioning.capture import REST_S, RestDetector
from snakesim_operator.features.commissioning.joint_check.joint_verdict import PropertyState
from snakesim_operator.features.commissioning.robot_edit import require_own_robot_file
from snakesim_operator.features.commissioning.shape.decide import (
    SHAPE_PROPERTIES,
    ShapeVerdict,
    find_placement_hint,
    judge_shapes,
)
from snakesim_operator.features.commissioning.shape.design import ShapePose, design_poses
from snakesim_operator.features.commissioning.shape.outline import compute_drawing_mark
from snakesim_operator.features.commissioning.shape.record import write_shape_record
from snakesim_operator.features.commissioning.shape.shake import (
    ask_to_shake_links,
    format_shake_results,
    list_joints,
)

HINT_AFTER_S = 3.0  # of a robot that does not come to rest
ANGLES_PER_LINE = 5
CORRECT_AND_REPEAT = "nothing was written: correct it, restart the host, and repeat the check"
INSTRUCTION_BY_AXIS = {
    None: "Lay the robot along a straight edge, on its belly, with every joint straight",
    "yaw": "Lay the robot on its belly into shape {name}, with its head at the arrow",
    "pitch": "Lay the robot on its left side into shape {name}, its top up the page, with its head at the arrow",
}


def check_shapes(path: Path, selection: RobotSelection) -> int:
    """Guide a person through the shapes, print the verdict on each joint, and record the check in the robot file.

    If the shapes confirm all joints, the person is asked to shake the links, because shapes do not show backlash.

    Args:
        path: Path of the user's own robot file, with which the host was started.
        selection: Network and namespace of the robot to connect to.

    Returns:
        The exit code: 0 if order, sign, gear and zero of every joint were confirmed, otherwise 1. A gear is confirmed
        only if the person answered that its link does not move before its drive.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used.
    """
    require_own_robot_file(path)
    robot_file = decode_table(read_table_with_base(str(path), "robots"), RobotFile)
    with open_session(
        find_single_robot(selection, "robot shape check"), CONNECT_TIMEOUT_S
    ) as session:
        robot = HandMovedRobot(session, path)
        description = session.wait_for_latched(keys.DESCRIPTION, RobotDescription, HOST_TIMEOUT_S)
        if description is None:
            raise RefusedError(HOST_TIMEOUT_MESSAGE, code="network/no-answer")
        poses = design_poses(robot.joints)
        mark = compute_drawing_mark(robot_file, poses)
        print_line(
            f"{len(poses)} poses. Use the sheets with drawing {mark}, by `snakesim robot shape draw {path}`."
        )
        reading_rad = np.array([_measure_pose(robot, pose) for pose in poses])
        verdicts = judge_shapes(robot.joints, poses, reading_rad)
        for line in format_verdicts(verdicts):
            print_line(line)
        if not all(verdict.all_confirmed for verdict in verdicts):
            print_line(f"{path}: {CORRECT_AND_REPEAT}")
            return 1
        shake_results = ask_to_shake_links(robot)
    for line in format_shake_results(shake_results):
        print_line(line)
    if list_joints(shake_results, "loose"):
        print_line(f"{path}: {CORRECT_AND_REPEAT}")
        return 1
    write_shape_record(path, robot.joints, description, list_joints(shake_results, "tight"))
    return 1 if list_joints(shake_results, "unknown") else 0


def format_verdicts(verdicts: Sequence[ShapeVerdict]) -> list[str]:
    """Return the verdict on each joint, one a line, and the counts."""
    lines = [_format_verdict(verdict) for verdict in verdicts]
    right = sum(verdict.all_confirmed for verdict in verdicts)
    wrong = sum(
        any(finding.state == "wrong" for finding in verdict.findings.values())
        for verdict in verdicts
    )
    unknown = len(verdicts) - right - wrong
    lines.append(
        f"{right} of {len(verdicts)} joints match the robot file; {wrong} wrong; {unknown} unknown"
    )
    hint = find_placement_hint(verdicts)
    if hint:
        lines.append(hint)
    lines.append(
        "not judged: drives, which the start check moves; backlash, for which you shake the links"
    )
    return lines


def _format_verdict(verdict: ShapeVerdict) -> str:
    if verdict.all_confirmed:
        return f"{verdict.joint:10}  {', '.join(SHAPE_PROPERTIES)} confirmed"
    texts: list[str] = []
    states: tuple[PropertyState, ...] = ("wrong", "unknown")
    for state in states:
        names = verdict.list_properties(state)
        reasons = dict.fromkeys(verdict.findings[name].reason for name in names)
        if names:
            texts.append(f"{', '.join(names)} {state}: {'; '.join(reasons)}")
    return f"{verdict.joint:10}  {'. '.join(texts)}"


# --- one pose ----------------------------------------------------------------------------------------------------


def _measure_pose(robot: HandMovedRobot, pose: ShapePose) -> Floats:
    """Ask the person for a pose, and return the joint angles once the robot rests in it, (n_joints,)."""
    instruction = INSTRUCTION_BY_AXIS[pose.axis].format(name=pose.name)
    print_line(f"{instruction}. Then press Enter, and hold it still.")
    _show_angles_until_enter(robot)
    angle_rad = _read_angles_at_rest(robot)
    print_line(f"  {pose.name}: measured")
    return angle_rad


def _show_angles_until_enter(robot: HandMovedRobot) -> None:
    """Display the measured angles in a terminal until Enter is pressed."""
    drawn_line_count = 0
    next_drawing_s = 0.0
    for angle_rad in robot.read_angles_rad(is_enter_pressed):
        if sys.stdout.isatty() and time.monotonic() >= next_drawing_s:
            next_drawing_s = time.monotonic() + REDRAW_PERIOD_S
            drawn_line_count = overwrite_lines(
                _format_angles(robot.joints, angle_rad), drawn_line_count
            )


def _format_angles(joints: Sequence[Joint], angle_rad: Floats) -> list[str]:
    cells = [
        f"{joint.name:<9}{angle:+6.2f}"
        for joint, angle in zip(joints, angle_rad.tolist(), strict=True)
    ]
    rows = [
        cells[start : start + ANGLES_PER_LINE] for start in range(0, len(cells), ANGLES_PER_LINE)
    ]
    return ["  ".join(row) for row in rows]


def _read_angles_at_rest(robot: HandMovedRobot) -> Floats:
    """Wait until no joint has moved for `REST_S`, and return the mean angles of that time, (n_joints,)."""
    measurement = RestMeasurement()
    is_hint_printed = False
    for time_s, angle_rad in robot.read_samples(lambda: measurement.rests):
        measurement.add_sample(time_s, angle_rad)
        if measurement.duration_s > HINT_AFTER_S and not measurement.rests and not is_hint_printed:
            print_line(
                f"  {robot.joints[measurement.find_most_moved_joint()].name} moves: hold it still"
            )
            is_hint_printed = True
    return measurement.compute_mean_rad()


class RestMeasurement:
    """Collects the joint angles of a robot until it has rested for `REST_S`."""

    def __init__(self) -> None:
        self.rests = False
        self.duration_s = 0.0  # since the first sample
        self._start_s: float | None = None
        self._detector = RestDetector()
        self._recent: deque[tuple[float, Floats]] = deque()  # time and angles of the last `REST_S`

    def add_sample(self, time_s: float, angle_rad: Floats) -> None:
        """Add the next sample: its time by the robot's clock, and the joint angles, (n_joints,)."""
        if self._start_s is None:
            self._start_s = time_s
        self.duration_s = time_s - self._start_s
        self._recent.append((time_s, angle_rad))
        while time_s - self._recent[0][0] > REST_S:
            self._recent.popleft()
        if not self.rests:
            self.rests = self._detector.add_sample(time_s, angle_rad)

    def compute_mean_rad(self) -> Floats:
        """Return the mean angles of the last `REST_S`, (n_joints,)."""
        return np.mean([angle_rad for _, angle_rad in self._recent], axis=0)

    def find_most_moved_joint(self) -> int:
        """Return the index of the joint that moved most in the last `REST_S`."""
        return int(np.argmax(np.ptp([angle_rad for _, angle_rad in self._recent], axis=0)))
