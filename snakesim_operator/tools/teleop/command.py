"""`snakesim teleop`: the loop that reads keys and stick, sends intents, and shows the robot's state."""

import contextlib
import math
import os
import signal
import sys
import threading
import time
from pathlib import Path

from snakesim_hal.errors import ConfigError
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_of
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.process import on_stop_signal, user_name
from snakesim_hal.terminal import overwrite_lines, say
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, ControlState, Intent, Status, World
from snakesim_operator.tools.stop import estop
from snakesim_operator.tools.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.tools.teleop.joystick import Joystick, open_joystick
from snakesim_operator.tools.teleop.keyboard import Keyboard
from snakesim_operator.tools.teleop.steering import HEADING_STEP_RAD, TURN_RAD_S, Steering

PERIOD_S = 0.05
SHOWN_EVERY = 4  # periods
KEY_AGE_S = 15.0  # after this long without a key, nobody may be at the keyboard
SILENT_S = 1.0  # without a clock
HELP = "up, down: speed   left, right: direction   s: stop   SPACE: EMERGENCY STOP   q: quit"


def teleop(where: RobotSelection, fastest_m_s: float, joystick: Path | None) -> int:
    """Until q, Ctrl-C, or the terminal or the joystick is gone. Returns 1 for the latter. Raises SnakesimError.

    joystick: its device, or an empty path for the first one; None: keys alone.
    """
    if not 0 < fastest_m_s <= 10:
        raise ConfigError(f"--fastest {fastest_m_s:g}: give a speed above 0, and at most 10 m/s")
    with contextlib.ExitStack() as opened:
        stick = None if joystick is None else open_joystick(None if joystick == Path() else joystick)
        if stick is not None:
            opened.callback(stick.close)
        keyboard = Keyboard() if stick is None or sys.stdin.isatty() else None
        link = only_robot(where, "teleop")
        session = opened.enter_context(open_session(link, CONNECT_S))
        if keyboard is not None:
            opened.enter_context(keyboard)
        return Teleop(session, link, fastest_m_s, keyboard, stick).go()


