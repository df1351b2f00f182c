"""`snakesim robot calibrate zero|direction|gear|limits`: a person moves the robot by hand, and the encoders are read.

This module commands no joint. The robot's host must run, and be disarmed all the time.
"""

import math
import select
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, RefusedError
from snakesim_hal.base.terminal import overwrite_lines, print_line
from snakesim_hal.model.robot_file.joints import Joint, JointDrive
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointState, RobotStatus, RunConfiguration
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_single_robot
from snakesim_operator.features.commissioning.capture import (
    HandTurn,
    HandTurnDetector,
    RobotMovedError,
    TravelRange,
    compute_zero_offsets_rad,
)
from snakesim_operator.features.commissioning.robot_edit import (
    read_joints_with_drive_modes,
    require_own_robot_file,
    write_joint_fields,
)
from snakesim_operator.features.commissioning.tolerances import MAX_RATIO_ERROR
from snakesim_operator.features.commissioning.unknown_angles import UnknownAngleTimeout

ZERO_SAMPLING_S = 1.0  # samples for a zero are taken for that long
MAX_SILENCE_S = 1.0  # without joint angles
HOST_TIMEOUT_S = 3.0  # for configuration and status of a running host
REDRAW_PERIOD_S = 0.2
# Of what is ahead of the joint, seen towards the head.
POSITIVE_DIRECTION_BY_AXIS = {"yaw": "to the left", "pitch": "downwards"}
HOST_TIMEOUT_MESSAGE = (
    "the "
    f"robot's host did not publish its configuration within {HOST_TIMEOUT_S:g} s; see `snakesim status`"
)


def load_running_joints(session: Session, path: Path) -> Sequence[Joint]:
    """Load the joints of a robot file, and check that the running host was started with the same joints.

    Args:
        session: Session on the robot's network.
        path: Path of the robot file.

    Returns:
        The joints of the file, tail to head, with the modes that their drives have.

    Raises:
        ConfigError: The joints of the file differ from those that the host was started with.
        RefusedError: The host did not publish its configuration in time.
    """
    configuration = session.wait_for_latched(keys.CONFIG, RunConfiguration, HOST_TIMEOUT_S)
    if configuration is None:
        raise RefusedError(HOST_TIMEOUT_MESSAGE, code="network/no-answer")
    running = msgspec.json.decode(configuration.content, type=RunConfig).robot.joint_table
    joints = read_joints_with_drive_modes(path, running)
    if [_get_drive_identity(joint) for joint in running] != [
        _get_drive_identity(joint) for joint in joints
    ]:
        raise ConfigError(
            f"{path}: its joints are not those that the host was started with, so measured angles would be "
            f"computed wrongly; restart the host with this file",
            code="commissioning/not-possible",
        )
    return joints


def _get_drive_identity(joint: Joint) -> tuple[str, int, JointDrive]:
    return joint.name, joint.id, joint.drive


class HandMovedRobot:
    """A connection to a disarmed robot that a person moves by hand."""

    def __init__(self, session: Session, path: Path) -> None:
        """Connect to the robot's host.

        Raises:
            ConfigError: The host does not run with this robot file.
            RefusedError: The host does not answer.
        """
        self._joint_state_reader = session.declare_reader(keys.JOINTS, JointState)
        self._status_reader = session.declare_latched_reader(keys.STATUS, RobotStatus)
        self.joints = load_running_joints(session, path)
        status = session.wait_for_latched(keys.STATUS, RobotStatus, HOST_TIMEOUT_S)
        if status is None:
            raise RefusedError(HOST_TIMEOUT_MESSAGE, code="network/no-answer")
        self._status = status

    def read_angles_rad(self, should_stop: Callable[[], bool]) -> Iterator[Floats]:
        """Yield the joint angles in rad, (n_joints,), as they arrive; see `read_samples`."""
        for _, angle_rad in self.read_samples(should_stop):
            yield angle_rad

    def read_samples(self, should_stop: Callable[[], bool]) -> Iterator[tuple[float, Floats]]:
        """Yield joint angles with their time as they arrive, until the caller's condition is true.

        Args:
            should_stop: Called again and again; reading ends after it has returned True.

        Yields:
            Time in s by the robot's clock, and joint angles in rad, (n_joints,).

        Raises:
            RefusedError: The robot is armed, sends no angles, or does not know one.
        """
        last_arrival_s = time.monotonic()
        unknown_angle_timeout = UnknownAngleTimeout()
        is_last_pass = False
        while not is_last_pass:
            is_last_pass = should_stop()  # samples that arrived before that are still read
            self._raise_if_armed()
            states = [
                state
                for state in self._joint_state_reader.drain()
                if state.has_joint_count(len(self.joints))
            ]
            if states:
                last_arrival_s = time.monotonic()
            elif time.monotonic() - last_arrival_s > MAX_SILENCE_S:
                raise RefusedError(
                    f"the robot has sent no joint angles for {MAX_SILENCE_S:g} s; see `snakesim status`",
                    code="network/no-answer",
                )
            for state in states:
                unknown_joints = self._list_unknown_joints(state)
                unknown_angle_timeout.check(unknown_joints)
                if not unknown_joints:
                    yield state.timestamp_ns * 1e-9, np.array(state.angle_rad)
            time.sleep(0.01)

    def _raise_if_armed(self) -> None:
        for status in self._status_reader.drain():
            self._status = status
        match self._status.lifecycle:
            case "disarmed" | "fault" | "estop":
                return
            case _:
                raise RefusedError(
                    "the robot is armed: its motors hold the joints; type `snakesim robot disarm` first",
                    code="robot/not-disarmed",
                )

    def _list_unknown_joints(self, state: JointState) -> list[str]:
        """Return the names of the joints whose angle is not known."""
        return [
            joint.name for joint, valid in zip(self.joints, state.valid, strict=True) if not valid
        ]


