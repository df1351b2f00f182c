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
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Clock,
    Contacts,
    ControlState,
    JointState,
    RobotDescription,
    RobotStatus,
    RunConfiguration,
    Trajectory,
    WorldModel,
)
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.results.contact_log import ContactCollector, ContactLog
from snakesim_operator.results.missing_data import describe_undecodable_messages

if TYPE_CHECKING:
    from snakesim_operator.recording.reader import RecordingReader

SERVICE_OUTPUT_KEYS = (keys.CONTROL_STATE, keys.WORLD, keys.TRAJECTORY)
"""Keys of the messages that guidance, navigation and control publish."""
OUTPUT_KEYS = (*SERVICE_OUTPUT_KEYS, keys.CUSTOM_ALL, keys.CONTACTS)
"""Keys of the messages that the black box of the host does not contain."""
# Last part of the names of columns with values that a controller defined.
CONTROLLER_SUFFIX = "controller"
TIME_TOLERANCE_S = 1e-9  # times that differ by less belong to the same tick
MAX_WORLDS_PER_S = 20.0  # as often as control publishes its state
# Keys whose messages belong to one tick each.
_TICK_KEYS = (keys.CLOCK, keys.JOINTS, keys.APPLIED, keys.POSE, keys.JOINT_COMMAND)
_JOINT_COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm")  # of the messages at keys.JOINTS
_SETPOINT_COLUMNS = ("target", "torque_limit_nm")  # of the messages at keys.APPLIED
RUN_KEYS: tuple[str, ...] = (*OUTPUT_KEYS, *_TICK_KEYS, keys.DESCRIPTION, keys.CONFIG, keys.STATUS)


_decoder: Callable[[type[Any]], MessageDecoder[Any]] = cache(MessageDecoder)


@dataclass(frozen=True)
class RunOutputs:
    """What services and custom sensors published in a run, and what of it is missing."""

    control: list[ControlState] = field(default_factory=list[ControlState])  # in time order
    # In time order, at most MAX_WORLDS_PER_S.
    worlds: list[WorldModel] = field(default_factory=list[WorldModel])
    # In time order, one for each path.
    trajectories: list[Trajectory] = field(default_factory=list[Trajectory])
    # By tick of a cycle of navigation.
    searched_nodes: dict[int, int] = field(default_factory=dict[int, int])
    # Columns that sensors and controllers define.
    custom: dict[str, Floats] = field(default_factory=dict[str, Floats])
    contact_log: ContactLog = field(default_factory=lambda: ContactCollector().make_log())
    replay_of: str = ""  # the recording whose sensors the services read; empty: a run
    missing: list[str] = field(default_factory=list[str])  # sentences about missing data
    # Those of them about data that never reached the recorder.
    unreached: list[str] = field(default_factory=list[str])


