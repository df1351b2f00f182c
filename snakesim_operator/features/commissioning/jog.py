"""`snakesim robot jog`: one joint moves slowly while a key is held; the other motors stay off.

A terminal reports that a key repeats, not that it was released: the joint moves on for `KEY_HOLD_S` after each repeat.
So a single key makes a small step, and a held key moves the joint on once it repeats. Keys that arrive late, as over a
network that stalled, stop the joint. If this process ends for any reason, the motion ends: the host's command lease
expires within 100 ms.
"""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_hal.base.errors import ConfigError, RefusedError
from snakesim_hal.base.process import SERVICE_PRIORITY, get_user_name, on_stop_signal, set_realtime_priority
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.commanding import CommandingClient
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Description,
    JointDescription,
    JointState,
    LifecycleRequest,
    Mode,
    Status,
    make_arm_request,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.features.commissioning.by_hand import choose_joints, running_joints
from snakesim_operator.robot_commands.command import request_while_driving
from snakesim_operator.robot_commands.teleop.keyboard import Keyboard

KEY_HOLD_S = 0.15  # a key repeats 20 to 30 times a second
MAX_LEAD_RAD = 0.1  # of the target before the measured angle; a blocked joint must not jump once it is free
READY_TIMEOUT_S = 10.0
DIRECTION_OF_KEY = {"up": 1, "right": 1, "+": 1, "down": -1, "left": -1, "-": -1}
NO_KEY = ""  # stands for a key that may have waited in a stalled terminal: it stops the joint
HELP = "hold up or +: forwards   hold down or -: backwards   any other key: let it go   q: quit"


@dataclass(frozen=True, kw_only=True)
class JogRequest:
    """Which joint to move, and the bounds of its motion."""

    joint: str
    speed_rad_s: float = 0.1
    travel_rad: float = 0.2  # to either side of its angle at the start
    torque: float = 0.3  # fraction of its limit

    def __post_init__(self) -> None:
        """Check the bounds. Raises ConfigError."""
        _check_bound("--speed", self.speed_rad_s, 0.5, "rad/s")
        _check_bound("--travel", self.travel_rad, 3.2, "rad")
        _check_bound("--torque", self.torque, 1.0, "of its limit")


def _check_bound(option: str, value: float, maximum: float, unit: str) -> None:
    if not 0 < value <= maximum:
        raise ConfigError(
            f"{option} {value:g}: give more than 0, and at most {maximum:g} {unit}", code="command/invalid-option"
        )


class JogTarget:
    """Computes the target of the joint, tick by tick. Pure."""

    def __init__(self, request: JogRequest, joint: JointDescription, angle_rad: float) -> None:
        self._speed_rad_s = request.speed_rad_s
        self._direction = 0  # 1 forwards, -1 backwards, 0 no key is held
        self._hold_left_s = 0.0  # for which the last key still counts as held
        self.lower_rad = max(angle_rad - request.travel_rad, joint.angle_min_rad)
        self.upper_rad = min(angle_rad + request.travel_rad, joint.angle_max_rad)
        self.target_rad = angle_rad

    @property
    def moves(self) -> bool:
        """Whether a key counts as held."""
        return self._direction != 0

    def on_key(self, key: str) -> None:
        """Take note of a key that was pressed or repeats. A key without a direction stops the joint."""
        self._direction = DIRECTION_OF_KEY.get(key, 0)
        self._hold_left_s = KEY_HOLD_S

    def advance(self, period_s: float, measured_rad: float) -> float:
        """Move the target on by one period, and return it.

        The target stays within `MAX_LEAD_RAD` of the measured angle, and within the limits.
        """
        self._hold_left_s -= period_s
        if self._hold_left_s <= 0:
            self._direction = 0
        if not self._direction:
            return self.target_rad
        target_rad = self.target_rad + self._direction * self._speed_rad_s * period_s
        target_rad = float(np.clip(target_rad, measured_rad - MAX_LEAD_RAD, measured_rad + MAX_LEAD_RAD))
        self.target_rad = float(np.clip(target_rad, self.lower_rad, self.upper_rad))
        return self.target_rad


def jog(path: Path, selection: RobotSelection, request: JogRequest) -> int:
    """Jog a joint until the user types q or Ctrl-C, or the terminal is gone. Return 0. Raises SnakesimError.

    Args:
        path: the robot file that the host was started with.
        selection: which robot to address.
        request: the joint and its bounds.
    """
    keyboard = Keyboard("robot jog reads keys, and stdin is no terminal; start it in one")
    link = only_robot(selection, "robot jog")
    set_realtime_priority(SERVICE_PRIORITY)  # where it is allowed: a late command ends the lease
    with open_session(link, CONNECT_S) as session:
        joints = running_joints(session, path)
        (joint,) = choose_joints(joints, [request.joint], path)
        robot = session.latest(keys.DESCRIPTION, Description, CONNECT_S)
        status = session.latest(keys.STATUS, Status, CONNECT_S)
        if robot is None or status is None:
            raise RefusedError(
                "the robot's host did not publish its description; see `snakesim status`", code="network/no-answer"
            )
        if status.lifecycle != "disarmed":
            raise RefusedError(
                f"the robot is {status.lifecycle}; it must be disarmed to jog: see `snakesim status`",
                code="robot/not-disarmed",
            )
        with keyboard:
            _JogSession(session, link, robot, status, request, joints.index(joint)).run(keyboard)
    return 0