@contextmanager
def _connect_to_disarmed_robot(
    path: Path, selection: RobotSelection, command: str
) -> Iterator[HandMovedRobot]:
    """Connect to the selected robot for the duration of a `with` block.

    Args:
        path: Path of the user's own robot file.
        selection: Network and namespace of the robot to connect to.
        command: Name of the command for error messages, such as `robot calibrate zero`.

    Raises:
        SnakesimError: The file is a bundled one, or the robot is armed, does not answer or runs with another file.
    """
    require_own_robot_file(path)
    with open_session(find_single_robot(selection, command), CONNECT_TIMEOUT_S) as session:
        yield HandMovedRobot(session, path)


def calibrate_zeros(path: Path, selection: RobotSelection, *, wait_for_enter: bool) -> int:
    """Measure the current, straight pose for a second, and write it as zero of all joints into a robot file.

    Args:
        path: Path of the robot file.
        selection: Network and namespace of the robot to connect to.
        wait_for_enter: Whether to ask the person to lay the robot straight, and wait for Enter.

    Returns:
        The exit code, which is always 0.

    Raises:
        RefusedError: The robot moves, is armed or does not answer.
        ConfigError: The robot file cannot be used.
    """
    with _connect_to_disarmed_robot(path, selection, "robot calibrate zero") as robot:
        if wait_for_enter:
            print_line(
                "Lay the robot straight on a flat floor, take your hands off it, then press Enter."
            )
            for _ in robot.read_angles_rad(is_enter_pressed):
                pass  # reading continues until Enter is pressed; these samples are not needed
        start_s = time.monotonic()
        samples = list(robot.read_angles_rad(lambda: time.monotonic() - start_s > ZERO_SAMPLING_S))
        try:
            zero_offsets_rad = compute_zero_offsets_rad(robot.joints, np.array(samples))
        except RobotMovedError as error:
            raise RefusedError(
                f"{error} within {ZERO_SAMPLING_S:g} s; take your hands off the robot, and try again",
                code="commissioning/not-possible",
            ) from None
    values_by_joint: dict[str, dict[str, Any]] = {}
    for joint, zero_offset_rad in zip(robot.joints, zero_offsets_rad, strict=True):
        print_line(
            f"{joint.name:<10} zero_rad {joint.drive.zero_rad:+8.4f} -> {zero_offset_rad:+8.4f}"
        )
        values_by_joint[joint.name] = {"zero_rad": zero_offset_rad}
        if joint.limits.cable_turns is not None:
            # Time at which the cable was unwound; the host accepts it for an hour.
            values_by_joint[joint.name]["cable_unwound"] = datetime.now(UTC).isoformat(
                timespec="seconds"
            )
            print_line(
                f"{joint.name:<10} its cable counts as unwound here: restart the host within an hour"
            )
    _write_joint_values(path, values_by_joint, "straight pose")
    return 0


