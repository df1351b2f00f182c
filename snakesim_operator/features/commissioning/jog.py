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
from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    call_on_stop_signals,
    get_user_name,
    set_realtime_priority,
)
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.commanding import CommandingClient
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    JointDescription,
    JointMode,
    JointState,
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
    make_arm_request,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_single_robot
from snakesim_operator.features.commissioning.by_hand import load_running_joints, select_joints
from snakesim_operator.features.commissioning.unknown_angles import UnknownAngleTimeout
from snakesim_operator.robot_commands.command import request_while_commanding
from snakesim_operator.robot_commands.teleop.keyboard import KeyReader

KEY_HOLD_S = 0.15  # a key repeats 20 to 30 times a second
# Of the target before the measured angle; a blocked joint must not jump once it is free.
MAX_LEAD_RAD = 0.1
READY_TIMEOUT_S = 10.0
DIRECTION_BY_KEY = {"up": 1, "right": 1, "+": 1, "down": -1, "left": -1, "-": -1}
STALE_KEY = ""  # stands for a key that may have waited in a stalled terminal: it stops the joint
KEY_HELP = "hold up or +: forwards   hold down or -: backwards   any other key: let it go   q: quit"


@dataclass(frozen=True, kw_only=True)
class JogRequest:
    """Which joint to move, and the bounds of its motion."""

    joint: str
    speed_rad_s: float = 0.1
    travel_rad: float = 0.2  # to either side of its angle at the start
    torque_fraction: float = 0.3  # fraction of its limit

    def __post_init__(self) -> None:
        """Check the bounds. Raises ConfigError."""
        _check_bound("--speed", self.speed_rad_s, 0.5, "rad/s")
        _check_bound("--travel", self.travel_rad, 3.2, "rad")
        _check_bound("--torque", self.torque_fraction, 1.0, "of its limit")


def _check_bound(option: str, value: float, maximum: float, unit: str) -> None:
    if not 0 < value <= maximum:
        raise ConfigError(
            f"{option} {value:g}: give more than 0, and at most {maximum:g} {unit}",
            code="command/invalid-option",
        )


class JogTarget:
    """Computes the target of the joint, tick by tick. Pure."""

    def __init__(self, request: JogRequest, joint: JointDescription, angle_rad: float) -> None:
        self._speed_rad_s = request.speed_rad_s
        self._direction = 0  # 1 forwards, -1 backwards, 0 no key is held
        self._remaining_hold_s = 0.0  # for which the last key still counts as held
        self.lower_rad = max(angle_rad - request.travel_rad, joint.angle_min_rad)
        self.upper_rad = min(angle_rad + request.travel_rad, joint.angle_max_rad)
        self.target_rad = angle_rad

    @property
    def is_moving(self) -> bool:
        """Whether a key counts as held."""
        return self._direction != 0

    def on_key(self, key: str) -> None:
        """Set the direction of motion from a key that was pressed or repeats; a key without a direction stops it."""
        self._direction = DIRECTION_BY_KEY.get(key, 0)
        self._remaining_hold_s = KEY_HOLD_S

    def advance(self, period_s: float, measured_rad: float) -> float:
        """Move the target on by one period, and return it.

        The target stays within `MAX_LEAD_RAD` of the measured angle, and within the limits.
        """
        self._remaining_hold_s -= period_s
        if self._remaining_hold_s <= 0:
            self._direction = 0
        if not self._direction:
            return self.target_rad
        target_rad = self.target_rad + self._direction * self._speed_rad_s * period_s
        target_rad = float(
            np.clip(target_rad, measured_rad - MAX_LEAD_RAD, measured_rad + MAX_LEAD_RAD)
        )
        self.target_rad = float(np.clip(target_rad, self.lower_rad, self.upper_rad))
        return self.target_rad