class Teleop:
    """One operator, one robot."""

    def __init__(
        self, session: Session, link: Link, fastest_m_s: float, keyboard: Keyboard | None, stick: Joystick | None
    ) -> None:
        self._link, self._keyboard, self._stick = link, keyboard, stick
        self._me = f"{user_name()[:40]}, teleop {os.getpid()}"  # two may steer
        self._steering = Steering(self._me, fastest_m_s)
        self._intents = session.publisher(keys.INTENT, Intent)
        self._clocks = session.reader(keys.CLOCK, Clock)
        self._worlds = session.reader(keys.WORLD, World)
        self._states = session.reader(keys.CONTROL_STATE, ControlState)
        self._statuses = session.latched_reader(keys.STATUS, Status)
        self._others = session.reader(keys.INTENT, Intent)
        self._clock: Clock | None = None
        self._clock_s = time.monotonic()
        self._sent_ns = -1
        self._status: Status | None = None
        self._status_s = 0.0
        self._control: ControlState | None = None
        self._control_s = 0.0
        self._body_w_rad: float | None = None
        self._other = ""
        self._ending = ""  # why it ends
        self._stopping: list[str] = []  # what the emergency stop said
        self._stopped = False

    def go(self) -> int:
        """Returns 0 when the operator ended it."""
        on_stop_signal(lambda: self._end("interrupted"))
        signal.signal(signal.SIGHUP, lambda *_: self._end("the terminal was closed"))
        drawn = turn = 0
        while not self._ending:
            began = time.monotonic()
            self._read_operator()
            self._read_robot()
            if not self._ending:
                self._send()
            if turn % SHOWN_EVERY == 0 and sys.stdout.isatty():
                drawn = overwrite_lines(self._screen_lines(), drawn)
            turn += 1
            time.sleep(max(PERIOD_S - (time.monotonic() - began), 0.0))
        if self._steering.touched_s is not None and not self._stopped:  # sooner than by expiry
            self._steering.stop(time.monotonic())
            self._sent_ns = -1
            self._send()
        with contextlib.suppress(OSError):  # a terminal that is gone
            say(f"teleop ended: {self._ending}; nothing is asked of {self._link.namespace} any more")
        return 1 if self._lost() else 0

    def _lost(self) -> bool:
        return (self._keyboard is not None and self._keyboard.gone) or (self._stick is not None and self._stick.lost)

    def _end(self, why: str) -> None:
        self._ending = self._ending or why

    def _read_operator(self) -> None:
        now_s, steering = time.monotonic(), self._steering
        for key in self._keyboard.keys(0.0) if self._keyboard is not None else []:
            match key:
                case " ":
                    self._stop_at_once()
                case "q":
                    self._end("quit")
                case "s":
                    steering.stop(now_s)
                case "up" | "down" if self._stick is None:
                    steering.faster(1 if key == "up" else -1, now_s)
                case "left" | "right" if self._stick is None:
                    steering.turn(HEADING_STEP_RAD * (1 if key == "left" else -1), self._body_w_rad, now_s)
                case _:
                    pass
        if self._stick is not None:
            if self._stick.take(0.0):
                self._stop_at_once()
            if self._stick.forward or self._stick.right or steering.touched_s is not None:
                steering.push(self._stick.forward, now_s)
            if self._stick.right:
                steering.turn(-self._stick.right * TURN_RAD_S * PERIOD_S, self._body_w_rad, now_s)
        if self._lost():
            self._end(
                "the joystick is gone" if self._stick is not None and self._stick.lost else "the terminal is gone"
            )

    def _stop_at_once(self) -> None:
        """By all ways, beside this loop; and nothing is asked for any more."""
        if not self._stopped:
            self._stopped = True
            at = RobotSelection(self._link.endpoint, self._link.namespace, self._link.session)
            threading.Thread(target=estop, args=(at, self._stopping.append), name="estop").start()

    def _read_robot(self) -> None:
        if clocks := self._clocks.drain():
            self._clock, self._clock_s = clocks[-1], time.monotonic()
        if statuses := self._statuses.drain():
            self._status, self._status_s = statuses[-1], time.monotonic()
        if states := self._states.drain():
            self._control, self._control_s = states[-1], time.monotonic()
        for world in self._worlds.drain()[-1:]:
            self._body_w_rad = yaw_of(rotation_from_quaternion(world.base_orientation_wxyz))
        for intent in self._others.drain():
            if intent.who != self._me:
                self._other = intent.who

    def _send(self) -> None:
        """An intent for each new robot time, once the operator has asked for something, and while he is there."""
        clock = self._clock
        if self._stopped or self._steering.touched_s is None or clock is None or clock.stamp_ns == self._sent_ns:
            return
        if self._stick is None and time.monotonic() - self._steering.touched_s > KEY_AGE_S:
            self._steering.speed_m_s = 0.0
        self._sent_ns = clock.stamp_ns
        self._intents.put(self._steering.intent(clock.stamp_ns))

    def _screen_lines(self) -> list[str]:
        status, control, steering = self._status, self._control, self._steering
        robot = "no status yet" if status is None else f"{status.lifecycle}{_heard(self._status_s)}: {status.why}"
        backend = "" if status is None else f" ({status.backend})"
        said = "nothing heard" if control is None else f"{control.state}{_heard(self._control_s)}: {control.reason}"
        lines = [f"{self._link.namespace}{backend}: {robot}", f"control: {said}"]
        towards = "the mission's way" if steering.heading_w_rad is None else _degrees(steering.heading_w_rad)
        body = "unknown" if self._body_w_rad is None else _degrees(self._body_w_rad)
        asked = f"asked: {steering.speed_m_s:+.2f} m/s, {towards}; body: {body}"
        silent_s = time.monotonic() - self._clock_s
        if self._stopped:
            asked = f"EMERGENCY STOP: {'; '.join(self._stopping) or 'sent'}. Then: snakesim clear, snakesim arm"
        elif silent_s > SILENT_S:
            held_up = "" if status is None or _heard(self._status_s) else status.held_up
            asked = f"{held_up or f'the robot has given no clock for {silent_s:.0f} s'}: nothing can be asked for"
        elif steering.touched_s is None:
            asked = "nothing asked for yet: the mission goes on"
        elif self._stick is None and time.monotonic() - steering.touched_s > KEY_AGE_S:
            asked = f"no key for {KEY_AGE_S:.0f} s: stopped; press one to go on"
        return [*lines, asked, f"also steering: {self._other}" if self._other else "", HELP]


def _heard(at_s: float) -> str:
    """How old what was heard is, if it is old."""
    age_s = time.monotonic() - at_s
    return f" (heard {age_s:.0f} s ago)" if age_s > SILENT_S else ""


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):+.0f}°"