def calibrate_directions(path: Path, selection: RobotSelection, names: Sequence[str]) -> int:
    """Ask the person to turn each joint in its positive direction, and correct the signs in the file.

    A drive that then measures a negative turn has the wrong sign. The signs are written into the robot file at the end.

    Args:
        path: Path of the robot file.
        selection: Network and namespace of the robot to connect to.
        names: Names of the joints to calibrate; all joints if empty.

    Returns:
        The exit code: 1 if the sign of a joint is still unknown, because it was skipped or another joint turned;
        otherwise 0.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used, or has no joint of such a name.
    """
    values_by_joint: dict[str, dict[str, Any]] = {}
    unknown_joints: list[str] = []
    with _connect_to_disarmed_robot(path, selection, "robot calibrate direction") as robot:
        for joint in select_joints(robot.joints, names, path):
            direction = POSITIVE_DIRECTION_BY_AXIS[joint.axis]
            instruction = (
                f"turn the link in front of it {direction} by 10 degrees or more, and hold it still"
            )
            turn = _wait_for_hand_turn(robot, joint, instruction)
            if turn is None:
                unknown_joints.append(joint.name)
            elif turn.angle_rad > 0:
                # The person turned it in the positive direction, so the sign in the file is right.
                print_line(f"  {turn.angle_rad:+.2f} rad: matches the file")
            else:
                print_line(f"  {turn.angle_rad:+.2f} rad: mounted the other way round")
                values_by_joint[joint.name] = {"sign": -joint.drive.sign}
    _write_joint_values(path, values_by_joint, "turned by hand")
    return _report_unknown_joints(unknown_joints, f"snakesim robot calibrate direction {path}")


def check_gears(path: Path, selection: RobotSelection, names: Sequence[str], degrees: float) -> int:
    """Ask the person to turn each joint by a known angle, and check its gear ratio against the angle that is measured.

    The robot file is not changed: the person writes the gear ratio of the data sheet into it.

    Args:
        path: Path of the robot file.
        selection: Network and namespace of the robot to connect to.
        names: Names of the joints to check; all joints if empty.
        degrees: Angle by which the person turns each joint, in either direction.

    Returns:
        The exit code: 1 if a gear does not match the file, or is unknown because its joint was skipped; otherwise 0.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used, or has no joint of such a name.
    """
    unknown_joints: list[str] = []
    wrong_joints: list[str] = []
    with _connect_to_disarmed_robot(path, selection, "robot calibrate gear") as robot:
        for joint in select_joints(robot.joints, names, path):
            direction = POSITIVE_DIRECTION_BY_AXIS[joint.axis]
            instruction = f"turn the link in front of it {direction} by {degrees:g} degrees, and hold it still"
            turn = _wait_for_hand_turn(robot, joint, instruction)
            if turn is None:
                unknown_joints.append(joint.name)
                continue
            measured_rad = abs(turn.angle_rad)
            ratio = measured_rad / math.radians(degrees)  # 1 if the gear in the file is right
            result = f"  {math.degrees(measured_rad):.0f} of {degrees:g} degrees"
            if abs(ratio - 1) < MAX_RATIO_ERROR:
                print_line(f"{result}: matches the file")
            else:
                gear_ratio = joint.drive.gear * ratio
                print_line(
                    f"{result}: gear = {gear_ratio:.3g} or so; write that of its data sheet into the file"
                )
                wrong_joints.append(joint.name)
    if wrong_joints:
        print_line(
            f"wrong: {', '.join(wrong_joints)}; correct the gear in {path}, and restart the host with it"
        )
    unknown_exit_code = _report_unknown_joints(
        unknown_joints, f"snakesim robot calibrate gear {path}"
    )
    return 1 if wrong_joints else unknown_exit_code


def _wait_for_hand_turn(robot: HandMovedRobot, joint: Joint, instruction: str) -> HandTurn | None:
    """Ask the person to turn a joint by hand, and wait until the robot is at rest again.

    Args:
        robot: Connection to the robot.
        joint: The joint to turn.
        instruction: Instruction for the person: how to turn the joint.

    Returns:
        The measured turn; None if the joint was skipped, or if another joint turned. Then the reason was printed.
    """
    detector = HandTurnDetector()
    is_instruction_printed = False
    turn: HandTurn | None = None
    for time_s, angle_rad in robot.read_samples(is_enter_pressed):
        turn = detector.add_sample(time_s, angle_rad)
        if turn is not None:
            break
        if detector.is_ready and not is_instruction_printed:
            print_line(f"{joint.name}: {instruction}; Enter skips it")
            is_instruction_printed = True
    if turn is None:
        print_line("  skipped")
        return None
    turned_joint = robot.joints[turn.joint_index]
    if turned_joint is not joint:
        print_line(
            f"  {turned_joint.name} reports the turn: look at the ids and the wiring of {joint.name} and "
            f"{turned_joint.name}"
        )
        return None
    if not turn.is_single_joint:
        print_line("  other joints turned, too: hold them, and repeat this one")
        return None
    return turn


