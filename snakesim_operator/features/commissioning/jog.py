"""`snakesim joints jog`: one joint moves slowly while a key is held; the others stay without current.

A terminal says nothing of a key that is let go, only that it repeats no more: the joint goes on for `HELD_S` after
each sign of the key. So at first it makes a small step, and moves on once the key repeats. Keys that have waited, as
behind a network that stalled, let it go. Whatever ends this process ends the motion: the host's lease runs out within
100 ms.
"""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_hal.base.errors import ConfigError, RefusedError
from snakesim_hal.base.process import SERVICE_PRIORITY, on_stop_signal, set_realtime_priority, user_name
from snakesim_hal.base.terminal import say
from snakesim_hal.network.commanding import Commanding
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
    request_to_arm,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.features.commissioning.by_hand import chosen, running_joints
from snakesim_operator.robot_commands.command import ask_meanwhile
from snakesim_operator.robot_commands.teleop.keyboard import Keyboard

HELD_S = 0.15  # a key repeats 20 to 30 times a second
AHEAD_RAD = 0.1  # of the measured angle: a joint that is held winds nothing up
READY_S = 10.0
STEPS = {"up": 1, "right": 1, "+": 1, "down": -1, "left": -1, "-": -1}
LET_GO = ""  # no key: a key that may have waited in a stalled terminal moves nothing, and lets the joint go
HELP = "hold up or +: forwards   hold down or -: backwards   any other key: let it go   q: quit"


@dataclass(frozen=True, kw_only=True)
class JogRequest:
    """Which joint, and how much of it."""

    joint: str
    speed_rad_s: float = 0.1
    travel_rad: float = 0.2  # to either side of where it was
    torque: float = 0.3  # share of its limit

    def __post_init__(self) -> None:
        """Raises ConfigError."""
        for flag, value, most, unit in (
            ("--speed", self.speed_rad_s, 0.5, "rad/s"),
            ("--travel", self.travel_rad, 3.2, "rad"),
            ("--torque", self.torque, 1.0, "of its limit"),
        ):
            if not 0 < value <= most:
                raise ConfigError(f"{flag} {value:g}: give more than 0, and at most {most:g} {unit}")


class Jog:
    """Where the joint is to be, tick by tick. Pure."""

    def __init__(self, request: JogRequest, joint: JointDescription, at_rad: float) -> None:
        self._request = request
        self.lower_rad = max(at_rad - request.travel_rad, joint.angle_min_rad)
        self.upper_rad = min(at_rad + request.travel_rad, joint.angle_max_rad)
        self.target_rad = at_rad
        self._way, self._left_s = 0, 0.0

    @property
    def moves(self) -> bool:
        """Whether the key counts as held."""
        return self._way != 0

    def key(self, key: str) -> None:
        """A key was pressed, or repeats."""
        self._way, self._left_s = STEPS.get(key, 0), HELD_S

    def after(self, period_s: float, measured_rad: float) -> float:
        """The target after a period."""
        self._left_s -= period_s
        if self._left_s <= 0:
            self._way = 0
        if not self._way:
            return self.target_rad
        target_rad = self.target_rad + self._way * self._request.speed_rad_s * period_s
        target_rad = float(np.clip(target_rad, measured_rad - AHEAD_RAD, measured_rad + AHEAD_RAD))
        self.target_rad = float(np.clip(target_rad, self.lower_rad, self.upper_rad))
        return self.target_rad


def jog(path: Path, where: RobotSelection, request: JogRequest) -> int:
    """Until q, Ctrl-C, or the terminal is gone. Returns 0. Raises SnakesimError."""
    keyboard = Keyboard("joints jog reads keys, and stdin is no terminal; start it in one")
    link = only_robot(where, "joints jog")
    set_realtime_priority(SERVICE_PRIORITY)  # where it is allowed: a command that is late ends the lease
    with open_session(link, CONNECT_S) as session:
        joints = running_joints(session, path)
        (joint,) = chosen(joints, [request.joint], path)
        robot = session.latest(keys.DESCRIPTION, Description, CONNECT_S)
        status = session.latest(keys.STATUS, Status, CONNECT_S)
        if robot is None or status is None:
            raise RefusedError("the robot's host has not said what it is; see `snakesim status`")
        if status.lifecycle != "disarmed":
            raise RefusedError(f"the robot is {status.lifecycle}; it must be disarmed to jog: see `snakesim status`")
        with keyboard:
            _Jogging(session, link, robot, status, request, joints.index(joint)).go(keyboard)
    return 0


