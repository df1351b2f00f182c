"""Snapshots of a recorded run: what the live console shows, as far as the record has it."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    AppliedCommand,
    ControlState,
    JointMode,
    JointState,
    Trajectory,
    WorldModel,
)
from snakesim_hal.wire.quantities import Quaternion, Vector
from snakesim_operator.features.console.operations import MAX_LOG_LINES
from snakesim_operator.features.console.page_log import StateChangeLog
from snakesim_operator.features.console.robot_data.message_history import IMAGE_ROWS, MessageHistory
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.results.run_log import RunRecord

MAX_CONTROL_AGE_S = 0.3  # controllers publish more often, so an older message is from before a gap
CHART_HISTORY_S = 10.0  # shown before an instant that a viewer jumps to
CHART_SAMPLES = 200  # in CHART_HISTORY_S

MessageT = TypeVar("MessageT", ControlState, WorldModel, Trajectory)


class RunPlayback:
    """A recorded run, by robot time in s."""

    def __init__(self, path: Path) -> None:
        """Load a run.

        Args:
            path: The folder of the run, or its recording.

        Raises:
            ConfigError: The path is neither.
        """
        self.history = MessageHistory()
        self.record = RunRecord.load(path, on_message=self.history.add)
        self.history.robot = self.record.description
        outputs = (self.record.control_states, self.record.worlds, self.record.trajectories)
        self._output_times_s = {
            id(messages): [get_timestamp_s(message) for message in messages] for messages in outputs
        }
        self._log = self._make_log()

    @property
    def span_s(self) -> tuple[float, float]:
        """Robot time of the first and of the last row."""
        times_s = self.record.time_s
        if not len(times_s):
            return 0.0, 0.0
        return float(times_s[0]), float(times_s[-1])

    def make_snapshot(self, time_s: float) -> RobotSnapshot:
        """Make a snapshot of what was known of the robot at a time of the recorded run, from its newest messages.

        Args:
            time_s: Robot time of the snapshot in s; later messages are not used.
        """
        record = self.record
        history = self.history
        if not len(record.time_s):
            return RobotSnapshot(robot=record.description)
        row = record.find_nearest_row(time_s)
        joints = self._read_joints(row)
        return RobotSnapshot(
            robot=record.description,
            # From the rows of the record.
            time_s=float(record.time_s[row]),
            joints=joints,
            body=joints,
            base=self._read_base(row),
            applied=self._read_applied(row),
            # From the controller's output.
            world=self._find_newest(record.worlds, time_s, MAX_CONTROL_AGE_S),
            trajectory=self._find_newest(record.trajectories, time_s),
            control=self._find_newest(record.control_states, time_s, MAX_CONTROL_AGE_S),
            # From the other messages of the recording.
            status=history.find_newest(keys.STATUS, time_s),
            power=history.find_newest(keys.POWER, time_s),
            parameters=history.find_newest(keys.PARAMETERS_IN_FORCE, time_s),
            images=self._find_images(time_s),
            custom=history.find_all_newest(keys.CUSTOM_ALL, time_s),
            streams=history.measure_streams(time_s),
            log=self._read_log(time_s),
        )

    def iterate_snapshots_before(self, time_s: float) -> Iterator[RobotSnapshot]:
        """Yield the snapshots before a time, oldest first, as far back as charts show them."""
        first_s = max(time_s - CHART_HISTORY_S, self.span_s[0])
        times_s = np.linspace(first_s, time_s, CHART_SAMPLES, endpoint=False).tolist()
        return (self.make_snapshot(earlier_s) for earlier_s in times_s)

    def _find_newest(
        self, messages: Sequence[MessageT], time_s: float, max_age_s: float | None = None
    ) -> MessageT | None:
        """Return the newest of a controller's messages at a time; None if there is none, or it is too old."""
        times_s = self._output_times_s[id(messages)]
        index = bisect_right(times_s, time_s) - 1
        if index < 0:
            return None
        if max_age_s is not None and time_s - times_s[index] > max_age_s:
            return None
        return messages[index]

    def _find_images(self, time_s: float) -> dict[str, Any]:
        images: dict[str, Any] = {}
        for row in IMAGE_ROWS:
            images |= self.history.find_all_newest(row, time_s)
        return images

    # --- the log ---------------------------------------------------------------------------------------------

    def _make_log(self) -> list[tuple[float, str]]:
        """Make the log that a live page would have had, as pairs of robot time and line.

        The time in the text of a line is the time since the first tick.
        """
        messages: list[tuple[float, Any]] = [
            *self.history.iterate_messages(keys.STATUS),
            *self.history.iterate_messages(keys.PARAMETERS_IN_FORCE),
            *((get_timestamp_s(state), state) for state in self.record.control_states),
        ]
        messages.sort(key=lambda timed_message: timed_message[0])
        start_s, _ = self.span_s
        log: list[tuple[float, str]] = []
        new_lines: list[str] = []
        state_change_log = StateChangeLog(new_lines.append)
        for time_s, message in messages:
            state_change_log.log_change(message)
            for line in new_lines:
                log.append((time_s, f"{time_s - start_s:8.2f} s  {line}"))
            new_lines.clear()
        return log

    def _read_log(self, time_s: float) -> list[str]:
        """Return the newest lines of the log at a time, newest first."""
        lines = [line for line_time_s, line in self._log if line_time_s <= time_s]
        newest = lines[-MAX_LOG_LINES:]
        newest.reverse()
        return newest

    # --- rows of the record ----------------------------------------------------------------------------------

    def _read_joints(self, row: int) -> JointState:
        record = self.record
        angles_rad = record.angle_rad[row]
        is_known = np.isfinite(angles_rad)
        return JointState(
            tick=0,
            timestamp_ns=round(record.time_s[row] * 1e9),
            angle_rad=np.where(is_known, angles_rad, 0.0).tolist(),
            velocity_rad_s=_replace_nan(record.velocity_rad_s[row]),
            torque_nm=_replace_nan(record.torque_nm[row]),
            valid=is_known.tolist(),
            age_ns=[0] * len(angles_rad),
        )

    def _read_applied(self, row: int) -> AppliedCommand:
        record = self.record
        return AppliedCommand(
            tick=0,
            timestamp_ns=round(record.time_s[row] * 1e9),
            sequence=None,
            mode=[JointMode(mode) for mode in record.mode[row].tolist()],
            target=_replace_nan(record.target[row]),
            torque_limit_nm=_replace_nan(record.torque_limit_nm[row]),
        )

    def _read_base(self, row: int) -> tuple[Vector, Quaternion] | None:
        """Return position and orientation of the tail end; None if they are not known."""
        position_w = self.record.position_w_m[row]
        orientation_wxyz = self.record.orientation_wxyz[row]
        if not (np.isfinite(position_w).all() and np.isfinite(orientation_wxyz).all()):
            return None
        x, y, z = position_w.tolist()
        qw, qx, qy, qz = orientation_wxyz.tolist()
        return (x, y, z), (qw, qx, qy, qz)


def get_timestamp_s(message: ControlState | WorldModel | Trajectory) -> float:
    """Return the robot time of a controller's message in s; 0 if it has none."""
    return (message.timestamp_ns or 0) * 1e-9


def _replace_nan(values: NDArray[np.float64]) -> list[float]:
    """Return values with 0 in the place of NaN, because messages have no NaN."""
    return np.nan_to_num(values).tolist()