def _report_unknown_joints(names: Sequence[str], command: str) -> int:
    """Print which joints are still unknown and the command that repeats them; return 1 if there are any, else 0."""
    if not names:
        return 0
    print_line(f"still unknown: {', '.join(names)}; type `{command} {' '.join(names)}`")
    return 1


def calibrate_limits(path: Path, selection: RobotSelection, names: Sequence[str]) -> int:
    """Measure how far the person moves each joint until Enter is pressed, and write the limits into the robot file.

    Args:
        path: Path of the robot file.
        selection: Network and namespace of the robot to connect to.
        names: Names of the joints whose limits are written; all joints if empty.

    Returns:
        The exit code: 1 if one of the joints was not moved from end to end, and keeps its limits; otherwise 0.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used, or has no joint of such a name.
    """
    with _connect_to_disarmed_robot(path, selection, "robot calibrate limits") as robot:
        selected_joints = select_joints(robot.joints, names, path)
        print_line("Move each joint by hand from end to end, slowly; then press Enter.")
        travel = _record_travel(robot)
    values_by_joint: dict[str, dict[str, Any]] = {}
    unknown_joints: list[str] = []
    for joint_index, joint in enumerate(robot.joints):
        if joint not in selected_joints:
            continue
        limits_rad = None
        if travel is not None:
            limits_rad = travel.compute_limits_rad(joint_index)
        if limits_rad is None:
            print_line(f"{joint.name:<10} was not moved from end to end: left as it is")
            unknown_joints.append(joint.name)
        else:
            lower_rad, upper_rad = limits_rad
            values_by_joint[joint.name] = {"angle_min_rad": lower_rad, "angle_max_rad": upper_rad}
            print_line(f"{joint.name:<10} {lower_rad:+.3f} to {upper_rad:+.3f} rad")
    _write_joint_values(path, values_by_joint, "end to end by hand")
    return _report_unknown_joints(unknown_joints, f"snakesim robot calibrate limits {path}")


def _record_travel(robot: HandMovedRobot) -> TravelRange | None:
    """Record and display the range of each joint's angle until Enter is pressed; return None if no angle arrived."""
    travel: TravelRange | None = None
    drawn_line_count = 0
    next_drawing_s = 0.0
    for angles_rad in robot.read_angles_rad(is_enter_pressed):
        if travel is None:
            travel = TravelRange(angles_rad)
        travel.add_sample(angles_rad)
        if sys.stdout.isatty() and time.monotonic() >= next_drawing_s:
            next_drawing_s = time.monotonic() + REDRAW_PERIOD_S
            drawn_line_count = overwrite_lines(
                _format_travel(robot.joints, travel, angles_rad), drawn_line_count
            )
    return travel


def _format_travel(joints: Sequence[Joint], travel: TravelRange, now_rad: Floats) -> list[str]:
    rows = zip(joints, travel.lower_rad, now_rad, travel.upper_rad, strict=True)
    return [
        f"{joint.name:<10} {lower:+7.3f}  now {now:+7.3f}  {upper:+7.3f} rad"
        for joint, lower, now, upper in rows
    ]


def select_joints(joints: Sequence[Joint], names: Sequence[str], path: Path) -> Sequence[Joint]:
    """Return the joints with these names; all joints if there are no names. Raises ConfigError for an unknown name."""
    joint_by_name = {joint.name: joint for joint in joints}
    unknown = [name for name in names if name not in joint_by_name]
    if unknown:
        raise ConfigError(
            f"{path}: has no {', '.join(unknown)}; it has {joints[0].name} to {joints[-1].name}",
            code="config/unknown-name",
        )
    if not names:
        return joints
    return [joint_by_name[name] for name in names]


def is_enter_pressed() -> bool:
    """Return whether the person has pressed Enter. Raises RefusedError if the terminal is gone."""
    return read_typed_line() is not None


def read_typed_line() -> str | None:
    """Return the next line that the person has typed, without spaces around it; None if there is none yet.

    Raises:
        RefusedError: The terminal is gone.
    """
    if not select.select([sys.stdin], [], [], 0.0)[0]:
        return None
    line = sys.stdin.readline()
    if not line:
        raise RefusedError(
            "the terminal is gone; nothing was written", code="commissioning/not-possible"
        )
    return line.strip()


def _write_joint_values(path: Path, values: dict[str, dict[str, Any]], origin: str) -> None:
    """Write fields of joints into the robot file, and print how many joints changed.

    Args:
        path: Path of the robot file.
        values: New value by field name, by joint name.
        origin: How the values were found, for the comment next to each.
    """
    if not values:
        print_line(f"{path}: nothing to change")
        return
    write_joint_fields(path, values, origin)
    print_line(f"{path}: {len(values)} joints changed; restart the host with it")
