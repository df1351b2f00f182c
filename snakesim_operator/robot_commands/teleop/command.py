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
from snakesim_hal.base.process import get_user_name, on_stop_signal
from snakesim_hal.base.terminal import overwrite_lines, print_line
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_from_rotation
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
MAX_FASTEST_M_S = 10
KEY_AGE_S = 15.0  # after this long without a key, the operator may have left the keyboard
SILENT_S = 1.0  # messages older than this are shown with their age
STOP_WAIT_S = 20.0  # at the end, for an emergency stop that is under way
HELP = "up, down: speed   left, right: direction   s: stop   SPACE: EMERGENCY STOP   q: quit"


def teleop(where: RobotSelection, fastest_m_s: float, joystick: Path | None) -> int:
    """Drive a robot until the operator presses q or Ctrl-C, or until the terminal or the joystick is gone.

    Args:
        where: selects the robot.
        fastest_m_s: the maximum speed.
        joystick: its device, or an empty path for the first one; None: keys alone.

    Returns:
        The exit code: 0, or 1 if the terminal or the joystick is gone.

    Raises:
        SnakesimError: no robot, no joystick or no terminal, or the speed is out of range.
    """
    if not 0 < fastest_m_s <= MAX_FASTEST_M_S:
        raise ConfigError(
            f"--fastest {fastest_m_s:g}: give a speed above 0, and at most {MAX_FASTEST_M_S} m/s",
            code="command/invalid-option",
        )
    with contextlib.ExitStack() as opened:
        stick: Joystick | None = None
        if joystick is not None:
            device = None if joystick == Path() else joystick
            stick = open_joystick(device)
            opened.callback(stick.close)
        keyboard = Keyboard() if stick is None or sys.stdin.isatty() else None
        link = only_robot(where, "teleop")
        session = opened.enter_context(open_session(link, CONNECT_S))
        if keyboard is not None:
            opened.enter_context(keyboard)
        return Teleop(session, link, fastest_m_s, keyboard, stick).run()


