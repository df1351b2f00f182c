"""The progress line of a run: rewritten in place on a terminal, otherwise a line at intervals."""

import sys
import time
from typing import Self

from snakesim_hal.base.terminal import overwrite_line, print_line
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import ControlState, RobotStatus

TERMINAL_PERIOD_S = 0.1  # between two updates of the line on a terminal
PLAIN_PERIOD_S = 5.0  # between two lines in a file or pipe
LINE_CHARACTERS = 118
MIN_WALL_S = 0.3  # a speed over a shorter time is not meaningful


class StatusLine:
    """A status line that is rewritten in place on a terminal, and otherwise printed as a new line."""

    def __init__(self) -> None:
        self.is_terminal = sys.stdout.isatty()
        self._shown_characters = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown_characters:
            print_line("")

    def show_text(self, text: str) -> None:
        """Show a text now, on a terminal in place of the previous text."""
        if self.is_terminal:
            self._shown_characters = overwrite_line(text, LINE_CHARACTERS, self._shown_characters)
        else:
            print_line(text)


class RunProgress(StatusLine):
    """Shows the progress of a run as a status line."""

    def __init__(self, config: RunConfig) -> None:
        super().__init__()
        # Configuration.
        self._duration_s = config.duration_s
        self._rate_hz = config.rate_hz

        # The line.
        self._next_update_s = 0.0  # monotonic time of the next update
        self._last_text = ""  # the text shown last

        # The robot.
        self._origin: tuple[float, float] | None = None  # wall and robot time at arming, in s
        self._armed_s = 0.0  # armed robot time so far, which a run's duration counts
        self._last_status: RobotStatus | None = None
        self._was_armed = False

    def reset(self) -> None:
        """Start to count at 0 again, because a new host does so."""
        self._origin = None
        self._last_status = None
        self._armed_s = 0.0

    def update(
        self, status: RobotStatus | None, control: ControlState | None, *, armed: bool
    ) -> None:
        """Update the progress line, if an update is due.

        Args:
            status: Newest status of the host; None while there is none.
            control: Newest state that the controller published; None while there is none.
            armed: Whether the run has armed the robot.
        """
        now_s = time.monotonic()
        if status is None:
            return
        self._count_armed_time(status)
        is_due = now_s >= self._next_update_s or armed != self._was_armed
        if not is_due:
            return
        if armed and self._origin is None:
            self._origin = (now_s, status.tick / self._rate_hz)
        if armed and not self._armed_s:
            return  # armed since the last status: only the next status shows for how long
        self._was_armed = armed
        period_s = TERMINAL_PERIOD_S if self.is_terminal else PLAIN_PERIOD_S
        self._next_update_s = now_s + period_s
        text = self._describe_run(status, control, now_s) if armed else f"starting: {status.reason}"
        if self.is_terminal or text != self._last_text:
            self.show_text(text)
        self._last_text = text

    def _count_armed_time(self, status: RobotStatus) -> None:
        """Add the robot time since the last status, if the robot was armed then."""
        last = self._last_status
        self._last_status = status
        if last is not None and last.lifecycle == "armed":
            self._armed_s += max(status.tick - last.tick, 0) / self._rate_hz

    def _describe_run(self, status: RobotStatus, control: ControlState | None, now: float) -> str:
        parts = [
            f"{min(self._armed_s, self._duration_s):6.2f} of {self._duration_s:g} s",
            *self._describe_speed(status, now),
        ]
        if status.paused_by is not None:
            parts.append(f"PAUSED by {status.paused_by}")
        if status.lifecycle != "armed":
            parts.append(f"{status.lifecycle}: {status.reason}")
        elif control is not None:
            parts += _describe_control(control)
        return "  ".join(parts)

    def _describe_speed(self, status: RobotStatus, now: float) -> list[str]:
        """Return the speed relative to real time, and the wall time left; empty shortly after arming."""
        assert self._origin is not None
        origin_wall_s, origin_robot_s = self._origin
        robot_s = status.tick / self._rate_hz - origin_robot_s
        wall_s = now - origin_wall_s
        if wall_s <= MIN_WALL_S:
            return []
        speed = robot_s / wall_s
        parts = [f"{speed:.1f}x real time"]
        left_s = max(self._duration_s - self._armed_s, 0.0)
        if speed > 0 and status.lifecycle == "armed" and left_s > 0:
            parts.append(f"about {format_duration(left_s / speed)} left")
        return parts


def _describe_control(control: ControlState) -> list[str]:
    parts: list[str] = [control.state]
    if control.propulsion_joint is not None:
        parts.append(f"{control.propulsion_joint} at {control.propulsion_torque_nm or 0:+.1f} N·m")
    if control.state == "NotLocomoting":
        parts.append(control.reason)
    if control.path_s_m is not None:
        parts.append(f"tail at {control.path_s_m:.2f} m")
    return parts


def format_duration(seconds: float) -> str:
    """Format a duration as 4:05, or 1:04:05 from one hour on."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
    return f"{minutes}:{rest:02d}"
