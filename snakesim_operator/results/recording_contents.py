"""What a recording holds of a run: a row for each tick, and the outputs of guidance, navigation and control.

The rows have the columns of the black box, made of the messages: joints of `sensor/joints`, setpoints of
`hal/applied`, pose and contacts as of their newest sample. They begin with the first arming that the recording saw.
"""

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.run_log.black_box import digest_of, touching
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import (
    Clock,
    Configuration,
    ControlState,
    Description,
    Status,
    Trajectory,
    World,
)
from snakesim_hal.wire.own_sample import own_kinds
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.results.missing_data import describe_undecodable

SERVICE_STREAMS = (keys.CONTROL_STATE, keys.WORLD, keys.TRAJECTORY)
"""What guidance, navigation and control publish."""
OUTPUTS = (*SERVICE_STREAMS, keys.OWN_ALL)
"""What the host's black box does not have."""
WORLDS_PER_S = 20.0  # as often as control publishes its state
_TICKED = (keys.CLOCK, keys.JOINTS, keys.APPLIED, keys.POSE, keys.CONTACTS, keys.JOINT_COMMAND)
ALL: tuple[str, ...] = (*SERVICE_STREAMS, *_TICKED, keys.OWN_ALL, keys.DESCRIPTION, keys.CONFIG, keys.STATUS)


_decoder: Callable[[type[Any]], Decoder[Any]] = cache(Decoder)