class Teleop:
    """Reads one operator's input, sends it to one robot, and shows the robot's state."""

    def __init__(
        self, session: Session, link: Link, fastest_m_s: float, keyboard: Keyboard | None, stick: Joystick | None
    ) -> None:
        """Prepare to drive a robot by keyboard or joystick: it publishes intents, and watches the robot's state.

        The emergency stop is connected here, so that it is ready before it is needed.

        Args:
            session: Session on the robot's network.
            link: How to reach the robot.
            fastest_m_s: Maximum speed along the path.
            keyboard: Reads keys from the terminal; None: there is no terminal.
            stick: The joystick; None: there is none.
        """
        # The operator.
        self._link = link
        self._keyboard = keyboard
        self._stick = stick
        self._user = f"{get_user_name()[:40]}, teleop {os.getpid()}"  # with the process id: one user may run two
        self._steering = Steering(self._user, fastest_m_s)
        self._ignores_keys = False  # the newest keys were late
        self._end_reason = ""  # not empty: the loop ends

        # What is sent.
        self._intents = session.publisher(keys.INTENT, Intent)
        self._sent_ns = -1  # robot time of the newest intent

        # What is received.
        self._clocks = session.reader(keys.CLOCK, Clock)
        self._worlds = session.reader(keys.WORLD, World)
        self._states = session.reader(keys.CONTROL_STATE, ControlState)
        self._statuses = session.latched_reader(keys.STATUS, Status)
        self._others = session.reader(keys.INTENT, Intent)

        # The newest of each, with the monotonic time of its arrival.
        self._clock: Clock | None = None
        self._clock_s = time.monotonic()
        self._status: Status | None = None
        self._status_s = 0.0
        self._control: ControlState | None = None
        self._control_s = 0.0
        self._body_w_rad: float | None = None
        self._other_user = ""

        # The emergency stop, which is prepared before it is needed.
        self._stop = PreparedStop(RobotSelection(link.endpoint, link.namespace, link.session), link)
        self._stop.connect(session)
        self._stopping: Future[str] | None = None

    def run(self) -> int:
        """Read the operator's input and send intents, once every PERIOD_S, until there is a reason to end.

        Returns:
            0 if the operator ended it, 1 if the terminal or the joystick is gone.
        """
        on_stop_signal(lambda: self._end("interrupted"))
        signal.signal(signal.SIGHUP, lambda *_: self._end("the terminal was closed"))
        lines_on_screen = 0
        cycle = 0
        while not self._end_reason:
            cycle_start_s = time.monotonic()
            self._read_operator()
            self._read_robot()
            if not self._end_reason:
                self._send_intent()
            is_screen_due = cycle % SHOWN_EVERY == 0
            if is_screen_due and sys.stdout.isatty():
                lines_on_screen = overwrite_lines(self._screen_lines(), lines_on_screen)
            cycle += 1
            elapsed_s = time.monotonic() - cycle_start_s
            time.sleep(max(PERIOD_S - elapsed_s, 0.0))
        self._finish()
        with contextlib.suppress(OSError):  # the terminal may be gone
            print_line(f"teleop ended: {self._end_reason}; {self._link.namespace} gets no more requests")
        return 1 if self._input_is_lost() else 0

    def _finish(self) -> None:
        """Wait for an emergency stop that is under way; otherwise stop the robot sooner than the last intent ends."""
        if self._stopping is not None:  # the threads of the stop end with this process
            wait([self._stopping], STOP_WAIT_S)
            self._stop.close()
        elif self._steering.touched_s is not None:
            self._steering.stop(time.monotonic())
            self._sent_ns = -1
            self._send_intent()

    def _stick_is_lost(self) -> bool:
        return self._stick is not None and self._stick.lost

    def _input_is_lost(self) -> bool:
        """Return whether the terminal or the joystick is gone."""
        terminal_is_gone = self._keyboard is not None and self._keyboard.gone
        return terminal_is_gone or self._stick_is_lost()

    def _end(self, reason: str) -> None:
        """Let the loop end. The first reason counts."""
        self._end_reason = self._end_reason or reason

    def _read_operator(self) -> None:
        """Read keyboard and joystick, and end the loop if one of them is gone."""
        now_s = time.monotonic()
        if self._keyboard is not None:
            self._read_keyboard(self._keyboard, now_s)
        if self._stick is not None:
            self._read_stick(self._stick)
        if self._stick_is_lost():
            self._end("the joystick is gone")
        elif self._input_is_lost():
            self._end("the terminal is gone")

    def _read_keyboard(self, keyboard: Keyboard, now_s: float) -> None:
        """Carry out all pressed keys. Late keys may stop the robot, but not drive it."""
        pressed_keys = keyboard.keys(0.0)
        if pressed_keys:
            self._ignores_keys = keyboard.late
        for key in pressed_keys:
            match key:
                case " ":
                    self._request_stop()
                case "q":
                    self._end("quit")
                case "s":
                    self._steering.stop(now_s)
                case "up" | "down" | "left" | "right" if self._stick is None and not keyboard.late:
                    self._steer_by_key(key, now_s)
                case _:
                    pass

    def _steer_by_key(self, key: str, now_s: float) -> None:
        match key:
            case "up":
                self._steering.change_speed(1, now_s)
            case "down":
                self._steering.change_speed(-1, now_s)
            case "left":
                self._steering.rotate_heading(HEADING_STEP_RAD, self._body_w_rad, now_s)
            case _:
                self._steering.rotate_heading(-HEADING_STEP_RAD, self._body_w_rad, now_s)

    def _read_stick(self, stick: Joystick) -> None:
        """Request the speed and the rotation of the stick's position, unless its newest event is too old."""
        if stick.read_events(0.0):
            self._request_stop()
        if stick.is_silent(time.monotonic()):
            return
        if stick.forward or stick.right or self._steering.touched_s is not None:
            self._steering.set_speed_fraction(stick.forward, stick.moved_s)
        if stick.right:
            self._steering.rotate_heading(-stick.right * TURN_RAD_S * PERIOD_S, self._body_w_rad, stick.moved_s)

    def _operator_may_be_gone(self) -> bool:
        """Return whether the last input is so old that the operator may have left."""
        touched_s = self._steering.touched_s
        limit_s = KEY_AGE_S if self._stick is None else STICK_AGE_S
        return touched_s is not None and time.monotonic() - touched_s > limit_s

    def _request_stop(self) -> None:
        """Request an emergency stop in other threads, once more at each press. No intent is sent from then on."""
        self._stopping = self._stop.request(self._user)

    def _describe_stop(self) -> str:
        """Return the result of the newest emergency stop."""
        stopping = self._stopping
        if stopping is None or not stopping.done():
            return "sent"
        error = stopping.exception()
        if error is not None:
            return f"NOT STOPPED, press SPACE again: {error}"
        return stopping.result()

    def _read_robot(self) -> None:
        """Read the newest messages of the robot, and of other operators."""
        if clocks := self._clocks.drain():
            self._clock = clocks[-1]
            self._clock_s = time.monotonic()
        if statuses := self._statuses.drain():
            self._status = statuses[-1]
            self._status_s = time.monotonic()
        if states := self._states.drain():
            self._control = states[-1]
            self._control_s = time.monotonic()
        if worlds := self._worlds.drain():
            self._body_w_rad = yaw_from_rotation(rotation_from_quaternion(worlds[-1].base_orientation_wxyz))
        for intent in self._others.drain():
            if intent.requester != self._user:
                self._other_user = intent.requester

    def _send_intent(self) -> None:
        """Send an intent for each new robot time, once the operator has made an input.

        The intent has speed 0 while the operator may be gone.
        """
        clock = self._clock
        if self._stopping is not None or self._steering.touched_s is None:
            return
        if clock is None or clock.timestamp_ns == self._sent_ns:
            return
        if self._operator_may_be_gone():
            self._steering.speed_m_s = 0.0
        self._sent_ns = clock.timestamp_ns
        self._intents.put(self._steering.intent(clock.timestamp_ns))

    def _screen_lines(self) -> list[str]:
        request = self._describe_request()
        if self._ignores_keys:
            request = f"{request}   (keys that came late were ignored)"
        return [
            self._describe_status(),
            self._describe_control(),
            request,
            f"also steering: {self._other_user}" if self._other_user else "",
            HELP,
        ]

    def _describe_status(self) -> str:
        status = self._status
        if status is None:
            return f"{self._link.namespace}: no status yet"
        age = _describe_age(self._status_s)
        return f"{self._link.namespace} ({status.backend}): {status.lifecycle}{age}: {status.reason}"

    def _describe_control(self) -> str:
        control = self._control
        if control is None:
            return "control: nothing received"
        return f"control: {control.state}{_describe_age(self._control_s)}: {control.reason}"

    def _describe_request(self) -> str:
        """Return what the operator requests from the robot, or why no request is sent."""
        if self._stopping is not None:
            return f"EMERGENCY STOP: {self._describe_stop()}. Then: snakesim robot reset, snakesim robot arm"
        silent_s = time.monotonic() - self._clock_s
        if silent_s > SILENT_S:
            return f"{self._describe_silence(silent_s)}: no request is possible"
        if self._steering.touched_s is None:
            return "nothing requested yet: the mission continues"
        if self._operator_may_be_gone():
            if self._stick is None:
                return f"no key for {KEY_AGE_S:.0f} s: stopped; press one to continue"
            return f"no event of the joystick for {STICK_AGE_S:.0f} s: stopped; move it to continue"
        heading_w_rad = self._steering.heading_w_rad
        heading = "the mission's way" if heading_w_rad is None else _degrees(heading_w_rad)
        body = "unknown" if self._body_w_rad is None else _degrees(self._body_w_rad)
        return f"requested: {self._steering.speed_m_s:+.2f} m/s, {heading}; body: {body}"

    def _describe_silence(self, silent_s: float) -> str:
        """Return why the robot publishes no clock: the reason in a recent status, or the time since the last clock."""
        status = self._status
        if status is not None and status.held_up and not _describe_age(self._status_s):
            return status.held_up
        return f"the robot has sent no clock for {silent_s:.0f} s"


def _describe_age(arrival_s: float) -> str:
    """Return the age of a message, if it is old; otherwise an empty text."""
    age_s = time.monotonic() - arrival_s
    return f" (received {age_s:.0f} s ago)" if age_s > SILENT_S else ""


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):+.0f}°"