@dataclass
class RecordingContents:
    """What was read of one recording."""

    path: Path

    # The last message of each kind.
    description: RobotDescription | None = None
    config: RunConfiguration | None = None
    status: RobotStatus | None = None

    # Messages of the run.
    streams: dict[str, list[Any]] = field(
        default_factory=lambda: {key: [] for key in SERVICE_OUTPUT_KEYS}
    )
    messages_by_tick: dict[str, dict[int, Any]] = field(  # key -> tick -> message
        default_factory=lambda: {key: {} for key in _TICK_KEYS}
    )
    custom: dict[str, list[RecordedMessage]] = field(
        default_factory=dict[str, list[RecordedMessage]]
    )  # custom sensors
    contacts: ContactCollector = field(default_factory=ContactCollector)
    contact_summaries: dict[int, tuple[float, int]] = (
        field(  # tick -> strongest force in N, number of obstacles
            default_factory=dict[int, tuple[float, int]]
        )
    )
    # By tick of a cycle of navigation.
    searched_nodes: dict[int, int] = field(default_factory=dict[int, int])
    # Wall clock at each clock since the first arming.
    armed_wall_ns: list[int] = field(default_factory=list[int])
    replay_of: str = ""  # the recording whose sensors these are

    # Missing data.
    # Messages that cannot be decoded, by key and reason.
    undecodable_counts: Counter[str] = field(default_factory=Counter[str])
    missing: list[str] = field(default_factory=list[str])
    applied_tick_count: int = 0  # with setpoints as applied
    # Of these, as the file itself reports; None: it does not report that.
    lost_tick_count: int | None = 0
    last_applied_time_ns: int | None = None  # robot time of the last of them
    is_finished: bool = True  # the file has an end

    def add_message(self, recorded: RecordedMessage) -> None:
        """Decode and store one message at a key of RUN_KEYS. Messages are added in the order of the file."""
        if keys.find_row_key(recorded.key) == keys.CUSTOM_ALL:
            # Decoded later: their schema is in the description.
            self.custom.setdefault(recorded.key, []).append(recorded)
            return
        message_type = keys.find_message(recorded.key)
        if message_type is None:
            return
        try:
            message = _decoder(message_type).decode(recorded.payload, recorded.encoding)
            self._store_message(recorded.key, message, recorded.wall_time_ns)
        except WireError as error:
            self.undecodable_counts[f"{recorded.key}: {error}"[:200]] += 1

    def _store_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Store a decoded message by its type, if the record of a run needs it.

        Args:
            key: Key at which the message was published.
            message: The decoded message.
            wall_ns: Wall clock at which the message was recorded.
        """
        match message:
            case RobotDescription():
                self.description = message
            case RunConfiguration():
                self.config = message
            case RobotStatus():
                self.status = message
            case Clock(paused=True):
                pass  # a paused clock belongs to no tick
            case Trajectory():
                self.searched_nodes[message.tick] = message.searched_nodes
                self._add_to_stream(key, message)
            case WorldModel() | ControlState():
                self._add_to_stream(key, message)
            case Clock():
                self.messages_by_tick[key][message.tick] = message
                if message.arm_session:
                    self.armed_wall_ns.append(wall_ns)
            case Contacts():
                self.contacts.add_sample(message)
                self.contact_summaries[message.tick] = summarize_contacts(message)
            case _:
                self.messages_by_tick[key][message.tick] = message

    def _add_to_stream(self, key: str, message: Any) -> None:
        """Append a message of a service, unless it adds nothing to the last stored message of that key."""
        stream = self.streams[key]
        if not stream or _should_store(stream[-1], message):
            stream.append(message)

    def describe_unrecorded_ticks(self, ticks: int) -> list[str]:
        """Describe the ticks that did not reach the recorder, which the file itself cannot show.

        Args:
            ticks: Number of ticks of the run, as another source reports it.

        Returns:
            One sentence, or none if no tick was lost or if the number of lost ticks is unknown.
        """
        if self.lost_tick_count is None:
            return []
        lost = ticks - self.applied_tick_count - self.lost_tick_count
        if lost <= 0:
            return []
        if self.last_applied_time_ns is None:
            last = "it received none"
        else:
            last = f"the last one that it received is of {self.last_applied_time_ns * 1e-9:.2f} s"
        return [f"recording: {lost} of {ticks} ticks did not reach the recorder; {last}"]

    def collect_outputs(
        self, robot: RobotDescription, time_s: Floats, unreached: Sequence[str] = ()
    ) -> RunOutputs:
        """Collect what guidance, navigation, control and custom sensors published in the run.

        Args:
            robot: Description of the robot, with its custom sensors.
            time_s: (n,) robot time of each row in s, for the columns of custom sensors and controller telemetry.
            unreached: Sentences about data that did not reach the recorder.
        """
        control = self.streams[keys.CONTROL_STATE].copy()
        # At the end of a run the host stops its clock, and control reports PowerOff, which is not part of the run.
        while control and control[-1].state == "PowerOff":
            control.pop()

        # Messages of custom sensors are decoded only now, so further messages may turn out to be undecodable.
        counts_before = self.undecodable_counts.copy()
        sensor_columns = self.make_custom_columns(robot, time_s)
        newly_undecodable = describe_undecodable_messages(self.undecodable_counts - counts_before)

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

    def make_tick_columns(self, robot: RobotDescription) -> dict[str, NDArray[Any]]:
        """Make columns with a row for each tick since the first arming, with the names of the black box."""
        rows = self._build_tick_rows(len(robot.joints))
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
            columns[name] = np.array(
                [getattr(row.joints, name) for row in rows], dtype=float
            ).reshape(shape)
        for name in _SETPOINT_COLUMNS:
            columns[name] = np.array(
                [getattr(row.setpoints, name) for row in rows], dtype=float
            ).reshape(shape)
        return columns

    def _build_tick_rows(self, joint_count: int) -> list["_TickRow"]:
        """Build a row for each armed tick at which joint state, applied setpoints and clock are all known.

        Pose and contacts may be published less often than joint states: a row has their newest samples.

        Args:
            joint_count: Number of joints. A joint state of another size is left out.

        Returns:
            The rows in order of their ticks. The pose is NaN before its first sample; contacts are 0 before theirs.
        """
        joint_states = self.messages_by_tick[keys.JOINTS]
        applied_commands = self.messages_by_tick[keys.APPLIED]
        clocks = self.messages_by_tick[keys.CLOCK]
        poses = self.messages_by_tick[keys.POSE]
        contacts = self.contact_summaries
        rows: list[_TickRow] = []
        newest_pose = [np.nan] * 7
        contact_peak_n = 0.0
        contact_count = 0
        for tick in sorted(joint_states.keys() | poses.keys() | contacts.keys()):
            if tick in poses:
                newest_pose = [*poses[tick].position_w, *poses[tick].orientation_wxyz]
            if tick in contacts:
                contact_peak_n, contact_count = contacts[tick]
            is_complete = tick in joint_states and tick in applied_commands and tick in clocks
            if not is_complete:
                continue
            joint_state = joint_states[tick]
            is_armed = bool(clocks[tick].arm_session)
            if is_armed and joint_state.has_joint_count(joint_count):
                rows.append(
                    _TickRow(
                        tick,
                        joint_state,
                        applied_commands[tick],
                        newest_pose,
                        contact_peak_n,
                        contact_count,
                    )
                )
        return rows

    def make_custom_columns(
        self, robot: RobotDescription, time_s: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        """Make columns of the custom sensors, with the newest sample and its age in each row.

        Samples that cannot be decoded are counted.

        Args:
            robot: Description of the robot, with its custom sensors.
            time_s: (n,) robot time of each row, in s.

        Returns:
            Columns (n,) by name. A sensor `left` that measures `bend_rad` has the columns `bend_rad.left` and
            `age_s.left`. A value is NaN before the first sample.
        """
        columns: dict[str, NDArray[np.float64]] = {}
        for key, message_type in find_custom_messages(robot).items():
            sensor = key.rpartition("/")[2]
            samples = self._decode_custom_samples(key, message_type)
            ticks = np.array(sorted(samples), dtype=np.int64)
            sampled_s = ticks * (robot.period_ns * 1e-9)
            newest_index = _find_newest_sample_indices(sampled_s, time_s)
            samples_in_order = [samples[tick] for tick in ticks.tolist()]

            # A dictionary keeps the order in which the names first appear, which a set would not.
            value_names: dict[str, Any] = {}
            for _, numbers in samples.values():
                value_names |= dict.fromkeys(numbers)
            for name in value_names or message_type.units:
                quantity, dot, part = name.partition(".")
                values = [numbers.get(name, np.nan) for _, numbers in samples_in_order]
                columns[f"{quantity}.{sensor}{dot}{part}"] = _take_values(values, newest_index)

            timestamps_s = [timestamp_ns * 1e-9 for timestamp_ns, _ in samples_in_order]
            columns[f"age_s.{sensor}"] = time_s - _take_values(timestamps_s, newest_index)
        return columns

    def _decode_custom_samples(
        self, key: str, kind: CustomMessage
    ) -> dict[int, tuple[int, dict[str, float]]]:
        """Decode the samples of a custom sensor: timestamp in ns and values by name, for each tick."""
        decoder = MessageDecoder(kind.message)
        samples: dict[int, tuple[int, dict[str, float]]] = {}
        for recorded in self.custom.get(key, ()):
            try:
                sample = decoder.decode(recorded.payload, recorded.encoding)
            except WireError as error:
                self.undecodable_counts[f"{key}: {error}"[:200]] += 1
                continue
            samples[sample.tick] = (sample.timestamp_ns, kind.extract_numeric_values(sample))
        return samples

    def make_host_record(self, columns: dict[str, NDArray[Any]]) -> HostRecord:
        """Reconstruct the statistics of the host from the recording.

        Args:
            columns: Columns of the run by name, as of `make_tick_columns`.

        Raises:
            ConfigError: The recording contains no status of the host.
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
            ending_reason="as far as it was recorded",
            isolated=status.isolated,
        )


