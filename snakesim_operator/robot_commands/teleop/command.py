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
from snakesim_hal.base.process import call_on_stop_signals, get_user_name
from snakesim_hal.base.terminal import overwrite_lines, print_line
from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion, yaw_from_rotation
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    ControlState,
    LocomotionIntent,
    RobotStatus,
    WorldModel,
)
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, RobotSelection, find_single_robot
from snakesim_operator.robot_commands.prepared_stop import PreparedStop
from snakesim_operator.robot_commands.teleop.joystick import STICK_AGE_S, Joystick, open_joystick
from snakesim_operator.robot_commands.teleop.keyboard import KeyReader
from snakesim_operator.robot_commands.teleop.steering import (
    HEADING_STEP_RAD,
    TURN_RAD_S,
    SteeringState,
)

PERIOD_S = 0.05
SCREEN_PERIOD_CYCLES = 4  # periods
MAX_ALLOWED_SPEED_M_S = 10
MAX_KEY_AGE_S = 15.0  # after this long without a key, the operator may have left the keyboard
SILENT_S = 1.0  # messages older than this are shown with their age
STOP_TIMEOUT_S = 20.0  # at the end, for an emergency stop that is under way
KEY_HELP = "up, down: speed   left, right: direction   s: stop   SPACE: EMERGENCY STOP   q: quit"


def teleoperate_robot(
    selection: RobotSelection, max_speed_m_s: float, joystick: Path | None
) -> int:
    """Drive a robot until the operator presses q or Ctrl-C, or until the terminal or the joystick is gone.

    Args:
        selection: Selects the robot.
        max_speed_m_s: Speed at full deflection of the joystick, and limit of the speed that keys request.
        joystick: Path of the joystick's device. An empty path selects the first joystick, None the keyboard alone.

    Returns:
        The exit code: 0, or 1 if the terminal or the joystick is gone.

    Raises:
        ConfigError: There is no joystick or no terminal, or the speed is out of range.
        NotConnectedError: No robot can be reached.
    """
    if not 0 < max_speed_m_s <= MAX_ALLOWED_SPEED_M_S:
        raise ConfigError(
            f"--fastest {max_speed_m_s:g}: give a speed above 0, and at most {MAX_ALLOWED_SPEED_M_S} m/s",
            code="command/invalid-option",
        )
    with contextlib.ExitStack() as stack:
        stick: Joystick | None = None
        if joystick is not None:
            device = None if joystick == Path() else joystick
            stick = open_joystick(device)
            stack.callback(stick.close)
        keyboard = KeyReader() if stick is None or sys.stdin.isatty() else None
        link = find_single_robot(selection, "teleop")
        session = stack.enter_context(open_session(link, CONNECT_TIMEOUT_S))
        if keyboard is not None:
            stack.enter_context(keyboard)
        return TeleopLoop(session, link, max_speed_m_s, keyboard, stick).run()