class _Jogging:
    """One connection, one joint."""

    def __init__(
        self, session: Session, link: Link, robot: Description, status: Status, request: JogRequest, joint: int
    ) -> None:
        self._session, self._link, self._robot, self._joint = session, link, robot, joint
        self._request, self._status, self._over = request, status, False
        self._statuses = session.latched_reader(keys.STATUS, Status)
        self._commanding = Commanding(session, robot, status.clock_mode)
        self._jog: Jog | None = None

    def go(self, keyboard: Keyboard) -> None:
        """Armed from here to the end."""
        on_stop_signal(self._end)
        signal.signal(signal.SIGHUP, lambda *_: self._end())
        self._until(self._ready)
        before, who = self._turn().arm_session, f"{user_name()[:40]}, joints jog"
        # Checked or not: to find out how it is mounted is what this is for.
        self._ask(request_to_arm(self._robot, who, unchecked=True), "armed")
        try:
            self._until(lambda: self._turn().arm_session > before)
            self._follow(keyboard)
        finally:
            if self._turn().lifecycle == "armed":
                self._ask(LifecycleRequest(action="disarm", who=who, host=self._robot.host), "disarmed")

    def _follow(self, keyboard: Keyboard) -> None:
        joint = self._robot.joints[self._joint]
        jog, moved = Jog(self._request, joint, self._angle_rad()), False
        self._jog = jog
        say(f"{joint.name}: from {jog.lower_rad:+.3f} to {jog.upper_rad:+.3f} rad, at {jog.target_rad:+.3f}. {HELP}")
        while not self._over and not keyboard.gone:
            for key in keyboard.keys(0.0):
                self._over |= key == "q"
                jog.key(key if not keyboard.late else LET_GO)
            if (now := self._turn()).lifecycle != "armed":
                self._ready()
                raise RefusedError(f"the robot is {now.lifecycle}: {self._status.why}")
            if moved and not jog.moves:
                say(f"{joint.name}: {self._angle_rad():+.3f} rad")
            moved = jog.moves

    def _turn(self) -> Clock:
        """A tick: the joint goes where it is to be, with little torque; the others are without current."""
        clock, joints = self._commanding.wait(), self._robot.joints
        if self._commanding.mine:
            at_rad, period_s = self._angle_rad(), self._robot.period_ns * 1e-9
            modes, targets = [Mode.PASSIVE] * len(joints), [0.0] * len(joints)
            modes[self._joint] = Mode.POSITION
            targets[self._joint] = at_rad if self._jog is None else self._jog.after(period_s, at_rad)
            limits_nm = [self._request.torque * joint.torque_limit_nm for joint in joints]
            self._commanding.send(RequestedSetpoints(modes, targets, limits_nm))
        return clock

    def _angle_rad(self) -> float:
        joints = self._commanding.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not joints.valid[self._joint]:
            raise RefusedError(f"{self._request.joint}: the angle is not known; see `snakesim status`")
        return joints.angle_rad[self._joint]

    def _ready(self) -> bool:
        for status in self._statuses.drain():
            self._status = status
        return self._status.ready_to_arm

    def _until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + READY_S
        while not condition():
            self._turn()
            if time.monotonic() > deadline or self._over:
                raise RefusedError(f"not armed: {self._status.why}")

    def _ask(self, request: LifecycleRequest, done: str) -> None:
        ask_meanwhile(self._session, request, done, self._link, self._turn)

    def _end(self) -> None:
        self._over = True
