"""`snakesim teleop`: the loop that reads keys and stick, sends intents, and shows the robot's state."""

import contextlib
import math
import os
import signal
import sys
import time
from concurrent.futures import Future, wait
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import on_stop_signal, user_name
from snakesim_hal.base.terminal import overwrite_lines, say
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_of
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, ControlState, Intent, Status, World
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.robot_commands.prepared_stop import PreparedStop
from snakesim_operator.robot_commands.teleop.joystick import STICK_AGE_S, Joystick, open_joystick
from snakesim_operator.robot_commands.teleop.keyboard import Keyboard
from snakesim_operator.robot_commands.teleop.steering import HEADING_STEP_RAD, TURN_RAD_S, Steering

PERIOD_S = 0.05
SHOWN_EVERY = 4  # periods
KEY_AGE_S = 15.0  # after this long without a key, nobody may be at the keyboard
SILENT_S = 1.0  # without a clock
STOP_WAIT_S = 20.0  # at the end, for an emergency stop that is under way
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
        self._ignores_keys = False  # the newest keys came late
        # The emergency stop, whose means exist before it is needed.
        self._stop = PreparedStop(RobotSelection(link.endpoint, link.namespace, link.session), link)
        self._stop.connect(session)
        self._stopping: Future[str] | None = None

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
        if self._stopping is not None:  # its threads end with this process
            wait([self._stopping], STOP_WAIT_S)
            self._stop.close()
        elif self._steering.touched_s is not None:  # sooner than by expiry
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
        found = self._keyboard.keys(0.0) if self._keyboard is not None else []
        late = self._keyboard is not None and self._keyboard.late
        if found:
            self._ignores_keys = late
        for key in found:
            match key:
                case "up" | "down" | "left" | "right" if late:
                    pass
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
            self._read_stick(self._stick)
        if self._lost():
            self._end(
                "the joystick is gone" if self._stick is not None and self._stick.lost else "the terminal is gone"
            )

    def _read_stick(self, stick: Joystick) -> None:
        """Ask for what the stick asks for, from the time of its newest event on, unless that is too long ago."""
        if stick.take(0.0):
            self._stop_at_once()
        if stick.is_silent(time.monotonic()):
            return
        if stick.forward or stick.right or self._steering.touched_s is not None:
            self._steering.push(stick.forward, stick.moved_s)
        if stick.right:
            self._steering.turn(-stick.right * TURN_RAD_S * PERIOD_S, self._body_w_rad, stick.moved_s)

    def _is_left(self) -> bool:
        """Whether the operator has done nothing for so long that nobody may be there."""
        touched_s = self._steering.touched_s
        limit_s = KEY_AGE_S if self._stick is None else STICK_AGE_S
        return touched_s is not None and time.monotonic() - touched_s > limit_s

    def _stop_at_once(self) -> None:
        """Stop by all ways, beside this loop, again at each press; and nothing is asked for any more."""
        self._stopping = self._stop.request(self._me)

    def _stop_in_words(self) -> str:
        """What came of the newest emergency stop."""
        stopping = self._stopping
        if stopping is None or not stopping.done():
            return "sent"
        error = stopping.exception()
        return stopping.result() if error is None else f"NOT STOPPED, press SPACE again: {error}"

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
        nothing_asked = self._stopping is not None or self._steering.touched_s is None
        if nothing_asked or clock is None or clock.timestamp_ns == self._sent_ns:
            return
        if self._is_left():
            self._steering.speed_m_s = 0.0
        self._sent_ns = clock.timestamp_ns
        self._intents.put(self._steering.intent(clock.timestamp_ns))

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
        if self._stopping is not None:
            asked = f"EMERGENCY STOP: {self._stop_in_words()}. Then: snakesim clear, snakesim arm"
        elif silent_s > SILENT_S:
            held_up = "" if status is None or _heard(self._status_s) else status.held_up
            asked = f"{held_up or f'the robot has given no clock for {silent_s:.0f} s'}: nothing can be asked for"
        elif steering.touched_s is None:
            asked = "nothing asked for yet: the mission goes on"
        elif self._is_left() and self._stick is None:
            asked = f"no key for {KEY_AGE_S:.0f} s: stopped; press one to go on"
        elif self._is_left():
            asked = f"no event of the joystick for {STICK_AGE_S:.0f} s: stopped; move it to go on"
        if self._ignores_keys:
            asked = f"{asked}   (keys that came late were ignored)"
        return [*lines, asked, f"also steering: {self._other}" if self._other else "", HELP]


def _heard(at_s: float) -> str:
    """How old what was heard is, if it is old."""
    age_s = time.monotonic() - at_s
    return f" (heard {age_s:.0f} s ago)" if age_s > SILENT_S else ""


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):+.0f}°"