class TeleopLoop:
    """Reads one operator's input, sends it to one robot, and shows the robot's state."""

    def __init__(
        self,
        session: Session,
        connection: ConnectionSettings,
        max_speed_m_s: float,
        keyboard: KeyReader | None,
        stick: Joystick | None,
    ) -> None:
        """Prepare to steer a robot: publish intents, read the robot's state, and prepare the emergency stop.

        Args:
            session: Session on the robot's network.
            connection: How to reach the robot.
            max_speed_m_s: Maximum speed along the path.
            keyboard: Reads keys from the terminal. None if there is no terminal.
            stick: The joystick. None if there is none.
        """
        # The operator.
        self._connection = connection
        self._keyboard = keyboard
        self._stick = stick
        self._user = f"{get_user_name()[:40]}, teleop {os.getpid()}"  # with the process id: one user may run two
        self._steering = SteeringState(self._user, max_speed_m_s)
        self._ignored_late_keys = False  # the newest keys were late
        self._end_reason = ""  # not empty: the loop ends

        # What is sent.
        self._intent_publisher = session.declare_publisher(keys.INTENT, LocomotionIntent)
        self._last_intent_ns = -1  # robot time of the newest intent

        # What is received.
        self._clock_reader = session.declare_reader(keys.CLOCK, Clock)
        self._world_reader = session.declare_reader(keys.WORLD, WorldModel)
        self._control_state_reader = session.declare_reader(keys.CONTROL_STATE, ControlState)
        self._status_reader = session.declare_latched_reader(keys.STATUS, RobotStatus)
        self._intent_reader = session.declare_reader(keys.INTENT, LocomotionIntent)

        # The newest of each, with the monotonic time of its arrival.
        self._clock: Clock | None = None
        self._clock_arrival_s = time.monotonic()
        self._status: RobotStatus | None = None
        self._status_arrival_s = 0.0
        self._control_state: ControlState | None = None
        self._control_arrival_s = 0.0
        self._body_heading_w_rad: float | None = None
        self._other_user = ""

        # The emergency stop, which is prepared before it is needed.
        self._prepared_stop = PreparedStop(
            RobotSelection(connection.endpoint, connection.namespace, connection.session),
            connection,
        )
        self._prepared_stop.use_session(session)
        self._pending_stop: Future[str] | None = None

    def run(self) -> int:
        """Read the operator's input and send intents, once every PERIOD_S, until there is a reason to end.

        Returns:
            0 if the operator ended it, 1 if the terminal or the joystick is gone.
        """
        call_on_stop_signals(lambda: self._request_end("interrupted"))
        signal.signal(signal.SIGHUP, lambda *_: self._request_end("the terminal was closed"))
        lines_on_screen = 0
        cycle = 0
        while not self._end_reason:
            cycle_start_s = time.monotonic()
            self._read_operator_input()
            self._read_robot_messages()
            if not self._end_reason:
                self._send_intent()
            is_screen_due = cycle % SCREEN_PERIOD_CYCLES == 0
            if is_screen_due and sys.stdout.isatty():
                lines_on_screen = overwrite_lines(self._format_screen_lines(), lines_on_screen)
            cycle += 1
            elapsed_s = time.monotonic() - cycle_start_s
            time.sleep(max(PERIOD_S - elapsed_s, 0.0))
        self._stop_robot_at_end()
        with contextlib.suppress(OSError):  # the terminal may be gone
            print_line(
                f"teleop ended: {self._end_reason}; {self._connection.namespace} gets no more requests"
            )
        return 1 if self._is_input_lost() else 0

    def _stop_robot_at_end(self) -> None:
        """Wait for a pending emergency stop; otherwise send an intent of speed 0, before the last intent expires."""
        if self._pending_stop is not None:  # the threads of the stop end with this process
            wait([self._pending_stop], STOP_TIMEOUT_S)
            self._prepared_stop.close()
        elif self._steering.last_input_s is not None:
            self._steering.stop(time.monotonic())
            self._last_intent_ns = -1
            self._send_intent()

    def _is_stick_lost(self) -> bool:
        return self._stick is not None and self._stick.is_lost

    def _is_input_lost(self) -> bool:
        """Return whether the terminal or the joystick is gone."""
        terminal_is_gone = self._keyboard is not None and self._keyboard.is_gone
        return terminal_is_gone or self._is_stick_lost()

    def _request_end(self, reason: str) -> None:
        """Let the loop end after the current cycle. If this is called again, the first reason is kept."""
        self._end_reason = self._end_reason or reason

    def _read_operator_input(self) -> None:
        """Process the input of keyboard and joystick, and end the loop if one of them is gone."""
        now_s = time.monotonic()
        if self._keyboard is not None:
            self._read_keyboard(self._keyboard, now_s)
        if self._stick is not None:
            self._read_stick(self._stick)
        if self._is_stick_lost():
            self._request_end("the joystick is gone")
        elif self._is_input_lost():
            self._request_end("the terminal is gone")

    def _read_keyboard(self, keyboard: KeyReader, now_s: float) -> None:
        """Process all pressed keys. Late keys may stop the robot, but not steer it."""
        pressed_keys = keyboard.read_keys(0.0)
        if pressed_keys:
            self._ignored_late_keys = keyboard.has_late_keys
        for key in pressed_keys:
            match key:
                case " ":
                    self._request_emergency_stop()
                case "q":
                    self._request_end("quit")
                case "s":
                    self._steering.stop(now_s)
                case "up" | "down" | "left" | "right" if (
                    self._stick is None and not keyboard.has_late_keys
                ):
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
                self._steering.rotate_heading(HEADING_STEP_RAD, self._body_heading_w_rad, now_s)
            case _:
                self._steering.rotate_heading(-HEADING_STEP_RAD, self._body_heading_w_rad, now_s)

    def _read_stick(self, stick: Joystick) -> None:
        """Request the speed and the rotation of the stick's position, unless its newest event is too old."""
        if stick.read_events(0.0):
            self._request_emergency_stop()
        if stick.is_silent(time.monotonic()):
            return
        if stick.forward or stick.right or self._steering.last_input_s is not None:
            self._steering.set_speed_fraction(stick.forward, stick.last_event_s)
        if stick.right:
            self._steering.rotate_heading(
                -stick.right * TURN_RAD_S * PERIOD_S, self._body_heading_w_rad, stick.last_event_s
            )

    def _is_operator_possibly_gone(self) -> bool:
        """Return whether the last input is so old that the operator may have left keyboard or joystick."""
        touched_s = self._steering.last_input_s
        limit_s = MAX_KEY_AGE_S if self._stick is None else STICK_AGE_S
        return touched_s is not None and time.monotonic() - touched_s > limit_s

    def _request_emergency_stop(self) -> None:
        """Request an emergency stop, without waiting for its result. No intent is sent from then on."""
        self._pending_stop = self._prepared_stop.request_stop(self._user)

    def _describe_stop(self) -> str:
        """Return the result of the newest emergency stop in words; "sent" while there is none."""
        stopping = self._pending_stop
        if stopping is None or not stopping.done():
            return "sent"
        error = stopping.exception()
        if error is not None:
            return f"NOT STOPPED, press SPACE again: {error}"
        return stopping.result()

    def _read_robot_messages(self) -> None:
        """Read the newest messages of the robot, and of other operators."""
        if clocks := self._clock_reader.drain():
            self._clock = clocks[-1]
            self._clock_arrival_s = time.monotonic()
        if statuses := self._status_reader.drain():
            self._status = statuses[-1]
            self._status_arrival_s = time.monotonic()
        if states := self._control_state_reader.drain():
            self._control_state = states[-1]
            self._control_arrival_s = time.monotonic()
        if worlds := self._world_reader.drain():
            self._body_heading_w_rad = yaw_from_rotation(
                rotation_from_quaternion(worlds[-1].base_orientation_wxyz)
            )
        for intent in self._intent_reader.drain():
            if intent.requester != self._user:
                self._other_user = intent.requester

    def _send_intent(self) -> None:
        """Send an intent for each new robot time, once the operator has made an input.

        The intent has speed 0 while the operator may be gone.
        """
        clock = self._clock
        if self._pending_stop is not None or self._steering.last_input_s is None:
            return
        if clock is None or clock.timestamp_ns == self._last_intent_ns:
            return
        if self._is_operator_possibly_gone():
            self._steering.speed_m_s = 0.0
        self._last_intent_ns = clock.timestamp_ns
        self._intent_publisher.put(self._steering.make_intent(clock.timestamp_ns))

    def _format_screen_lines(self) -> list[str]:
        request = self._describe_request()
        if self._ignored_late_keys:
            request = f"{request}   (late keys were ignored)"
        return [
            self._describe_status(),
            self._describe_control(),
            request,
            f"also steering: {self._other_user}" if self._other_user else "",
            KEY_HELP,
        ]

    def _describe_status(self) -> str:
        status = self._status
        if status is None:
            return f"{self._connection.namespace}: no status yet"
        age = _describe_age_if_old(self._status_arrival_s)
        return f"{self._connection.namespace} ({status.backend}): {status.lifecycle}{age}: {status.reason}"

    def _describe_control(self) -> str:
        control = self._control_state
        if control is None:
            return "control: nothing received"
        return f"control: {control.state}{_describe_age_if_old(self._control_arrival_s)}: {control.reason}"

    def _describe_request(self) -> str:
        """Return what the operator requests from the robot, or why no request is sent."""
        if self._pending_stop is not None:
            return f"EMERGENCY STOP: {self._describe_stop()}. Then: snakesim robot reset, snakesim robot arm"
        silent_s = time.monotonic() - self._clock_arrival_s
        if silent_s > SILENT_S:
            return f"{self._describe_silence(silent_s)}: no request is possible"
        if self._steering.last_input_s is None:
            return "nothing requested yet: the mission continues"
        if self._is_operator_possibly_gone():
            if self._stick is None:
                return f"no key for {MAX_KEY_AGE_S:.0f} s: stopped; press one to continue"
            return f"no event of the joystick for {STICK_AGE_S:.0f} s: stopped; move it to continue"
        heading_w_rad = self._steering.heading_w_rad
        heading = "the mission's way" if heading_w_rad is None else _format_degrees(heading_w_rad)
        body = (
            "unknown"
            if self._body_heading_w_rad is None
            else _format_degrees(self._body_heading_w_rad)
        )
        return f"requested: {self._steering.speed_m_s:+.2f} m/s, {heading}; body: {body}"

    def _describe_silence(self, silent_s: float) -> str:
        """Explain why the robot publishes no clock: by the reason in a recent status, or by the time without a clock.

        Args:
            silent_s: Time since the last clock message.
        """
        status = self._status
        if (
            status is not None
            and status.held_up
            and not _describe_age_if_old(self._status_arrival_s)
        ):
            return status.held_up
        return f"the robot has sent no clock for {silent_s:.0f} s"


def _describe_age_if_old(arrival_s: float) -> str:
    """Return the age of a message, if it is old; otherwise an empty text."""
    age_s = time.monotonic() - arrival_s
    return f" (received {age_s:.0f} s ago)" if age_s > SILENT_S else ""


def _format_degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):+.0f}°"
