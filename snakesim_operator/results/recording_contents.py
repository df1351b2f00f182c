"""Reads what a recording holds of a run: a row for each tick, and the outputs of guidance, navigation and control.

The rows have the columns of the black box, made of the messages: joints of `sensor/joints`, setpoints of
`hal/applied`, pose and contacts as of their newest sample. They begin with the first arming that the recording saw.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.run_log.black_box import compute_digest, summarize_contacts
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Clock,
    Configuration,
    Contacts,
    ControlState,
    Description,
    JointState,
    Status,
    Trajectory,
    World,
)
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.results.contact_log import ContactCollector, ContactLog
from snakesim_operator.results.missing_data import describe_undecodable

if TYPE_CHECKING:
    from snakesim_operator.recording.reader import RecordingReader

SERVICE_STREAMS = (keys.CONTROL_STATE, keys.WORLD, keys.TRAJECTORY)
"""What guidance, navigation and control publish."""
OUTPUTS = (*SERVICE_STREAMS, keys.CUSTOM_ALL, keys.CONTACTS)
"""What the host's black box does not have."""
CONTROLLER = "controller"  # ends the names of columns with numbers that a controller defined
SAME_TIME_S = 1e-9  # two times that differ by less are of one tick
MAX_WORLDS_PER_S = 20.0  # as often as control publishes its state
_TICKED = (keys.CLOCK, keys.JOINTS, keys.APPLIED, keys.POSE, keys.JOINT_COMMAND)
_JOINT_COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm")  # of the messages at keys.JOINTS
_SETPOINT_COLUMNS = ("target", "torque_limit_nm")  # of the messages at keys.APPLIED
ALL: tuple[str, ...] = (*OUTPUTS, *_TICKED, keys.DESCRIPTION, keys.CONFIG, keys.STATUS)


_decoder: Callable[[type[Any]], Decoder[Any]] = cache(Decoder)


@dataclass(frozen=True)
class RunOutputs:
    """What services and custom sensors published in a run, and what of it is missing."""

    control: list[ControlState] = field(default_factory=list[ControlState])  # in time order
    worlds: list[World] = field(default_factory=list[World])  # in time order, at most MAX_WORLDS_PER_S
    trajectories: list[Trajectory] = field(default_factory=list[Trajectory])  # in time order, one for each path
    searched_nodes: dict[int, int] = field(default_factory=dict[int, int])  # tick of a cycle of navigation -> its work
    custom: dict[str, Floats] = field(default_factory=dict[str, Floats])  # columns that sensors and controllers define
    contact_log: ContactLog = field(default_factory=lambda: ContactCollector().make_log())
    replay_of: str = ""  # the recording whose sensors the services read; empty: a run
    missing: list[str] = field(default_factory=list[str])  # sentences about missing data
    unreached: list[str] = field(default_factory=list[str])  # of these: what never came to the recorder


