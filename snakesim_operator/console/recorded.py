"""Moments of a recorded run: what the live console shows, as far as the record has it."""

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import AppliedCommand, ControlState, JointState, Mode, Power, Status, Trajectory, World
from snakesim_hal.wire.quantities import Quaternion, Vector
from snakesim_operator.console.snapshot import RobotSnapshot
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.record import RunRecord

CONTROL_LIMIT_S = 0.3  # older states are of before a gap
MessageT = TypeVar("MessageT", ControlState, World, Trajectory)
_TOLD: dict[str, type[Any]] = {keys.STATUS: Status, keys.POWER: Power}  # what a record of rows does not have


class RecordedRun:
    """A recorded run, by time."""

    def __init__(self, record: RunRecord, kept: Path) -> None:
        """kept: the run's folder, or its recording; a run without one has neither status nor supply."""
        self.record = record
        self._told = _told(kept / RECORDING if kept.is_dir() else kept)
        self._stamps = {id(messages): [_stamp_s(m) for m in messages] for messages in self._outputs()}

    def _outputs(self) -> tuple[Sequence[ControlState], Sequence[World], Sequence[Trajectory]]:
        return self.record.control, self.record.worlds, self.record.trajectories

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
            status=self._newest(keys.STATUS, time_s),
            power=self._newest(keys.POWER, time_s),
            applied=self._applied(row),
        )

    def _newest(self, key: str, time_s: float) -> Any:
        times_s, messages = self._told[key]
        i = bisect_right(times_s, time_s) - 1
        return messages[i] if i >= 0 else None

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
            stamp_ns=round(record.time_s[row] * 1e9),
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
            stamp_ns=round(record.time_s[row] * 1e9),
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


def _told(path: Path) -> dict[str, tuple[list[float], list[Any]]]:
    """Robot times and messages, by key."""
    found: dict[str, tuple[list[float], list[Any]]] = {key: ([], []) for key in _TOLD}
    decoders = {key: msgspec.msgpack.Decoder(message) for key, message in _TOLD.items()}
    for one in RecordingReader(path).messages(list(_TOLD)) if path.is_file() else ():
        try:
            message = decoders[one.key].decode(one.payload)
        except UNDECODABLE:
            continue
        times_s, messages = found[one.key]
        times_s.append(max(one.time_ns * 1e-9, times_s[-1] if times_s else 0.0))
        messages.append(message)
    return found


def _stamp_s(message: ControlState | World | Trajectory) -> float:
    return (message.stamp_ns or 0) * 1e-9


def _filled(values: NDArray[np.float64]) -> list[float]:
    return np.nan_to_num(values).tolist()
