"""`snakesim joints zero|direction|gear|limits`: what a person finds out by moving a robot by hand.

Nothing here commands a joint. The robot's host must run, and be disarmed all the time.
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
from snakesim_hal.base.terminal import overwrite_lines, say
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Configuration, JointState, Status
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.features.commissioning.capture import NotStillError, Travel, Turn, TurnWatch, zeros
from snakesim_operator.features.commissioning.judge import NEAR
from snakesim_operator.features.commissioning.robot_edit import change_joints, joints_on_drives, must_be_own

SETTLE_S = 1.0  # of samples for a zero
SILENT_S = 1.0
FOUND_S = 3.0  # for configuration and status of a host that is there
DRAWN_EVERY_S = 0.2
DIRECTIONS = {"yaw": "to the left", "pitch": "downwards"}  # of what is ahead of the joint, seen towards the head
UNHEARD = f"the robot's host has not said within {FOUND_S:g} s how it is set up; see `snakesim status`"


def running_joints(session: Session, path: Path) -> Sequence[Joint]:
    """The joints of a robot file with which a host runs. Raises ConfigError for another file, RefusedError."""
    configured = session.latest(keys.CONFIG, Configuration, FOUND_S)
    if configured is None:
        raise RefusedError(UNHEARD)
    running = msgspec.json.decode(configured.content, type=RunConfig).robot.joint_table
    joints = joints_on_drives(path, running)
    if [(one.name, one.id, one.drive) for one in running] != [(one.name, one.id, one.drive) for one in joints]:
        raise ConfigError(
            f"{path}: its joints are not those that the host was started with, so what is measured would be "
            f"reckoned wrongly; restart the host with this file"
        )
    return joints


class Hand:
    """A robot that is moved by hand, and its file."""

    def __init__(self, session: Session, path: Path) -> None:
        """Raises ConfigError when the host does not run with this file."""
        self._states = session.reader(keys.JOINTS, JointState)
        self._statuses = session.latched_reader(keys.STATUS, Status)
        self.joints = running_joints(session, path)
        status = session.latest(keys.STATUS, Status, FOUND_S)
        if status is None:
            raise RefusedError(UNHEARD)
        self._status = status

    def angles_rad(self, until: Callable[[], bool]) -> Iterator[Floats]:
        """Yield joint angles as they come; raises as `samples`."""
        for _, angle_rad in self.samples(until):
            yield angle_rad

    def samples(self, until: Callable[[], bool]) -> Iterator[tuple[float, Floats]]:
        """Yield time in seconds by the robot's clock and joint angles, as they come.

        Raises RefusedError when the robot is armed, silent, or does not know an angle.
        """
        heard_s = time.monotonic()
        over = False
        while not over:
            over = until()  # what came before that still counts
            for status in self._statuses.drain():
                self._status = status
            if self._status.lifecycle not in ("disarmed", "fault", "estop"):
                raise RefusedError("the robot is armed: its motors hold the joints; type `snakesim disarm` first")
            states = [state for state in self._states.drain() if state.is_of(len(self.joints))]
            if states:
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s > SILENT_S:
                raise RefusedError(f"the robot has sent no joint angles for {SILENT_S:g} s; see `snakesim status`")
            for state in states:
                if not all(state.valid):
                    unknown = ", ".join(
                        joint.name for joint, ok in zip(self.joints, state.valid, strict=True) if not ok
                    )
                    raise RefusedError(f"{unknown}: the angle is not known; see `snakesim status`")
                yield state.timestamp_ns * 1e-9, np.array(state.angle_rad)
            time.sleep(0.01)


def zero(path: Path, where: RobotSelection, *, asks: bool) -> int:
    """Take the present pose as straight. asks: wait for Enter first. Raises SnakesimError."""
    with _hand(path, where, "joints zero") as hand:
        if asks:
            say("Lay the robot straight on a flat floor, let go of it, then press Enter.")
            list(hand.angles_rad(_entered))
        began = time.monotonic()
        samples = np.array(list(hand.angles_rad(lambda: time.monotonic() - began > SETTLE_S)))
        try:
            found = zeros(hand.joints, samples)
        except NotStillError as error:
            raise RefusedError(f"{error} within {SETTLE_S:g} s; let go of the robot, and try again") from None
    values: dict[str, dict[str, Any]] = {}
    for joint, zero_rad in zip(hand.joints, found, strict=True):
        say(f"{joint.name:<10} zero_rad {joint.drive.zero_rad:+8.4f} -> {zero_rad:+8.4f}")
        values[joint.name] = {"zero_rad": zero_rad}
        if joint.limits.cable_turns is not None:
            values[joint.name]["cable_unwound"] = datetime.now(UTC).isoformat(timespec="seconds")
            say(f"{joint.name:<10} its cable counts as unwound here: restart the host within an hour")
    return _write(path, values, "straight pose")


def direction(path: Path, where: RobotSelection, names: Sequence[str]) -> int:
    """Ask for a turn of each joint, and set the sign of those that count it the other way round.

    names: joints; none: all. Returns 1 when a joint was skipped, or another one turned than the one that was asked for.
    """
    values: dict[str, dict[str, Any]] = {}
    unknown: list[str] = []
    with _hand(path, where, "joints direction") as hand:
        for joint in chosen(hand.joints, names, path):
            asked = f"turn what is ahead of it {DIRECTIONS[joint.axis]}, 10 degrees or more, and hold it still"
            turn = _turn_of(hand, joint, asked)
            if turn is None:
                unknown.append(joint.name)
            elif turn.by_rad > 0:
                say(f"  {turn.by_rad:+.2f} rad: as the file says")
            else:
                say(f"  {turn.by_rad:+.2f} rad: mounted the other way round")
                values[joint.name] = {"sign": -joint.drive.sign}
    _write(path, values, "turned by hand")
    return _unknown(unknown, f"snakesim joints direction {path}")


def gear(path: Path, where: RobotSelection, names: Sequence[str], degrees: float) -> int:
    """Ask for a turn of each joint by an angle, and compare it with what its drive measures. Nothing is written.

    names: joints; none: all. Returns 1 when a gear is not as the file says, or is unknown.
    """
    unknown: list[str] = []
    wrong: list[str] = []
    with _hand(path, where, "joints gear") as hand:
        for joint in chosen(hand.joints, names, path):
            asked = f"turn what is ahead of it {DIRECTIONS[joint.axis]} by {degrees:g} degrees, and hold it still"
            turn = _turn_of(hand, joint, asked)
            if turn is None:
                unknown.append(joint.name)
                continue
            ratio = abs(turn.by_rad) / math.radians(degrees)
            said = f"  {math.degrees(abs(turn.by_rad)):.0f} of {degrees:g} degrees"
            if abs(ratio - 1) < NEAR:
                say(f"{said}: as the file says")
            else:
                say(
                    f"{said}: gear = {joint.drive.gear * ratio:.3g} or so; write what its data sheet says into the file"
                )
                wrong.append(joint.name)
    if wrong:
        say(f"wrong: {', '.join(wrong)}; correct the gear in {path}, and restart the host with it")
    return max(_unknown(unknown, f"snakesim joints gear {path}"), 1 if wrong else 0)


def _turn_of(hand: Hand, joint: Joint, asked: str) -> Turn | None:
    """Ask for a turn of a joint, and wait until the robot rests after it.

    Returns None, and says why, when the joint was skipped, or another one turned.
    """
    watch = TurnWatch()
    asked_already = False
    turn: Turn | None = None
    for time_s, angle_rad in hand.samples(_entered):
        turn = watch.take(time_s, angle_rad)
        if turn is not None:
            break
        if watch.ready and not asked_already:
            say(f"{joint.name}: {asked}; Enter skips it")
            asked_already = True
    if turn is None:
        say("  skipped")
        return None
    turning = hand.joints[turn.joint]
    if turning is not joint:
        say(f"  {turning.name} reports the turn: look at the ids and the wiring of {joint.name} and {turning.name}")
        return None
    if not turn.alone:
        say("  other joints turned, too: hold them, and repeat this one")
        return None
    return turn


def _unknown(names: Sequence[str], command: str) -> int:
    """Say which joints are still unknown, and how to find out. Returns the exit code."""
    if not names:
        return 0
    say(f"still unknown: {', '.join(names)}; type `{command} {' '.join(names)}`")
    return 1


def limits(path: Path, where: RobotSelection, names: Sequence[str]) -> int:
    """Watch how far each joint is moved, until Enter, and write that as its limits.

    names: joints; none: all. Returns 1 when one of them was not moved from end to end.
    """
    with _hand(path, where, "joints limits") as hand:
        watched = chosen(hand.joints, names, path)
        say("Move each joint by hand from end to end, slowly; then press Enter.")
        travel: Travel | None = None
        drawn = 0
        due_s = 0.0
        for angles_rad in hand.angles_rad(_entered):
            travel = travel or Travel(angles_rad)
            travel.take(angles_rad)
            if sys.stdout.isatty() and time.monotonic() >= due_s:
                due_s = time.monotonic() + DRAWN_EVERY_S
                drawn = overwrite_lines(_shown(hand.joints, travel, angles_rad), drawn)
    values: dict[str, dict[str, Any]] = {}
    unknown: list[str] = []
    for i, joint in enumerate(hand.joints):
        if joint not in watched:
            continue
        found = None if travel is None else travel.limits(i)
        if found is None:
            say(f"{joint.name:<10} was not moved from end to end: left as it is")
            unknown.append(joint.name)
        else:
            values[joint.name] = {"angle_min_rad": found[0], "angle_max_rad": found[1]}
            say(f"{joint.name:<10} {found[0]:+.3f} to {found[1]:+.3f} rad")
    _write(path, values, "end to end by hand")
    return _unknown(unknown, f"snakesim joints limits {path}")


def _shown(joints: Sequence[Joint], travel: Travel, now_rad: Floats) -> list[str]:
    rows = zip(joints, travel.lower_rad, now_rad, travel.upper_rad, strict=True)
    return [f"{joint.name:<10} {least:+7.3f}  now {now:+7.3f}  {most:+7.3f} rad" for joint, least, now, most in rows]


@contextmanager
def _hand(path: Path, where: RobotSelection, command: str) -> Iterator[Hand]:
    must_be_own(path)
    with open_session(only_robot(where, command), CONNECT_S) as session:
        yield Hand(session, path)


def chosen(joints: Sequence[Joint], names: Sequence[str], path: Path) -> Sequence[Joint]:
    """Those of some names; all without any. Raises ConfigError."""
    known = {joint.name: joint for joint in joints}
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"{path}: has no {', '.join(unknown)}; it has {joints[0].name} to {joints[-1].name}")
    return [known[name] for name in names] or joints


def _entered() -> bool:
    """Whether a line has been typed."""
    if not select.select([sys.stdin], [], [], 0.0)[0]:
        return False
    if not sys.stdin.readline():
        raise RefusedError("the terminal is gone; nothing was written")
    return True


def _write(path: Path, values: dict[str, dict[str, Any]], how: str) -> int:
    if values:
        change_joints(path, values, how)
        say(f"{path}: {len(values)} joints changed; restart the host with it")
    else:
        say(f"{path}: nothing to change")
    return 0
