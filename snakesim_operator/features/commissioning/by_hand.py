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
from snakesim_hal.model.joints import Drive, Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Configuration, JointState, Status
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.features.commissioning.capture import HandTurn, NotStillError, Travel, TurnDetector, find_zeros
from snakesim_operator.features.commissioning.judge import MAX_RATIO_ERROR
from snakesim_operator.features.commissioning.robot_edit import change_joints, joints_on_drives, must_be_own

ZERO_SAMPLING_S = 1.0  # samples for a zero are taken for that long
MAX_SILENCE_S = 1.0  # without joint angles
HOST_TIMEOUT_S = 3.0  # for configuration and status of a running host
REDRAW_PERIOD_S = 0.2
DIRECTIONS = {"yaw": "to the left", "pitch": "downwards"}  # of what is ahead of the joint, seen towards the head
NO_ANSWER = f"the robot's host did not publish its configuration within {HOST_TIMEOUT_S:g} s; see `snakesim status`"


def running_joints(session: Session, path: Path) -> Sequence[Joint]:
    """Return the joints of the robot file that a host runs with, after a check that it is this file.

    Args:
        session: session on the robot's network.
        path: the robot file.

    Raises:
        ConfigError: the host runs with another file.
        RefusedError: the host does not answer.
    """
    configuration = session.latest(keys.CONFIG, Configuration, HOST_TIMEOUT_S)
    if configuration is None:
        raise RefusedError(NO_ANSWER, code="network/no-answer")
    running = msgspec.json.decode(configuration.content, type=RunConfig).robot.joint_table
    joints = joints_on_drives(path, running)
    if [_identity(joint) for joint in running] != [_identity(joint) for joint in joints]:
        raise ConfigError(
            f"{path}: its joints are not those that the host was started with, so measured angles would be "
            f"computed wrongly; restart the host with this file",
            code="commissioning/not-possible",
        )
    return joints


def _identity(joint: Joint) -> tuple[str, int, Drive]:
    return joint.name, joint.id, joint.drive


class HandMovedRobot:
    """A connection to a disarmed robot that a person moves by hand."""

    def __init__(self, session: Session, path: Path) -> None:
        """Connect to the robot's host.

        Raises:
            ConfigError: the host does not run with this robot file.
            RefusedError: the host does not answer.
        """
        self._joint_states = session.reader(keys.JOINTS, JointState)
        self._statuses = session.latched_reader(keys.STATUS, Status)
        self.joints = running_joints(session, path)
        status = session.latest(keys.STATUS, Status, HOST_TIMEOUT_S)
        if status is None:
            raise RefusedError(NO_ANSWER, code="network/no-answer")
        self._status = status

    def read_angles_rad(self, is_over: Callable[[], bool]) -> Iterator[Floats]:
        """Yield joint angles as they arrive, until a condition holds. Raises as `read_samples`."""
        for _, angle_rad in self.read_samples(is_over):
            yield angle_rad

    def read_samples(self, is_over: Callable[[], bool]) -> Iterator[tuple[float, Floats]]:
        """Yield time in seconds by the robot's clock and joint angles, as they arrive, until a condition holds.

        Args:
            is_over: returns whether to end.

        Yields:
            Robot time in s, and (n_joints,) angles in rad.

        Raises:
            RefusedError: the robot is armed, sends no angles, or does not know one.
        """
        last_arrival_s = time.monotonic()
        over = False
        while not over:
            over = is_over()  # samples that arrived before that still count
            self._refuse_if_armed()
            states = [state for state in self._joint_states.drain() if state.has_joint_count(len(self.joints))]
            if states:
                last_arrival_s = time.monotonic()
            elif time.monotonic() - last_arrival_s > MAX_SILENCE_S:
                raise RefusedError(
                    f"the robot has sent no joint angles for {MAX_SILENCE_S:g} s; see `snakesim status`",
                    code="network/no-answer",
                )
            for state in states:
                self._refuse_unknown_angles(state)
                yield state.timestamp_ns * 1e-9, np.array(state.angle_rad)
            time.sleep(0.01)

    def _refuse_if_armed(self) -> None:
        for status in self._statuses.drain():
            self._status = status
        match self._status.lifecycle:
            case "disarmed" | "fault" | "estop":
                return
            case _:
                raise RefusedError(
                    "the robot is armed: its motors hold the joints; type `snakesim robot disarm` first",
                    code="robot/not-disarmed",
                )

    def _refuse_unknown_angles(self, state: JointState) -> None:
        unknown = [joint.name for joint, valid in zip(self.joints, state.valid, strict=True) if not valid]
        if unknown:
            raise RefusedError(
                f"{', '.join(unknown)}: the angle is not known; see `snakesim status`",
                code="commissioning/not-possible",
            )


@contextmanager
def _connect(path: Path, selection: RobotSelection, command: str) -> Iterator[HandMovedRobot]:
    """Connect to the selected robot. Raises SnakesimError. command: for messages, such as `robot calibrate zero`."""
    must_be_own(path)
    with open_session(only_robot(selection, command), CONNECT_S) as session:
        yield HandMovedRobot(session, path)


