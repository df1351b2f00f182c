"""The progress line of a run: rewritten in place on a terminal, otherwise a line at intervals."""

import sys
import time
from typing import Self

from snakesim_hal.base.terminal import overwrite_line, say
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import ControlState, Status

TERMINAL_PERIOD_S = 0.1
PLAIN_PERIOD_S = 5.0


class OneLine:
    """A line that is rewritten in place on a terminal, and otherwise printed again."""

    def __init__(self) -> None:
        self.terminal = sys.stdout.isatty()
        self._shown = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            say("")

    def put(self, text: str) -> None:
        """Show it now."""
        if self.terminal:
            self._shown = overwrite_line(text, 118, self._shown)
        else:
            say(text)


class Progress(OneLine):
    """Shows the progress of a run."""

    def __init__(self, config: RunConfig) -> None:
        super().__init__()
        self._duration_s = config.duration_s
        self._rate_hz = config.rate_hz
        self._next = 0.0
        self._origin: tuple[float, float] | None = None  # wall and robot time at arming
        self._armed_s = 0.0  # armed robot time so far, which a run's duration counts
        self._before: Status | None = None
        self._last = ""
        self._armed = False

    def start_over(self) -> None:
        """Robot time restarts at 0, with a new host."""
        self._origin = self._before = None
        self._armed_s = 0.0

    def show(self, status: Status | None, control: ControlState | None, *, armed: bool) -> None:
        """Update the line, if it is due."""
        now = time.monotonic()
        if status is None:
            return
        before, self._before = self._before, status
        if before is not None and before.lifecycle == "armed":
            self._armed_s += max(status.tick - before.tick, 0) / self._rate_hz
        if now < self._next and armed == self._armed:
            return
        if armed and self._origin is None:
            self._origin = (now, status.tick / self._rate_hz)
        if armed and not self._armed_s:
            return  # the robot has been armed since the status before: for how long tells the next one
        self._armed = armed
        self._next = now + (TERMINAL_PERIOD_S if self.terminal else PLAIN_PERIOD_S)
        text = self._running(status, control, now) if armed else f"starting: {status.why}"
        if self.terminal or text != self._last:
            self.put(text)
        self._last = text

    def _running(self, status: Status, control: ControlState | None, now: float) -> str:
        assert self._origin is not None
        passed_s, wall_s = status.tick / self._rate_hz - self._origin[1], now - self._origin[0]
        parts = [f"{min(self._armed_s, self._duration_s):6.2f} of {self._duration_s:g} s"]
        if wall_s > 0.3:
            speed = passed_s / wall_s
            parts.append(f"{speed:.1f}x real time")
            left_s = max(self._duration_s - self._armed_s, 0.0)
            if speed > 0 and status.lifecycle == "armed" and left_s > 0:
                parts.append(f"about {in_minutes(left_s / speed)} left")
        if status.paused_by is not None:
            parts.append(f"PAUSED by {status.paused_by}")
        if status.lifecycle != "armed":
            parts.append(f"{status.lifecycle}: {status.why}")
        elif control is not None:
            parts.append(control.state)
            if control.propulsion_joint is not None:
                parts.append(f"{control.propulsion_joint} at {control.propulsion_torque_nm or 0:+.1f} N·m")
            if control.state == "NotLocomoting":
                parts.append(control.reason)
            if control.path_s_m is not None:
                parts.append(f"tail at {control.path_s_m:.2f} m")
        return "  ".join(parts)


def in_minutes(seconds: float) -> str:
    """As 4:05, or 1:04:05."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"