@dataclass
class Contents:
    """What was read of one recording."""

    path: Path
    description: Description | None = None
    config: Configuration | None = None
    status: Status | None = None  # the last one
    streams: dict[str, list[Any]] = field(default_factory=lambda: {key: [] for key in SERVICE_STREAMS})
    # key -> tick -> message
    at: dict[str, dict[int, Any]] = field(default_factory=lambda: {key: {} for key in _TICKED})
    # of own sensors, by key
    own: dict[str, list[RecordedMessage]] = field(default_factory=dict[str, list[RecordedMessage]])
    searched_nodes: dict[int, int] = field(default_factory=dict[int, int])  # tick of a turn of navigation -> work in it
    armed_wall_ns: list[int] = field(default_factory=list[int])  # wall clock at each clock since the first arming
    refused: Counter[str] = field(default_factory=Counter[str])  # messages that cannot be decoded, by key and reason
    lacks: list[str] = field(default_factory=list[str])
    unreached: list[str] = field(default_factory=list[str])  # what never came to the recorder
    ticks: int = 0  # with setpoints as applied
    ticks_lost: int | None = 0  # of these, as the file itself tells; None: it does not tell
    last_tick_ns: int | None = None  # robot time of the last of them
    whole: bool = True  # the file has an end
    replay_of: str = ""  # the recording whose sensors these are

    def take(self, recorded: RecordedMessage) -> None:
        """One message at a key of ALL, in the order of the file."""
        if keys.row_key(recorded.key) == keys.OWN_ALL:
            self.own.setdefault(recorded.key, []).append(recorded)  # their schema is in the description
            return
        message_type = keys.message_at(recorded.key)
        if message_type is None:
            return
        try:
            message = _decoder(message_type).decode(recorded.payload, recorded.encoding)
            self._keep(recorded.key, message, recorded.wall_ns)
        except WireError as error:
            self.refused[f"{recorded.key}: {error}"[:200]] += 1

    def _keep(self, key: str, message: Any, wall_ns: int) -> None:
        match message:
            case Description():
                self.description = message
            case Configuration():
                self.config = message
            case Status():
                self.status = message
            case Clock(paused=True):
                pass  # no tick
            case World() | Trajectory() | ControlState():
                if isinstance(message, Trajectory):
                    self.searched_nodes[message.tick] = message.searched_nodes
                kept = self.streams[key]
                if not kept or _is_news(kept[-1], message):
                    kept.append(message)
            case _:
                self.at[key][message.tick] = message
                if isinstance(message, Clock) and message.arm_session:
                    self.armed_wall_ns.append(wall_ns)

    def missing(self, ticks: int) -> list[str]:
        """Ticks of a run that never came to its recorder: nothing in the file itself tells of them."""
        if self.ticks_lost is None or (lost := ticks - self.ticks - self.ticks_lost) <= 0:
            return []
        last = (
            "none came" if self.last_tick_ns is None else f"the last that came is of {self.last_tick_ns * 1e-9:.2f} s"
        )
        return [f"recording: {lost} of {ticks} ticks did not reach the recorder; {last}"]

    def columns(self, robot: Description) -> dict[str, NDArray[Any]]:
        """A row for each tick since the first arming, named as in the black box."""
        joints, applied, clocks = (self.at[key] for key in (keys.JOINTS, keys.APPLIED, keys.CLOCK))
        poses, contacts = self.at[keys.POSE], self.at[keys.CONTACTS]
        count = len(robot.joints)
        rows: list[tuple[Any, ...]] = []
        pose, peak_n, touched = [np.nan] * 7, 0.0, 0
        for tick in sorted(joints.keys() | poses.keys() | contacts.keys()):
            if tick in poses:
                pose = [*poses[tick].position_w, *poses[tick].orientation_wxyz]
            if tick in contacts:
                peak_n, touched = touching(contacts[tick])
            state, points, clock = joints.get(tick), applied.get(tick), clocks.get(tick)
            if state is None or points is None or clock is None or not clock.arm_session or not state.is_of(count):
                continue
            rows.append((tick, state, points, pose, peak_n, touched))
        states, points = [row[1] for row in rows], [row[2] for row in rows]
        ticks = np.array([row[0] for row in rows], dtype=np.int64)
        placed = np.array([row[3] for row in rows]).reshape(len(rows), 7)
        found: dict[str, NDArray[Any]] = {
            "tick": ticks,
            "time_s": ticks * robot.period_ns * 1e-9,
            "position_w": placed[:, :3],
            "orientation_wxyz": placed[:, 3:],
            "contact_peak_n": np.array([row[4] for row in rows], dtype=float),
            "contact_count": np.array([row[5] for row in rows], dtype=float),
            "mode": np.array([point.mode for point in points], dtype=np.int8).reshape(len(rows), count),
        }
        for names, messages in (
            (("angle_rad", "velocity_rad_s", "torque_nm"), states),
            (("target", "torque_limit_nm"), points),
        ):
            for name in names:
                values = [getattr(message, name) for message in messages]
                found[name] = np.array(values, dtype=float).reshape(len(rows), count)
        return found

    def own_columns(self, robot: Description, time_s: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """At each row the newest sample of own sensors, `bend_rad.left`, and its age, `age_s.left`; NaN: none yet."""
        found: dict[str, NDArray[np.float64]] = {}
        for key, kind in own_kinds(robot).items():
            decoder, name = Decoder(kind.message), key.rpartition("/")[2]
            came: dict[int, tuple[int, dict[str, float]]] = {}
            for recorded in self.own.get(key, ()):
                try:
                    sample = decoder.decode(recorded.payload, recorded.encoding)
                except WireError as error:
                    self.refused[f"{key}: {error}"[:200]] += 1
                    continue
                came[sample.tick] = sample.timestamp_ns, kind.numbers(sample)
            ticks = np.array(sorted(came), dtype=np.int64)
            row = np.searchsorted(ticks * (robot.period_ns * 1e-9), time_s + 1e-9, side="right") - 1
            names = dict.fromkeys(at for _, numbers in came.values() for at in numbers) or kind.units
            values = {at: [came[tick][1].get(at, np.nan) for tick in ticks.tolist()] for at in names}
            known = row >= 0
            for at, column in values.items():
                what, dot, part = at.partition(".")
                found[f"{what}.{name}{dot}{part}"] = _picked(column, row, known)
            stamps = _picked([came[tick][0] * 1e-9 for tick in ticks.tolist()], row, known)
            found[f"age_s.{name}"] = time_s - stamps
        return found

    def host(self, columns: dict[str, NDArray[Any]]) -> HostRecord:
        """The host's statistics, as far as the recording shows."""
        status, armed = self.status, {t for t, clock in self.at[keys.CLOCK].items() if clock.lifecycle == "armed"}
        if status is None:
            why = "; ".join(["", *self.lacks])
            raise ConfigError(f"{self.path}: holds no hal/status, so it is not known what became of the run{why}")
        return HostRecord(
            ticks=len(columns["tick"]),
            wall_s=(self.armed_wall_ns[-1] - self.armed_wall_ns[0]) * 1e-9 if self.armed_wall_ns else 0.0,
            overruns=status.overruns,
            answered_ticks=len(armed & self.at[keys.JOINT_COMMAND].keys()),
            armed_ticks=len(armed),
            command_digest=digest_of(columns),
            state_to_command_us={"p50": None, "p99": None},
            tick_times=status.tick_times,
            rejected_commands=status.commands_rejected,
            limited_commands=status.commands_limited,
            faults=status.faults,
            faults_left_out=status.faults_left_out,
            lifecycle=status.lifecycle,
            why=status.why,
            ended="finished",
            ended_why="as far as it was recorded",
            isolated=status.isolated,
        )


def _picked(values: list[float], row: NDArray[np.int64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    found = np.full(len(row), np.nan)
    found[known] = np.array(values, dtype=float)[row[known]]
    return found


def read_recording(
    path: Path, wanted: Collection[str] = ALL, hear: Callable[[RecordedMessage], None] | None = None
) -> Contents:
    """Read a recording's messages at these keys. Raises ConfigError for a file that is none.

    hear: given every message, at whatever key, so that nobody has to read the file again.
    """
    from snakesim_operator.recording.reader import RecordingReader  # needs the extra `record`

    contents, reader = Contents(path), RecordingReader(path)
    for recorded in reader.messages({*wanted, keys.APPLIED} if hear is None else None):
        if recorded.key == keys.APPLIED:
            contents.ticks, contents.last_tick_ns = contents.ticks + 1, recorded.time_ns
        if hear is not None:
            hear(recorded)
        if recorded.key in wanted or keys.row_key(recorded.key) in wanted:
            contents.take(recorded)
    contents.lacks += describe_undecodable(contents.refused)
    contents.lacks += [f"recording: {lack}" for lack in reader.lacks]
    contents.whole, losses = reader.finished, reader.losses
    known = losses.lost[keys.APPLIED] + losses.dropped.get(keys.APPLIED, 0)
    chosen = reader.about.get("keys")  # of a recording that was to have these alone
    told = contents.whole and not losses.places and not (isinstance(chosen, list) and keys.APPLIED not in chosen)
    contents.ticks_lost = known if told else None
    contents.replay_of = str(reader.about.get("replay_of", ""))[:500]
    if losses.misplaced:
        for messages in contents.streams.values():
            messages.sort(key=lambda message: message.timestamp_ns or 0)
    return contents


def _is_news(before: Any, message: Any) -> bool:
    """Worlds are thinned; a path is kept once."""
    match message:
        case World():
            return message.timestamp_ns >= before.timestamp_ns + round(1e9 / WORLDS_PER_S)
        case Trajectory():
            return message.path_id != before.path_id
        case _:
            return True