@dataclass(frozen=True)
class _TickRow:
    """One tick of a run. Pose and contacts are as of their newest sample."""

    tick: int
    joints: JointState
    setpoints: AppliedCommand
    pose: list[float]  # position in m, then orientation wxyz
    contact_peak_n: float
    contact_count: int


def make_telemetry_columns(states: Sequence[ControlState], time_s: Floats) -> dict[str, Floats]:
    """Make columns of the values that a controller defined, with the newest value in each row.

    Args:
        states: Messages of the controller, in time order.
        time_s: (n,) robot time of each row, in s.

    Returns:
        Columns (n,) by name, such as `gain.controller`. A value is NaN if the newest message does not have it, or
        before the first message.
    """
    sent_s = np.array([state.timestamp_ns * 1e-9 for state in states])
    newest_index = _find_newest_sample_indices(sent_s, time_s)
    names = dict.fromkeys(name for state in states for name in state.custom)
    return {
        f"{name}.{CONTROLLER_SUFFIX}": _take_values(
            [state.custom.get(name, np.nan) for state in states], newest_index
        )
        for name in names
    }


def _find_newest_sample_indices(
    sampled_s: NDArray[np.floating[Any]], time_s: Floats
) -> NDArray[np.int64]:
    """Find the index of the newest sample at each time, (n,); -1 before the first sample.

    Args:
        sampled_s: Times of the samples in s, in ascending order.
        time_s: (n,) times of the rows, in s.
    """
    return np.searchsorted(sampled_s, time_s + TIME_TOLERANCE_S, side="right") - 1