def zero(path: Path, selection: RobotSelection, *, wait_for_enter: bool) -> int:
    """Write the present pose as the straight pose into a robot file.

    Args:
        path: The robot file.
        selection: Which robot to address.
        wait_for_enter: Whether to ask the person to lay the robot straight, and wait for Enter.

    Returns:
        0, the exit code.

    Raises:
        RefusedError: The robot moves, is armed or does not answer.
        ConfigError: The robot file cannot be used.
    """
    with _connect(path, selection, "robot calibrate zero") as robot:
        if wait_for_enter:
            print_line("Lay the robot straight on a flat floor, take your hands off it, then press Enter.")
            list(robot.read_angles_rad(_line_was_typed))
        start_s = time.monotonic()
        samples = list(robot.read_angles_rad(lambda: time.monotonic() - start_s > ZERO_SAMPLING_S))
        try:
            zeros_rad = find_zeros(robot.joints, np.array(samples))
        except NotStillError as error:
            raise RefusedError(
                f"{error} within {ZERO_SAMPLING_S:g} s; take your hands off the robot, and try again",
                code="commissioning/not-possible",
            ) from None
    values: dict[str, dict[str, Any]] = {}
    for joint, zero_rad in zip(robot.joints, zeros_rad, strict=True):
        print_line(f"{joint.name:<10} zero_rad {joint.drive.zero_rad:+8.4f} -> {zero_rad:+8.4f}")
        values[joint.name] = {"zero_rad": zero_rad}
        if joint.limits.cable_turns is not None:
            values[joint.name]["cable_unwound"] = datetime.now(UTC).isoformat(timespec="seconds")
            print_line(f"{joint.name:<10} its cable counts as unwound here: restart the host within an hour")
    _write_values(path, values, "straight pose")
    return 0


def direction(path: Path, selection: RobotSelection, names: Sequence[str]) -> int:
    """Ask the person to turn each joint in its positive direction, and correct the signs in the file.

    A drive that measures a negative turn then has the wrong sign. The signs are written into the robot file at the end.

    Args:
        path: robot file.
        selection: which robot to address.
        names: names of the joints; empty: all joints.

    Returns:
        The exit code: 0; 1 if the sign of a joint is still unknown, because it was skipped or another joint turned.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used, or has no joint of such a name.
    """
    values: dict[str, dict[str, Any]] = {}
    unknown: list[str] = []
    with _connect(path, selection, "robot calibrate direction") as robot:
        for joint in choose_joints(robot.joints, names, path):
            instruction = f"turn what is ahead of it {DIRECTIONS[joint.axis]}, 10 degrees or more, and hold it still"
            turn = _wait_for_turn(robot, joint, instruction)
            if turn is None:
                unknown.append(joint.name)
            elif turn.by_rad > 0:  # a turn as in DIRECTIONS is positive if the sign in the file is right
                print_line(f"  {turn.by_rad:+.2f} rad: matches the file")
            else:
                print_line(f"  {turn.by_rad:+.2f} rad: mounted the other way round")
                values[joint.name] = {"sign": -joint.drive.sign}
    _write_values(path, values, "turned by hand")
    return _report_unknown(unknown, f"snakesim robot calibrate direction {path}")


def gear(path: Path, selection: RobotSelection, names: Sequence[str], degrees: float) -> int:
    """Ask the person to turn each joint by an angle, and compare the gear of its drive with what the drive measures.

    The robot file is not changed: the person writes the gear ratio of the data sheet into it.

    Args:
        path: robot file.
        selection: which robot to address.
        names: names of the joints; empty: all joints.
        degrees: the angle, in either direction.

    Returns:
        The exit code: 0; 1 if a gear does not match the file, or is unknown because its joint was skipped.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used, or has no joint of such a name.
    """
    unknown: list[str] = []
    wrong: list[str] = []
    with _connect(path, selection, "robot calibrate gear") as robot:
        for joint in choose_joints(robot.joints, names, path):
            instruction = f"turn what is ahead of it {DIRECTIONS[joint.axis]} by {degrees:g} degrees, and hold it still"
            turn = _wait_for_turn(robot, joint, instruction)
            if turn is None:
                unknown.append(joint.name)
                continue
            measured_rad = abs(turn.by_rad)
            measured_per_turned = measured_rad / math.radians(degrees)  # 1 if the gear in the file is right
            measured = f"  {math.degrees(measured_rad):.0f} of {degrees:g} degrees"
            if abs(measured_per_turned - 1) < MAX_RATIO_ERROR:
                print_line(f"{measured}: matches the file")
            else:
                gear_ratio = joint.drive.gear * measured_per_turned
                print_line(f"{measured}: gear = {gear_ratio:.3g} or so; write that of its data sheet into the file")
                wrong.append(joint.name)
    if wrong:
        print_line(f"wrong: {', '.join(wrong)}; correct the gear in {path}, and restart the host with it")
    exit_code_of_unknown = _report_unknown(unknown, f"snakesim robot calibrate gear {path}")
    return 1 if wrong else exit_code_of_unknown