def jog_joint(path: Path, selection: RobotSelection, request: JogRequest) -> int:
    """Arm a robot and move one joint while a key is held, until the user types q or Ctrl-C or the terminal is gone.

    Args:
        path: Path of the robot file that the host was started with.
        selection: Selects the robot to connect to.
        request: The joint to move, and the bounds of its motion.

    Returns:
        The exit code, which is always 0.

    Raises:
        SnakesimError: The robot is not disarmed, does not answer or runs with another file, or stdin is no terminal.
    """
    keyboard = KeyReader("robot jog reads keys, and stdin is no terminal; start it in one")
    connection = find_single_robot(selection, "robot jog")
    set_realtime_priority(SERVICE_PRIORITY)  # where it is allowed: a late command ends the lease
    with open_session(connection, CONNECT_TIMEOUT_S) as session:
        joints = load_running_joints(session, path)
        (joint,) = select_joints(joints, [request.joint], path)
        robot = session.wait_for_latched(keys.DESCRIPTION, RobotDescription, CONNECT_TIMEOUT_S)
        status = session.wait_for_latched(keys.STATUS, RobotStatus, CONNECT_TIMEOUT_S)
        if robot is None or status is None:
            raise RefusedError(
                "the robot's host did not publish its description; see `snakesim status`",
                code="network/no-answer",
            )
        if status.lifecycle != "disarmed":
            raise RefusedError(
                f"the robot is {status.lifecycle}; it must be disarmed to jog: see `snakesim status`",
                code="robot/not-disarmed",
            )
        with keyboard:
            _JogSession(session, connection, robot, status, request, joints.index(joint)).run(
                keyboard
            )
    return 0