def _take_values(values: list[float], index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Take the value at each index, (n,); NaN for a negative index."""
    taken = np.full(len(index), np.nan)
    known = index >= 0
    taken[known] = np.array(values, dtype=float)[index[known]]
    return taken


def read_recording(
    path: Path,
    selected_keys: Collection[str] = RUN_KEYS,
    on_message: Callable[[RecordedMessage], None] | None = None,
) -> RecordingContents:
    """Read the messages of a recording, and determine what is missing in it.

    Args:
        path: Path of the recording, an MCAP file.
        selected_keys: Keys whose messages are decoded and returned.
        on_message: Called with every message of any key, so that a caller does not have to read the file again.

    Returns:
        The messages, and what is missing in the file. Applied setpoints are counted even if their key is not selected.

    Raises:
        ConfigError: The file is not a recording.
    """
    from snakesim_operator.recording.reader import RecordingReader  # needs the extra `record`

    contents = RecordingContents(path)
    reader = RecordingReader(path)
    keys_to_read = None  # None reads all keys, for `on_message`
    if on_message is None:
        keys_to_read = {*selected_keys, keys.APPLIED}
    for recorded in reader.read_messages(keys_to_read):
        if recorded.key == keys.APPLIED:
            contents.applied_tick_count += 1
            contents.last_applied_time_ns = recorded.robot_time_ns
        if on_message is not None:
            on_message(recorded)
        if recorded.key in selected_keys or keys.find_row_key(recorded.key) in selected_keys:
            contents.add_message(recorded)

    contents.missing += describe_undecodable_messages(contents.undecodable_counts)
    contents.missing += [f"recording: {sentence}" for sentence in reader.missing]
    contents.is_finished = reader.is_complete
    contents.lost_tick_count = _count_lost_ticks(reader)
    contents.replay_of = str(reader.metadata.get("replay_of", ""))[:500]
    if reader.losses.misplaced_count:
        for messages in contents.streams.values():
            messages.sort(key=lambda message: message.timestamp_ns or 0)
    return contents


def _count_lost_ticks(reader: "RecordingReader") -> int | None:
    """Return the number of ticks that the file itself reports as lost, or None if it cannot report that."""
    losses = reader.losses
    recorded_keys = reader.metadata.get("keys")  # only if the recorder was restricted to some keys
    excludes_ticks = isinstance(recorded_keys, list) and keys.APPLIED not in recorded_keys
    if not reader.is_complete or losses.damage_count or excludes_ticks:
        return None
    return losses.lost_by_key[keys.APPLIED] + losses.dropped_count_by_key.get(keys.APPLIED, 0)


def _should_store(last_stored: Any, message: Any) -> bool:
    """Return whether a message is stored: world models up to MAX_WORLDS_PER_S, and each path once."""
    match message:
        case WorldModel():
            return message.timestamp_ns >= last_stored.timestamp_ns + round(1e9 / MAX_WORLDS_PER_S)
        case Trajectory():
            return message.path_id != last_stored.path_id
        case _:
            return True