class _JogSession:
    """Arms a robot, commands one joint until the user quits, and disarms it."""

    def __init__(
        self, session: Session, link: Link, robot: Description, status: Status, request: JogRequest, joint: int
    ) -> None:
        """Prepare to jog one joint of a disarmed robot; `run` arms it.

        Args:
            session: session on the robot's network.
            link: how to reach the robot.
            robot: description of the robot.
            status: its status, which is disarmed.
            request: the joint and its bounds.
            joint: index of the joint.
        """
        # Connection.
        self._session = session
        self._link = link
        self._robot = robot
        self._statuses = session.latched_reader(keys.STATUS, Status)
        self._commanding = CommandingClient(session, robot, status.clock_mode)
        # Request.
        self._request = request
        self._joint = joint
        # State.
        self._status = status
        self._jog_target: JogTarget | None = None  # None: the robot is not armed yet
        self._stop_requested = False

    def run(self, keyboard: Keyboard) -> None:
        """Arm the robot, follow the keys, and disarm it whatever happened."""
        on_stop_signal(self._request_stop)
        signal.signal(signal.SIGHUP, lambda *_: self._request_stop())
        self._cycle_until(self._is_ready_to_arm)
        arm_session_before = self._cycle().arm_session
        requester = f"{get_user_name()[:40]}, robot jog"
        # Unchecked is allowed, because jogging is how a user finds out how the joints are mounted.
        self._send_request(make_arm_request(self._robot, requester, unchecked=True), "armed")
        try:
            self._cycle_until(lambda: self._cycle().arm_session > arm_session_before)
            self._follow_keys(keyboard)
        finally:
            if self._cycle().lifecycle == "armed":
                disarm = LifecycleRequest(action="disarm", requester=requester, host=self._robot.host)
                self._send_request(disarm, "disarmed")

    def _follow_keys(self, keyboard: Keyboard) -> None:
        """Move the joint by the keys until the user quits. Raises RefusedError once the robot is not armed."""
        joint = self._robot.joints[self._joint]
        target = JogTarget(self._request, joint, self._read_angle_rad())
        self._jog_target = target
        print_line(
            f"{joint.name}: from {target.lower_rad:+.3f} to {target.upper_rad:+.3f} rad, at {target.target_rad:+.3f}. "
            f"{HELP}"
        )
        was_moving = False
        while not self._stop_requested and not keyboard.gone:
            for key in keyboard.keys(0.0):
                if key == "q":
                    self._stop_requested = True
                target.on_key(NO_KEY if keyboard.late else key)
            clock = self._cycle()
            if clock.lifecycle != "armed":
                self._read_status()
                raise RefusedError(f"the robot is {clock.lifecycle}: {self._status.reason}", code="robot/not-armed")
            if was_moving and not target.moves:
                print_line(f"{joint.name}: {self._read_angle_rad():+.3f} rad")
            was_moving = target.moves

    def _cycle(self) -> Clock:
        """Wait for the next tick and return it. If this process holds the lease, command the joint in it.

        The joint gets a position target with little torque; the other joints are passive.
        """
        clock = self._commanding.wait()
        if self._commanding.mine:
            joints = self._robot.joints
            modes = [Mode.PASSIVE] * len(joints)
            targets = [0.0] * len(joints)
            modes[self._joint] = Mode.POSITION
            targets[self._joint] = self._next_target_rad()
            limits_nm = [self._request.torque * joint.torque_limit_nm for joint in joints]
            self._commanding.send(RequestedSetpoints(modes, targets, limits_nm))
        return clock

    def _next_target_rad(self) -> float:
        """Return the target of this tick; the measured angle before the user may move the joint."""
        angle_rad = self._read_angle_rad()
        if self._jog_target is None:
            return angle_rad
        return self._jog_target.advance(self._robot.period_ns * 1e-9, angle_rad)

    def _read_angle_rad(self) -> float:
        joints = self._commanding.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not joints.valid[self._joint]:
            raise RefusedError(
                f"{self._request.joint}: the angle is not known; see `snakesim status`",
                code="commissioning/not-possible",
            )
        return joints.angle_rad[self._joint]

    def _read_status(self) -> None:
        for status in self._statuses.drain():
            self._status = status

    def _is_ready_to_arm(self) -> bool:
        self._read_status()
        return self._status.ready_to_arm

    def _cycle_until(self, condition: Callable[[], bool]) -> None:
        """Run cycles until a condition holds. Raises RefusedError after a timeout, or if the user stops it."""
        deadline_s = time.monotonic() + READY_TIMEOUT_S
        while not condition():
            self._cycle()
            if time.monotonic() > deadline_s or self._stop_requested:
                raise RefusedError(f"not armed: {self._status.reason}", code="robot/not-armed")

    def _send_request(self, request: LifecycleRequest, outcome: str) -> None:
        """Send a lifecycle request, and run cycles until it is answered. outcome: such as `armed`."""
        request_while_driving(self._session, request, outcome, self._link, self._cycle)

    def _request_stop(self) -> None:
        self._stop_requested = True