def _wait_for_turn(robot: HandMovedRobot, joint: Joint, instruction: str) -> HandTurn | None:
    """Ask the person to turn a joint, and wait until the robot rests after it.

    Args:
        robot: Connection to the robot.
        joint: The joint to turn.
        instruction: How to turn it, in words.

    Returns:
        The turn; None, after printing the reason, if the joint was skipped or another joint turned.
    """
    detector = TurnDetector()
    instruction_printed = False
    turn: HandTurn | None = None
    for time_s, angle_rad in robot.read_samples(_line_was_typed):
        turn = detector.add_sample(time_s, angle_rad)
        if turn is not None:
            break
        if detector.ready and not instruction_printed:
            print_line(f"{joint.name}: {instruction}; Enter skips it")
            instruction_printed = True
    if turn is None:
        print_line("  skipped")
        return None
    turned_joint = robot.joints[turn.joint]
    if turned_joint is not joint:
        print_line(
            f"  {turned_joint.name} reports the turn: look at the ids and the wiring of {joint.name} and "
            f"{turned_joint.name}"
        )
        return None
    if not turn.alone:
        print_line("  other joints turned, too: hold them, and repeat this one")
        return None
    return turn


def _report_unknown(names: Sequence[str], command: str) -> int:
    """Print which joints are still unknown, and the command that repeats them. Return the exit code."""
    if not names:
        return 0
    print_line(f"still unknown: {', '.join(names)}; type `{command} {' '.join(names)}`")
    return 1


def limits(path: Path, selection: RobotSelection, names: Sequence[str]) -> int:
    """Watch how far the person moves each joint, until Enter, and write that as its limits into the robot file.

    Args:
        path: robot file.
        selection: which robot to address.
        names: names of the joints; empty: all joints.

    Returns:
        The exit code: 0; 1 if one of the joints was not moved from end to end, and keeps its limits.

    Raises:
        RefusedError: The robot is armed or does not answer.
        ConfigError: The robot file cannot be used, or has no joint of such a name.
    """
    with _connect(path, selection, "robot calibrate limits") as robot:
        watched = choose_joints(robot.joints, names, path)
        print_line("Move each joint by hand from end to end, slowly; then press Enter.")
        travel = _watch_travel(robot)
    values: dict[str, dict[str, Any]] = {}
    unknown: list[str] = []
    for i, joint in enumerate(robot.joints):
        if joint not in watched:
            continue
        limits_rad = None
        if travel is not None:
            limits_rad = travel.limits_rad(i)
        if limits_rad is None:
            print_line(f"{joint.name:<10} was not moved from end to end: left as it is")
            unknown.append(joint.name)
        else:
            lower, upper = limits_rad
            values[joint.name] = {"angle_min_rad": lower, "angle_max_rad": upper}
            print_line(f"{joint.name:<10} {lower:+.3f} to {upper:+.3f} rad")
    _write_values(path, values, "end to end by hand")
    return _report_unknown(unknown, f"snakesim robot calibrate limits {path}")


def _watch_travel(robot: HandMovedRobot) -> Travel | None:
    """Return the range of each joint until Enter, drawn meanwhile; None if no angle arrived."""
    travel: Travel | None = None
    drawn_lines = 0
    next_drawing_s = 0.0
    for angles_rad in robot.read_angles_rad(_line_was_typed):
        if travel is None:
            travel = Travel(angles_rad)
        travel.add_sample(angles_rad)
        if sys.stdout.isatty() and time.monotonic() >= next_drawing_s:
            next_drawing_s = time.monotonic() + REDRAW_PERIOD_S
            drawn_lines = overwrite_lines(_travel_lines(robot.joints, travel, angles_rad), drawn_lines)
    return travel


def _travel_lines(joints: Sequence[Joint], travel: Travel, now_rad: Floats) -> list[str]:
    rows = zip(joints, travel.lower_rad, now_rad, travel.upper_rad, strict=True)
    return [f"{joint.name:<10} {lower:+7.3f}  now {now:+7.3f}  {upper:+7.3f} rad" for joint, lower, now, upper in rows]


def choose_joints(joints: Sequence[Joint], names: Sequence[str], path: Path) -> Sequence[Joint]:
    """Return the joints of these names; all joints if there are no names. Raises ConfigError for an unknown name."""
    known = {joint.name: joint for joint in joints}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(
            f"{path}: has no {', '.join(unknown)}; it has {joints[0].name} to {joints[-1].name}",
            code="config/unknown-name",
        )
    if not names:
        return joints
    return [known[name] for name in names]


def _line_was_typed() -> bool:
    """Return whether the person has pressed Enter. Raises RefusedError if the terminal is gone."""
    if not select.select([sys.stdin], [], [], 0.0)[0]:
        return False
    if not sys.stdin.readline():
        raise RefusedError("the terminal is gone; nothing was written", code="commissioning/not-possible")
    return True


def _write_values(path: Path, values: dict[str, dict[str, Any]], origin: str) -> None:
    """Write fields of joints into the robot file. origin: how they were found, for a comment beside each."""
    if not values:
        print_line(f"{path}: nothing to change")
        return
    change_joints(path, values, origin)
    print_line(f"{path}: {len(values)} joints changed; restart the host with it")
