"""Replays the sensors of a recording into guidance, navigation and control, and compares what they command.

The services are those of a run, on a network within this process; the recording stands in for the host. They get the
recorded bytes, tick by tick, and a lease of the recorded number. From a run in lockstep the commands come out the same
to the bit. With a changed setting they differ, but the robot moves as it did: it shows what another gain would have
commanded in the situations of the recording, not where that would have led. Parameters that a client changed during the
run are changed in the same tick again.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
from threadpoolctl import threadpool_limits

from snakesim_hal.base.errors import ConfigError, SnakesimError, shorten
from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.model.plugins import is_file_plugin
from snakesim_hal.model.scenario import (
    CHOSEN_PREFIXES,
    KeyOverride,
    RunConfig,
    encode_config,
    load_scenario,
    write_config,
)
from snakesim_hal.network.local_network import LocalNetwork, LocalQuery
from snakesim_hal.network.streams import IncomingQuery, Publisher, ReceivedSample
from snakesim_hal.programs.preflight import load_service_class
from snakesim_hal.service import ServiceLoop
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import (
    Answer,
    AppliedCommand,
    Clock,
    ControlParameters,
    JointCommand,
    ParametersRequest,
    RobotDescription,
    RunConfiguration,
)
from snakesim_operator.playback.play import iterate_in_robot_time_order
from snakesim_operator.recording.message import RECORDING_FILENAME, RecordedMessage
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.recording_contents import RecordingContents, read_recording
from snakesim_operator.results.run_reader import CONFIG_FILENAME

SERVICE_OUTPUTS = {
    "guidance": (keys.WORLD,),
    "navigation": (keys.TRAJECTORY,),
    "control": (keys.JOINT_COMMAND, keys.CONTROL_STATE, keys.PARAMETERS_IN_FORCE),
}
"""Keys at which the replayed services publish. Recorded messages at these keys are not published again."""


@dataclass
class CommandComparison:
    """The commands of the recording and of the replay, by the tick whose joint state they respond to."""

    recorded: dict[int, JointCommand] = field(default_factory=dict[int, JointCommand])
    replayed: dict[int, JointCommand] = field(default_factory=dict[int, JointCommand])

    @property
    def common_ticks(self) -> list[int]:
        """Ticks with a command both in the recording and in the replay."""
        return sorted(self.recorded.keys() & self.replayed.keys())

    @property
    def differing_ticks(self) -> list[int]:
        """Ticks whose commands differ, or that have a command in only one of recording and replay."""
        unequal = {
            tick
            for tick in self.common_ticks
            if not are_same_commands(self.recorded[tick], self.replayed[tick])
        }
        in_only_one = self.recorded.keys() ^ self.replayed.keys()
        return sorted(unequal | in_only_one)

    def ignore_last_if_unanswered(self, last_tick: int) -> None:
        """Ignore the last tick if it has no recorded command: a run ends without waiting for that command."""
        if last_tick not in self.recorded:
            self.replayed.pop(last_tick, None)

    def ignore_after(self, last_tick: int) -> None:
        """Ignore the recorded commands after a tick, at which the replay ended."""
        self.recorded = {
            tick: command for tick, command in self.recorded.items() if tick <= last_tick
        }

    def find_largest_difference(self) -> tuple[int, int, float] | None:
        """Find the largest difference of a target: tick, joint index and magnitude. Returns None if there is none."""
        magnitudes: list[tuple[float, int, int]] = []
        for tick in self.common_ticks:
            targets = zip(self.recorded[tick].target, self.replayed[tick].target, strict=True)
            for joint, (recorded, replayed) in enumerate(targets):
                magnitudes.append((abs(recorded - replayed), tick, joint))
        magnitude, tick, joint = max(magnitudes, default=(0.0, 0, 0))
        return (tick, joint, magnitude) if magnitude else None


def are_same_commands(a: JointCommand, b: JointCommand) -> bool:
    """Return whether two commands are the same to the bit, apart from their sequence numbers.

    The sequence numbers depend on how often the service ran at tick 0, which does not affect the motors.
    """
    return (a.arm_session, a.mode, a.target, a.torque_limit_nm) == (
        b.arm_session,
        b.mode,
        b.target,
        b.torque_limit_nm,
    )


def load_recorded_config(
    contents: RecordingContents, overrides: list[KeyOverride], *, run_recorded_code: bool = False
) -> RunConfig:
    """Load the configuration of a recorded run, and apply changes.

    Args:
        contents: Contents of the recording.
        overrides: Changes of the configuration, from the command line.
        run_recorded_code: Whether a controller or service in a Python file is allowed if only the recording names it.
            A file that `overrides` names is always allowed.

    Raises:
        ConfigError: The recording has no valid configuration, or it names Python files that are not allowed.
    """
    if contents.config is None:
        raise ConfigError(
            f"{contents.path}: holds no hal/config, so it is not known which controller was at work",
            code="recording/missing-data",
        )
    with TemporaryDirectory(prefix="snakesim-") as folder:  # `load` reads a file
        path = Path(folder) / "config.json"
        path.write_text(contents.config.content)
        config = load_scenario(str(path), overrides).config
    if not run_recorded_code:
        overridden_keys = {override.key for override in overrides}
        _refuse_recorded_files(contents.path, config, overridden_keys)
    return config


def _refuse_recorded_files(path: Path, config: RunConfig, overridden_keys: set[str]) -> None:
    """Refuse to run a Python file that only the recording names, because its source may be untrusted.

    Files of the backend and of services that are not replayed do not run, so they are not checked.

    Args:
        path: Path of the recording, for the message.
        config: Configuration of the recording, with the changes of the command line.
        overridden_keys: Keys of the configuration that the command line sets, and that are therefore trusted.

    Raises:
        ConfigError: The controller or a replayed service is in a Python file that the command line does not name.
    """
    # Each plugin that would run: its key, the option that sets it, its role in words, and its name or file.
    plugins = [("controller", "--controller ", "its controller", config.controller)]
    for service in SERVICE_OUTPUTS:
        key = f"services.{service}.plugin"
        plugin = ""
        if service in config.internal_services:
            plugin = config.services[service].plugin
        plugins.append((key, f"--set {key}=", f"its service {service}", plugin))
    for key, option, role, plugin in plugins:
        if is_file_plugin(plugin) and key not in overridden_keys:
            raise ConfigError(
                f"{path}: the recording names {shorten(plugin)!r} as {role}, and would have that Python file run on "
                f"this computer. If you trust the file, name it yourself, with {option}{shorten(plugin)}, or run what "
                f"the recording names with --run-recorded-code; else choose an installed one with {option}NAME",
                code="recording/untrusted-code",
            )


class ControlReplay:
    """Runs services on the recorded sensor data of a run, in place of the services of that run."""

    def __init__(
        self,
        path: Path,
        overrides: list[KeyOverride],
        out: Path | None = None,
        *,
        run_recorded_code: bool = False,
    ) -> None:
        """Read the configuration of a recording, and prepare its replay.

        Args:
            path: Path of the recording.
            overrides: Changes of the recorded configuration.
            out: Path for a recording of the replay; None to record nothing.
            run_recorded_code: Whether to allow Python files that only the recording names.

        Raises:
            ConfigError: The recording cannot be replayed.
        """
        contents = read_recording(path, (keys.DESCRIPTION, keys.CONFIG, keys.CLOCK))
        self.missing = contents.missing
        self.config = load_recorded_config(contents, overrides, run_recorded_code=run_recorded_code)
        self.has_changed_settings = bool(overrides) and self.config != load_recorded_config(
            contents, [], run_recorded_code=True
        )
        if contents.description is None:
            raise ConfigError(f"{path}: holds no hal/description", code="recording/missing-data")
        self.robot: RobotDescription = contents.description
        self.clock_mode = self.config.clock_mode
        # Why the replay did not reach the end of an incomplete recording; empty if it did.
        self.stop_reason = ""
        self.comparison = CommandComparison()

        # What is replayed.
        self._path = path
        self._services = [name for name in SERVICE_OUTPUTS if name in self.config.internal_services]
        self._output_keys = {key for name in self._services for key in SERVICE_OUTPUTS[name]}
        self._output_keys |= {keys.done_key(name) for name in self._services}
        clocks: list[tuple[int, Clock]] = sorted(contents.messages_by_tick[keys.CLOCK].items())
        self._last_tick = clocks[-1][0] if clocks else -1
        self._epochs = [(tick, clock.lease_epoch) for tick, clock in clocks if clock.lease_epoch]

        # The network and the services on it.
        self._network = LocalNetwork()
        self._session = self._network.create_session()
        self._publishers: dict[str, Publisher[Any]] = {}
        self._service_loops: list[ServiceLoop] = []
        self._are_services_connected = False
        self._recording = RecordingWriter(out, self.config.robot.name) if out is not None else None

        # Commands.
        self._now_ns = 0
        self._recorded_by_sequence: dict[int, JointCommand] = {}
        self._command_decoder = MessageDecoder(JointCommand)
        self._applied_decoder = MessageDecoder(AppliedCommand)

        # Parameters of the controller.
        self._parameters_decoder = MessageDecoder(ControlParameters)
        self._overridden_parameters = {
            override.key.removeprefix(CHOSEN_PREFIXES[0]): override.value
            for override in overrides
            if override.key.startswith(CHOSEN_PREFIXES[0])
        }
        # Requests without a response yet.
        self._pending_changes: list[tuple[ControlParameters, LocalQuery]] = []

    def run(self) -> CommandComparison:
        """Replay the whole recording through the services, and return how their commands compare.

        If the recording is incomplete, a service may fail because a message is missing. The replay then stops there,
        and `stop_reason` has the reason.

        Raises:
            SnakesimError: A service failed, although the recording is complete.
        """
        with ExitStack() as stack:
            stack.enter_context(threadpool_limits(1))  # as in the run, for the same rounding
            if self._recording is not None:
                stack.callback(self._recording.close, {"replay_of": str(self._path)})
                for row in keys.SPACE:
                    self._session.on_latched_arrival(row.key, self._recording.write_arrival)
            self._session.on_query(keys.LEASE, self._grant_lease)
            self._session.on_arrival(keys.JOINT_COMMAND, self._store_replayed_command)
            self._publish_description()
            for name in self._services:
                service_loop = ServiceLoop(
                    load_service_class(self.config, name),
                    self.config,
                    self._network.create_session(),
                )
                stack.callback(service_loop.close)
                self._service_loops.append(service_loop)
            try:
                self._replay_messages()
                self.comparison.ignore_last_if_unanswered(self._last_tick)
            except SnakesimError as error:
                if not self.missing:
                    raise
                self.stop_reason = str(error)  # a service may fail because a message is lost
                last_replayed_tick = max(self.comparison.replayed, default=-1)
                self.comparison.ignore_after(last_replayed_tick)
        return self.comparison

    def _publish_description(self) -> None:
        """Publish the configuration and the description, as a host does at its start."""
        effective = RunConfiguration(
            config_hash=self.robot.config_hash, content=encode_config(self.config).decode()
        )
        self._session.declare_latched_publisher(keys.CONFIG, RunConfiguration).put(effective)
        self._session.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(self.robot)

    def _replay_messages(self) -> None:
        """Replay all messages of the recording, in the order of robot time."""
        for number, recorded in enumerate(iterate_in_robot_time_order(RecordingReader(self._path))):
            self._replay_message(recorded)
            if self._recording is not None and number % 1000 == 0:
                self._recording.flush_when_due()

    def _replay_message(self, recorded: RecordedMessage) -> None:
        """Publish a recorded message for the services, and step the services if it is a clock message.

        Messages that the replayed services publish themselves are not published, nor are configuration and description,
        which were published at the start. Recorded commands are stored for the comparison. Recorded changes of the
        parameters of the controller are requested again.

        Args:
            recorded: Next message of the recording, in order of robot time.
        """
        key = recorded.key
        message_type = keys.find_message(key)
        if message_type is None or recorded.encoding != format_encoding(message_type):
            return  # the message came from an unknown node
        self._now_ns = recorded.robot_time_ns
        is_service_output = key in self._output_keys
        if key == keys.JOINT_COMMAND:
            command = self._command_decoder.decode(recorded.payload, recorded.encoding)
            self.comparison.recorded[command.tick] = command
            self._recorded_by_sequence[command.sequence] = command
        if key == keys.PARAMETERS_IN_FORCE and is_service_output:
            parameters = self._parameters_decoder.decode(recorded.payload, recorded.encoding)
            self._request_recorded_parameters(parameters)
        if is_service_output or key in (keys.CONFIG, keys.DESCRIPTION):
            return

        payload = recorded.payload
        if key == keys.APPLIED and "control" in self._services:
            payload = self._make_applied_payload(recorded)
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._session.declare_publisher(key, message_type)
            self._publishers[key] = publisher
        publisher.send(payload)
        if key == keys.CLOCK:
            self._step_services()

    def _step_services(self) -> None:
        """Step every service with the newest clock message, then check the responses to parameter changes.

        The services are connected before their first step.

        Raises:
            ConfigError: The controller rejected a parameter change that is in the replayed recording.
        """
        if not self._are_services_connected:
            for service_loop in self._service_loops:
                service_loop.connect()
            self._are_services_connected = True
        for service_loop in self._service_loops:
            service_loop.step()
        still_pending: list[tuple[ControlParameters, LocalQuery]] = []
        for change, query in self._pending_changes:
            response = query.poll()
            if response is None:
                still_pending.append((change, query))
            elif not response.ok:
                raise ConfigError(
                    f"{self._path}: what {change.requester} set at tick {change.tick}: {response.reason}",
                    code="controller/unknown-parameter",
                )
        self._pending_changes = still_pending

    def _request_recorded_parameters(self, recorded: ControlParameters) -> None:
        """Request the parameters of the controller that the recording has, before the clock message of their tick.

        Parameters that the command line sets are not changed. Requests of another controller are ignored.

        Args:
            recorded: The recorded message about the parameters in force.
        """
        if recorded.requester is None or recorded.controller != self.config.controller[-64:]:
            return
        values = msgspec.json.decode(recorded.parameters, type=dict[str, Any])
        values |= self._overridden_parameters
        request = ParametersRequest(
            requester=recorded.requester,
            controller=recorded.controller,
            parameters=msgspec.json.encode(values).decode(),
        )
        self._pending_changes.append((recorded, self._session.send_query(keys.PARAMETERS, request)))

    def _make_applied_payload(self, recorded: RecordedMessage) -> bytes:
        """Make the applied setpoints that the host would have published after the replayed commands.

        If the replayed command is the same as the recorded one, or if either is unknown, these are the recorded
        setpoints. Otherwise they are those of the replayed command, without the limits of the command limiter.

        Args:
            recorded: The recorded message at `hal/applied`.

        Returns:
            The message as encoded bytes.
        """
        applied = self._applied_decoder.decode(recorded.payload, recorded.encoding)
        recorded_command = self._recorded_by_sequence.get(applied.sequence or -1)
        if recorded_command is None:
            return recorded.payload
        replayed_command = self.comparison.replayed.get(recorded_command.tick)
        if replayed_command is None or are_same_commands(recorded_command, replayed_command):
            return recorded.payload
        torque_limits_nm = replayed_command.torque_limit_nm
        if not torque_limits_nm:
            torque_limits_nm = [joint.torque_limit_nm for joint in self.robot.joints]
        replayed_applied = msgspec.structs.replace(
            applied,
            mode=replayed_command.mode,
            target=replayed_command.target,
            torque_limit_nm=torque_limits_nm,
            limited={},
        )
        return encode(replayed_applied)

    def _store_replayed_command(self, arrival: ReceivedSample) -> None:
        """Store a command of the replayed controller for the comparison."""
        command = self._command_decoder.decode(arrival.payload, arrival.encoding)
        self.comparison.replayed[command.tick] = command

    def _grant_lease(self, query: IncomingQuery) -> None:
        """Grant the lease with the next epoch in the recording."""
        now_tick = self._now_ns // self.robot.period_ns
        epoch = next((epoch for tick, epoch in self._epochs if tick >= now_tick), 1)
        query.reply(Answer(ok=True, reason="replayed", epoch=epoch, host=self.robot.host))


def replay_and_compare_commands(
    path: Path,
    overrides: list[KeyOverride],
    out: Path | None,
    print_text: PrintLine,
    *,
    run_recorded_code: bool = False,
) -> int:
    """Replay a recording through the services, and print how their commands differ from the recorded ones.

    Args:
        path: Path of the recording.
        overrides: Changes of the recorded configuration.
        out: Folder in which the replay is recorded as a run, which `snakesim study compare` reads; None to
            record nothing.
        print_text: Prints a line.
        run_recorded_code: Whether to allow Python files that only the recording names.

    Returns:
        The exit code: 0 if the commands are the same or a setting was changed, 1 if they differ although no setting was
        changed and nothing is missing, 3 if data is missing in the recording.

    Raises:
        ConfigError: The recording cannot be replayed, or `out` already contains a recording.
    """
    recording_path = None
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        recording_path = out / RECORDING_FILENAME
    try:
        replay = ControlReplay(path, overrides, recording_path, run_recorded_code=run_recorded_code)
    except FileExistsError:
        raise ConfigError(
            f"--out {out}: holds a recording already; choose another folder",
            code="file/already-exists",
        ) from None
    comparison = replay.run()
    if out is not None:
        write_config(replay.config, out / CONFIG_FILENAME)
        print_text(f"replayed: {out}; `snakesim study compare {path} {out}` shows the difference")

    if replay.stop_reason:
        last_tick = max(comparison.replayed, default=0)
        print_text(f"replayed up to tick {last_tick} only: {replay.stop_reason}")
    elif not comparison.recorded:
        raise ConfigError(
            f"{path}: holds no commands, on {keys.JOINT_COMMAND}", code="recording/missing-data"
        )
    are_same = _print_comparison(comparison, replay, print_text)
    if are_same or replay.has_changed_settings or replay.missing:
        return report_missing_data(path, replay.missing)
    return report_missing_data(path, replay.missing, 1)


def _print_comparison(
    comparison: CommandComparison, replay: ControlReplay, print_text: PrintLine
) -> bool:
    """Print how the commands differ, and return whether they are the same."""
    different = comparison.differing_ticks
    count = len(comparison.recorded.keys() | comparison.replayed.keys())
    if not different:
        print_text(f"{count} commands, the same to the bit")
        return True
    print_text(
        f"{len(different)} of {count} commands differ, the first answers tick {different[0]}"
    )
    largest_difference = comparison.find_largest_difference()
    if largest_difference is not None:
        tick, joint_index, magnitude = largest_difference
        print_text(
            f"largest difference of a target: {magnitude:.4g} at {replay.robot.joints[joint_index].name}, tick {tick}"
        )
    if replay.clock_mode != "lockstep":
        print_text(
            f"the run was {replay.clock_mode}: there a service acts on what has arrived, which only lockstep repeats"
        )
    return False