@dataclass
class RecordingContents:
    """What was read of one recording."""

    path: Path

    # The last message of each kind.
    description: Description | None = None
    config: Configuration | None = None
    status: Status | None = None

    # Messages of the run.
    streams: dict[str, list[Any]] = field(default_factory=lambda: {key: [] for key in SERVICE_STREAMS})
    messages_by_tick: dict[str, dict[int, Any]] = field(  # key -> tick -> message
        default_factory=lambda: {key: {} for key in _TICKED}
    )
    custom: dict[str, list[RecordedMessage]] = field(default_factory=dict[str, list[RecordedMessage]])  # custom sensors
    contacts: ContactCollector = field(default_factory=ContactCollector)
    contact_summaries: dict[int, tuple[float, int]] = field(  # tick -> strongest force in N, number of obstacles
        default_factory=dict[int, tuple[float, int]]
    )
    searched_nodes: dict[int, int] = field(default_factory=dict[int, int])  # tick of a cycle of navigation -> its work
    armed_wall_ns: list[int] = field(default_factory=list[int])  # wall clock at each clock since the first arming
    replay_of: str = ""  # the recording whose sensors these are

    # Missing data.
    refused: Counter[str] = field(default_factory=Counter[str])  # messages that cannot be decoded, by key and reason
    missing: list[str] = field(default_factory=list[str])
    ticks: int = 0  # with setpoints as applied
    ticks_lost: int | None = 0  # of these, as the file itself reports; None: it does not report that
    last_tick_ns: int | None = None  # robot time of the last of them
    finished: bool = True  # the file has an end

    def add(self, recorded: RecordedMessage) -> None:
        """Add one message at a key of ALL, in the order of the file."""
        if keys.find_row_key(recorded.key) == keys.CUSTOM_ALL:
            self.custom.setdefault(recorded.key, []).append(recorded)  # their schema is in the description
            return
        message_type = keys.find_message(recorded.key)
        if message_type is None:
            return
        try:
            message = _decoder(message_type).decode(recorded.payload, recorded.encoding)
            self._keep(recorded.key, message, recorded.wall_ns)
        except WireError as error:
            self.refused[f"{recorded.key}: {error}"[:200]] += 1

    def _keep(self, key: str, message: Any, wall_ns: int) -> None:
        """Store a decoded message by its type, as far as the record of a run needs it.

        Args:
            key: Key at which the message was published.
            message: The decoded message.
            wall_ns: Wall clock at which the message was recorded.
        """
        match message:
            case Description():
                self.description = message
            case Configuration():
                self.config = message
            case Status():
                self.status = message
            case Clock(paused=True):
                pass  # a paused clock names no tick
            case Trajectory():
                self.searched_nodes[message.tick] = message.searched_nodes
                self._add_to_stream(key, message)
            case World() | ControlState():
                self._add_to_stream(key, message)
            case Clock():
                self.messages_by_tick[key][message.tick] = message
                if message.arm_session:
                    self.armed_wall_ns.append(wall_ns)
            case Contacts():
                self.contacts.add(message)
                self.contact_summaries[message.tick] = summarize_contacts(message)
            case _:
                self.messages_by_tick[key][message.tick] = message

    def _add_to_stream(self, key: str, message: Any) -> None:
        """Append a message of a service, unless the stream does not need it after the one before."""
        stream = self.streams[key]
        if not stream or _is_stored(stream[-1], message):
            stream.append(message)

    def describe_unreached(self, ticks: int) -> list[str]:
        """Describe the ticks that did not reach the recorder: nothing in the file itself shows them.

        Args:
            ticks: How many ticks the run had, as another source reports.
        """
        if self.ticks_lost is None:
            return []
        lost = ticks - self.ticks - self.ticks_lost
        if lost <= 0:
            return []
        if self.last_tick_ns is None:
            last = "none came"
        else:
            last = f"the last that came is of {self.last_tick_ns * 1e-9:.2f} s"
        return [f"recording: {lost} of {ticks} ticks did not reach the recorder; {last}"]

    def collect_outputs(self, robot: Description, time_s: Floats, unreached: Sequence[str] = ()) -> RunOutputs:
        """Return what guidance, navigation, control and custom sensors published in the run.

        Args:
            robot: The robot that has the custom sensors.
            time_s: (n,) robot time of each row, for the columns of custom sensors and of the controller's telemetry.
            unreached: Sentences about data that did not reach the recorder.
        """
        control = self.streams[keys.CONTROL_STATE].copy()
        # At the end of a run the host stops its clock, and control reports PowerOff: this is not a part of the run.
        while control and control[-1].state == "PowerOff":
            control.pop()

        # Messages of custom sensors are decoded only now, so that some may be refused only now.
        refused_before = self.refused.copy()
        sensor_columns = self.make_custom_columns(robot, time_s)
        newly_undecodable = describe_undecodable(self.refused - refused_before)

        telemetry_columns = make_telemetry_columns(control, time_s)
        return RunOutputs(
            control=control,
            worlds=self.streams[keys.WORLD],
            trajectories=self.streams[keys.TRAJECTORY],
            searched_nodes=self.searched_nodes,
            custom=sensor_columns | telemetry_columns,
            contact_log=self.contacts.make_log(),
            replay_of=self.replay_of,
            missing=[*newly_undecodable, *unreached, *self.missing],
            unreached=list(unreached),
        )

    def make_columns(self, robot: Description) -> dict[str, NDArray[Any]]:
        """Return a row for each tick since the first arming, in columns that are named as in the black box."""
        rows = self._rows(len(robot.joints))
        row_count = len(rows)
        shape = (row_count, len(robot.joints))
        ticks = np.array([row.tick for row in rows], dtype=np.int64)
        poses = np.array([row.pose for row in rows]).reshape(row_count, 7)
        columns: dict[str, NDArray[Any]] = {
            "tick": ticks,
            "time_s": ticks * robot.period_ns * 1e-9,
            "position_w_m": poses[:, :3],
            "orientation_wxyz": poses[:, 3:],
            "contact_peak_n": np.array([row.contact_peak_n for row in rows], dtype=float),
            "contact_count": np.array([row.contact_count for row in rows], dtype=float),
            "mode": np.array([row.setpoints.mode for row in rows], dtype=np.int8).reshape(shape),
        }
        for name in _JOINT_COLUMNS:
            columns[name] = np.array([getattr(row.joints, name) for row in rows], dtype=float).reshape(shape)
        for name in _SETPOINT_COLUMNS:
            columns[name] = np.array([getattr(row.setpoints, name) for row in rows], dtype=float).reshape(shape)
        return columns

    def _rows(self, joint_count: int) -> list["_Row"]:
        """Return a row for each armed tick at which joint state, applied setpoints and clock are all known.

        Pose and contacts may be published less often than joint states: a row has their newest samples.

        Args:
            joint_count: Number of joints; a joint state of another size is left out.
        """
        joint_states = self.messages_by_tick[keys.JOINTS]
        applied = self.messages_by_tick[keys.APPLIED]
        clocks = self.messages_by_tick[keys.CLOCK]
        poses = self.messages_by_tick[keys.POSE]
        contacts = self.contact_summaries
        rows: list[_Row] = []
        newest_pose = [np.nan] * 7
        peak_n = 0.0
        contact_count = 0
        for tick in sorted(joint_states.keys() | poses.keys() | contacts.keys()):
            if tick in poses:
                newest_pose = [*poses[tick].position_w, *poses[tick].orientation_wxyz]
            if tick in contacts:
                peak_n, contact_count = contacts[tick]
            is_complete = tick in joint_states and tick in applied and tick in clocks
            if not is_complete:
                continue
            joint_state = joint_states[tick]
            is_armed = bool(clocks[tick].arm_session)
            if is_armed and joint_state.has_joint_count(joint_count):
                rows.append(_Row(tick, joint_state, applied[tick], newest_pose, peak_n, contact_count))
        return rows

    def make_custom_columns(self, robot: Description, time_s: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return columns of the custom sensors: at each row the newest sample, and its age.

        Samples that cannot be decoded are counted in `refused`.

        Args:
            robot: The robot that has the sensors.
            time_s: (n,) robot time of each row.

        Returns:
            Columns (n,) by name. A sensor `left` that measures `bend_rad` has the columns `bend_rad.left` and
            `age_s.left`. A value is NaN before the first sample.
        """
        columns: dict[str, NDArray[np.float64]] = {}
        for key, message_type in find_custom_messages(robot).items():
            sensor = key.rpartition("/")[2]
            samples = self._custom_samples(key, message_type)
            ticks = np.array(sorted(samples), dtype=np.int64)
            sampled_s = ticks * (robot.period_ns * 1e-9)
            newest = _find_newest(sampled_s, time_s)
            in_order = [samples[tick] for tick in ticks.tolist()]

            # The dictionary keeps the order in which the samples name their numbers.
            number_names: dict[str, Any] = {}
            for _, numbers in samples.values():
                number_names |= dict.fromkeys(numbers)
            for name in number_names or message_type.units:
                quantity, dot, part = name.partition(".")
                values = [numbers.get(name, np.nan) for _, numbers in in_order]
                columns[f"{quantity}.{sensor}{dot}{part}"] = _values_at(values, newest)

            timestamps_s = [timestamp_ns * 1e-9 for timestamp_ns, _ in in_order]
            columns[f"age_s.{sensor}"] = time_s - _values_at(timestamps_s, newest)
        return columns

    def _custom_samples(self, key: str, kind: CustomMessage) -> dict[int, tuple[int, dict[str, float]]]:
        """Return the samples of a custom sensor: tick -> timestamp in ns, and numbers by name."""
        decoder = Decoder(kind.message)
        samples: dict[int, tuple[int, dict[str, float]]] = {}
        for recorded in self.custom.get(key, ()):
            try:
                sample = decoder.decode(recorded.payload, recorded.encoding)
            except WireError as error:
                self.refused[f"{key}: {error}"[:200]] += 1
                continue
            samples[sample.tick] = (sample.timestamp_ns, kind.numbers(sample))
        return samples

    def make_host_record(self, columns: dict[str, NDArray[Any]]) -> HostRecord:
        """Return the host's statistics of the run, as far as the recording shows them.

        Args:
            columns: Columns of the run by name, with a row for each tick, as in the black box.

        Raises:
            ConfigError: The recording holds no status of the host.
        """
        status = self.status
        if status is None:
            reasons = "; ".join(["", *self.missing])
            raise ConfigError(
                f"{self.path}: holds no hal/status, so it is not known what became of the run{reasons}",
                code="recording/missing-data",
            )
        clocks = self.messages_by_tick[keys.CLOCK]
        armed_ticks = {tick for tick, clock in clocks.items() if clock.lifecycle == "armed"}
        answered_ticks = armed_ticks & self.messages_by_tick[keys.JOINT_COMMAND].keys()
        wall_s = 0.0
        if self.armed_wall_ns:
            wall_s = (self.armed_wall_ns[-1] - self.armed_wall_ns[0]) * 1e-9
        return HostRecord(
            ticks=len(columns["tick"]),
            wall_s=wall_s,
            overruns=status.overruns,
            answered_ticks=len(answered_ticks),
            armed_ticks=len(armed_ticks),
            command_digest=compute_digest(columns),
            state_to_command_us={"p50": None, "p99": None},
            tick_times=status.tick_times,
            rejected_commands=status.commands_rejected,
            limited_commands=status.commands_limited,
            faults=status.faults,
            faults_left_out=status.faults_left_out,
            lifecycle=status.lifecycle,
            reason=status.reason,
            ended="finished",
            ended_why="as far as it was recorded",
            isolated=status.isolated,
        )


@dataclass(frozen=True)
class _Row:
    """One tick of a run. Pose and contacts are as of their newest sample."""

    tick: int
    joints: JointState
    setpoints: AppliedCommand
    pose: list[float]  # position in m, then orientation wxyz
    contact_peak_n: float
    contact_count: int


def make_telemetry_columns(states: Sequence[ControlState], time_s: Floats) -> dict[str, Floats]:
    """Return columns of the numbers that a controller defined: at each row the newest one, such as `gain.controller`.

    NaN: the newest message does not have the number, or none came yet.

    Args:
        states: The controller's messages, in time order.
        time_s: (n,) robot time of each row.
    """
    sent_s = np.array([state.timestamp_ns * 1e-9 for state in states])
    newest = _find_newest(sent_s, time_s)
    names = dict.fromkeys(name for state in states for name in state.custom)
    return {
        f"{name}.{CONTROLLER}": _values_at([state.custom.get(name, np.nan) for state in states], newest)
        for name in names
    }


def _find_newest(sampled_s: NDArray[np.floating[Any]], time_s: Floats) -> NDArray[np.int64]:
    """Return the index of the newest sample at each time, (n,); -1 before the first one.

    Args:
        sampled_s: Times of the samples, in order.
        time_s: (n,) times of the rows.
    """
    return np.searchsorted(sampled_s, time_s + SAME_TIME_S, side="right") - 1


def _values_at(values: list[float], index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the value of each index, (n,); NaN for a negative index."""
    picked = np.full(len(index), np.nan)
    known = index >= 0
    picked[known] = np.array(values, dtype=float)[index[known]]
    return picked


def read_recording(
    path: Path, selected_keys: Collection[str] = ALL, on_message: Callable[[RecordedMessage], None] | None = None
) -> RecordingContents:
    """Read the messages of a recording.

    Args:
        path: The recording, an MCAP file.
        selected_keys: The keys whose messages are decoded and returned.
        on_message: Called with every message, at any key, so that a caller need not read the file a second time.

    Returns:
        The messages, and what is missing in the file. Applied setpoints are counted even if their key is not selected.

    Raises:
        ConfigError: The file is no recording.
    """
    from snakesim_operator.recording.reader import RecordingReader  # needs the extra `record`

    contents = RecordingContents(path)
    reader = RecordingReader(path)
    keys_to_read = None  # all
    if on_message is None:
        keys_to_read = {*selected_keys, keys.APPLIED}
    for recorded in reader.read_messages(keys_to_read):
        if recorded.key == keys.APPLIED:
            contents.ticks += 1
            contents.last_tick_ns = recorded.time_ns
        if on_message is not None:
            on_message(recorded)
        if recorded.key in selected_keys or keys.find_row_key(recorded.key) in selected_keys:
            contents.add(recorded)

    contents.missing += describe_undecodable(contents.refused)
    contents.missing += [f"recording: {sentence}" for sentence in reader.missing]
    contents.finished = reader.finished
    contents.ticks_lost = _count_lost_ticks(reader)
    contents.replay_of = str(reader.metadata.get("replay_of", ""))[:500]
    if reader.losses.misplaced:
        for messages in contents.streams.values():
            messages.sort(key=lambda message: message.timestamp_ns or 0)
    return contents


def _count_lost_ticks(reader: "RecordingReader") -> int | None:
    """Return how many ticks the file itself reports as lost, or None if it cannot report that."""
    losses = reader.losses
    chosen_keys = reader.metadata.get("keys")  # of a recording that was to have these alone
    leaves_ticks_out = isinstance(chosen_keys, list) and keys.APPLIED not in chosen_keys
    if not reader.finished or losses.damage_count or leaves_ticks_out:
        return None
    return losses.lost_by_key[keys.APPLIED] + losses.dropped.get(keys.APPLIED, 0)


def _is_stored(before: Any, message: Any) -> bool:
    """Return whether a message is stored: worlds are thinned, and a path is stored once."""
    match message:
        case World():
            return message.timestamp_ns >= before.timestamp_ns + round(1e9 / MAX_WORLDS_PER_S)
        case Trajectory():
            return message.path_id != before.path_id
        case _:
            return True