class _JogSession:
    """Arms a robot, commands one joint until the user quits, and disarms it."""

    def __init__(
        self,
        session: Session,
        connection: ConnectionSettings,
        robot: RobotDescription,
        status: RobotStatus,
        request: JogRequest,
        joint_index: int,
    ) -> None:
        """Prepare to jog one joint of a disarmed robot; `run` arms it.

        Args:
            session: Session on the robot's network.
            connection: Addresses and certificates with which the robot is reached.
            robot: Description of the robot.
            status: Status of the robot, which is disarmed.
            request: Bounds of the motion.
            joint_index: Index of the joint to move, from 0 at the tail.
        """
        # Connection.
        self._session = session
        self._connection = connection
        self._robot = robot
        self._status_reader = session.declare_latched_reader(keys.STATUS, RobotStatus)
        self._command_client = CommandingClient(session, robot, status.clock_mode)
        # Request.
        self._request = request
        self._joint_index = joint_index
        # State.
        self._status = status
        self._jog_target: JogTarget | None = None  # None: the robot is not armed yet
        self._unknown_angle_timeout = UnknownAngleTimeout()
        self._stop_requested = False

    def run(self, keyboard: KeyReader) -> None:
        """Arm the robot, move the joint by the keys until the user quits, and disarm the robot whatever happened."""
        call_on_stop_signals(self._request_stop)
        signal.signal(signal.SIGHUP, lambda *_: self._request_stop())
        self._run_cycles_until(self._is_ready_to_arm)
        arm_session_before = self._run_cycle().arm_session
        requester = f"{get_user_name()[:40]}, robot jog"
        # Unchecked is allowed, because jogging is how a user finds out how the joints are mounted.
        self._send_request(make_arm_request(self._robot, requester, unchecked=True), "armed")
        try:
            self._run_cycles_until(lambda: self._run_cycle().arm_session > arm_session_before)
            self._follow_keys(keyboard)
        finally:
            if self._run_cycle().lifecycle == "armed":
                disarm = LifecycleRequest(
                    action="disarm", requester=requester, host=self._robot.host
                )
                self._send_request(disarm, "disarmed")

    def _follow_keys(self, keyboard: KeyReader) -> None:
        """Move the joint by the keys until the user quits, and print the angle at which it stops.

        Args:
            keyboard: The terminal, which reports the keys that were pressed.

        Raises:
            RefusedError: The robot is not armed any more.
        """
        joint = self._robot.joints[self._joint_index]
        target = JogTarget(self._request, joint, self._wait_for_angle_rad())
        self._jog_target = target
        print_line(
            f"{joint.name}: from {target.lower_rad:+.3f} to {target.upper_rad:+.3f} rad, at {target.target_rad:+.3f}. "
            f"{KEY_HELP}"
        )
        was_moving = False
        while not self._stop_requested and not keyboard.is_gone:
            for key in keyboard.read_keys(0.0):
                if key == "q":
                    self._stop_requested = True
                target.on_key(STALE_KEY if keyboard.has_late_keys else key)
            clock = self._run_cycle()
            if clock.lifecycle != "armed":
                self._update_status()
                raise RefusedError(
                    f"the robot is {clock.lifecycle}: {self._status.reason}", code="robot/not-armed"
                )
            if was_moving and not target.is_moving:
                print_line(f"{joint.name}: {self._wait_for_angle_rad():+.3f} rad")
            was_moving = target.is_moving

    def _run_cycle(self) -> Clock:
        """Wait for the next tick, command the joint in it if this process holds the lease, and return the tick's clock.

        The joint gets a position target with a reduced torque limit; the other joints are passive. Without a target,
        all joints are passive.
        """
        clock = self._command_client.wait_for_tick()
        if self._command_client.holds_lease:
            joints = self._robot.joints
            modes = [JointMode.PASSIVE] * len(joints)
            targets = [0.0] * len(joints)
            target_rad = self._advance_target_rad()
            if target_rad is not None:
                modes[self._joint_index] = JointMode.POSITION
                targets[self._joint_index] = target_rad
            limits_nm = [self._request.torque_fraction * joint.torque_limit_nm for joint in joints]
            self._command_client.send_setpoints(RequestedSetpoints(modes, targets, limits_nm))
        return clock

    def _advance_target_rad(self) -> float | None:
        """Return the target of this tick.

        Before the user may move the joint, it is the measured angle, or None if that is unknown. Later, the target
        stays where it is while the angle is unknown.
        """
        angle_rad = self._read_angle_rad()
        if self._jog_target is None:
            return angle_rad
        if angle_rad is None:
            self._jog_target.on_key(STALE_KEY)
            return self._jog_target.target_rad
        return self._jog_target.advance(self._robot.period_ns * 1e-9, angle_rad)

    def _wait_for_angle_rad(self) -> float:
        """Run cycles until the angle of the joint is known, and return it. Raises RefusedError if it stays unknown."""
        while (angle_rad := self._read_angle_rad()) is None:
            self._run_cycle()
        return angle_rad

    def _read_angle_rad(self) -> float | None:
        """Return the angle of the joint; None while it is unknown. Raises RefusedError if it stays unknown."""
        joints = self._command_client.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not joints.valid[self._joint_index]:
            self._unknown_angle_timeout.check([self._request.joint])
            return None
        self._unknown_angle_timeout.check([])
        return joints.angle_rad[self._joint_index]

    def _update_status(self) -> None:
        for status in self._status_reader.drain():
            self._status = status

    def _is_ready_to_arm(self) -> bool:
        self._update_status()
        return self._status.ready_to_arm

    def _run_cycles_until(self, condition: Callable[[], bool]) -> None:
        """Run cycles until a condition holds. Raises RefusedError after a timeout, or if the user stops it."""
        deadline_s = time.monotonic() + READY_TIMEOUT_S
        while not condition():
            self._run_cycle()
            if time.monotonic() > deadline_s or self._stop_requested:
                raise RefusedError(f"not armed: {self._status.reason}", code="robot/not-armed")

    def _send_request(self, request: LifecycleRequest, outcome: str) -> None:
        """Send a lifecycle request, and run cycles until the host confirms its outcome, such as `armed`."""
        request_while_commanding(self._session, request, outcome, self._connection, self._run_cycle)

    def _request_stop(self) -> None:
        self._stop_requested = True
