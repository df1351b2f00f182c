"""Moments of a recorded run: what the live console shows, as far as the record has it."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, ControlState, JointState, Mode, Trajectory, World
from snakesim_hal.wire.quantities import Quaternion, Vector
from snakesim_operator.features.console.operations import LOG_LINES
from snakesim_operator.features.console.page_log import StateChangeLog
from snakesim_operator.features.console.robot_data.message_history import IMAGES, MessageHistory
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.results.record import RunRecord

CONTROL_LIMIT_S = 0.3  # older states are of before a gap
MessageT = TypeVar("MessageT", ControlState, World, Trajectory)
CHARTED_S, CHARTED = 10.0, 200  # before an instant that is jumped to


class RecordedRun:
    """A recorded run, by time."""

    def __init__(self, kept: Path) -> None:
        """kept: the run's folder, or its recording. Raises ConfigError when it is neither."""
        self.heard = MessageHistory()
        self.record = RunRecord.load(kept, hear=self.heard.take)
        self.heard.robot = self.record.description
        outputs = (self.record.control, self.record.worlds, self.record.trajectories)
        self._stamps = {id(messages): [_timestamp_s(m) for m in messages] for messages in outputs}
        self._log = self._written()

    @property
    def span_s(self) -> tuple[float, float]:
        """Robot time of the first and of the last row."""
        times = self.record.time_s
        return (float(times[0]), float(times[-1])) if len(times) else (0.0, 0.0)

    def at(self, time_s: float) -> RobotSnapshot:
        """What was known then."""
        record = self.record
        if not len(record.time_s):
            return RobotSnapshot(robot=record.description)
        row = record.row_at(time_s)
        joints = self._joints(row)
        control = self._before(record.control, time_s, CONTROL_LIMIT_S)
        return RobotSnapshot(
            robot=record.description,
            time_s=float(record.time_s[row]),
            joints=joints,
            body=joints,
            base=self._base(row),
            world=self._before(record.worlds, time_s, CONTROL_LIMIT_S),
            trajectory=self._before(record.trajectories, time_s),
            control=control,
            status=self.heard.newest(keys.STATUS, time_s),
            power=self.heard.newest(keys.POWER, time_s),
            settings=self.heard.newest(keys.SETTINGS_IN_FORCE, time_s),
            applied=self._applied(row),
            images={key: image for row in IMAGES for key, image in self.heard.all_newest(row, time_s).items()},
            own=self.heard.all_newest(keys.OWN_ALL, time_s),
            streams=self.heard.streams(time_s),
            log=[line for at_s, line in self._log if at_s <= time_s][: -LOG_LINES - 1 : -1],
        )

    def before(self, time_s: float) -> Iterator[RobotSnapshot]:
        """Up to an instant, as far back as charts reach."""
        first_s = max(time_s - CHARTED_S, self.span_s[0])
        return (self.at(at_s) for at_s in np.linspace(first_s, time_s, CHARTED, endpoint=False).tolist())

    def _written(self) -> list[tuple[float, str]]:
        """The log that a live page would have had, by robot time; times in it since the first tick."""
        lines: list[tuple[float, str]] = []
        told = [*self.heard.every(keys.STATUS), *self.heard.every(keys.SETTINGS_IN_FORCE)]
        told += [(_timestamp_s(state), state) for state in self.record.control]
        fresh: list[str] = []
        changes = StateChangeLog(fresh.append)
        for time_s, message in sorted(told, key=lambda one: one[0]):
            changes.note(message)
            lines += [(time_s, f"{time_s - self.span_s[0]:8.2f} s  {line}") for line in fresh]
            fresh.clear()
        return lines

    def _before(self, messages: Sequence[MessageT], time_s: float, limit_s: float | None = None) -> MessageT | None:
        """The newest message of that time, unless it is older than the limit."""
        stamps = self._stamps[id(messages)]
        i = bisect_right(stamps, time_s) - 1
        return None if i < 0 or (limit_s is not None and time_s - stamps[i] > limit_s) else messages[i]

    def _joints(self, row: int) -> JointState:
        record = self.record
        angles = record.angle_rad[row]
        known = np.isfinite(angles)
        count = len(angles)
        return JointState(
            tick=0,
            timestamp_ns=round(record.time_s[row] * 1e9),
            angle_rad=np.where(known, angles, 0.0).tolist(),
            velocity_rad_s=_filled(record.velocity_rad_s[row]),
            torque_nm=_filled(record.torque_nm[row]),
            valid=known.tolist(),
            age_ns=[0] * count,
        )

    def _applied(self, row: int) -> AppliedCommand:
        record = self.record
        return AppliedCommand(
            tick=0,
            timestamp_ns=round(record.time_s[row] * 1e9),
            sequence=None,
            mode=[Mode(mode) for mode in record.mode[row].tolist()],
            target=_filled(record.target[row]),
            torque_limit_nm=_filled(record.torque_limit_nm[row]),
        )

    def _base(self, row: int) -> tuple[Vector, Quaternion] | None:
        position, wxyz = self.record.position_w[row], self.record.orientation_wxyz[row]
        if not (np.isfinite(position).all() and np.isfinite(wxyz).all()):
            return None
        x, y, z = position.tolist()
        w, i, j, k = wxyz.tolist()
        return (x, y, z), (w, i, j, k)


def _timestamp_s(message: ControlState | World | Trajectory) -> float:
    return (message.timestamp_ns or 0) * 1e-9


def _filled(values: NDArray[np.float64]) -> list[float]:
    return np.nan_to_num(values).tolist()
