"""A connection to a robot that is already running, for scripts and notebooks.

It reads the newest messages, waits for ticks, sends commands, arms and stops the robot, changes parameters, and
records what the robot publishes.
"""

import math
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from snakesim_hal.base.errors import (
    ConfigError,
    NotConnectedError,
    RefusedError,
    StalledError,
    suggest_word,
)
from snakesim_hal.base.process import get_user_name
from snakesim_hal.controller import make_position_setpoints
from snakesim_hal.network.commanding import READABLE_KEYS, CommandingClient
from snakesim_hal.network.endpoint import check_endpoint, check_namespace
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_hal.wire.custom_sample import find_message_type
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    JointState,
    LifecycleRequest,
    Message,
    Pose,
    RobotDescription,
    RobotStatus,
    make_arm_request,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.base.targets import find_robots
from snakesim_operator.recording.recorder_process import record_to_file
from snakesim_operator.robot_commands.command import request_while_commanding
from snakesim_operator.robot_commands.parameters import (
    RobotParameter,
    change_parameters,
    parse_parameters,
    read_parameters_in_force,
)
from snakesim_operator.robot_commands.stop import stop_robots

CONNECT_TIMEOUT_S = 5.0  # a robot may be starting
FIRST_MESSAGE_TIMEOUT_S = 1.0  # from the first read of a key until its first message
TICK_TIMEOUT_S = 2.0
ARM_TIMEOUT_S = 10.0
RECORDING_START_TIMEOUT_S = 10.0
POLL_INTERVAL_S = 0.0005


class Robot:
    """A connection to one robot. The first command takes the lease. The end of a `with` disarms what it has armed.

        with snakesim.Robot.connect() as robot:
            robot.arm()
            start_s = robot.wait()
            while (elapsed_s := robot.wait() - start_s) < 3:
                robot.command([0.2 * math.sin(elapsed_s)] * len(robot.joint_names))

    There is no thread: an armed robot needs a command in every tick. Without one its lease ends, and the robot stops
    with a fault.
    """

    def __init__(self, connection: ConnectionSettings) -> None:
        """Open a session to a robot whose link is known. `connect` finds the link.

        Args:
            connection: Endpoint, namespace and session file of the robot.

        Raises:
            NotConnectedError: The endpoint does not answer, or the robot publishes no description or status.
        """
        self._connection = connection
        self._exit_stack = ExitStack()
        self._session: Session = self._exit_stack.enter_context(
            open_session(connection, CONNECT_TIMEOUT_S)
        )

        # Messages.
        self._reader_by_key: dict[str, SampleReader[Any]] = {}
        self._newest_by_key: dict[str, Any] = {}

        # The right to command. The client exists from the first command on.
        self._command_client: CommandingClient | None = None
        self._is_armed_by_us = False  # whether this connection armed the robot

        try:
            self.description: RobotDescription = self._require_newest(
                keys.DESCRIPTION, RobotDescription
            )
            self._require_newest(keys.STATUS, RobotStatus)
            # In lockstep the clock publishes nothing while a controller computes, so its first message is not required.
            self._read_newest(keys.CLOCK, Clock, 0.0)
        except NotConnectedError:
            self._exit_stack.close()
            raise

    @staticmethod
    def connect(
        endpoint: str | None = None,
        *,
        name: str | None = None,
        session: str | os.PathLike[str] | None = None,
    ) -> "Robot":
        """Find a running robot, and connect to it.

        Args:
            endpoint: Zenoh endpoint of the robot's HAL host, such as "tcp/127.0.0.1:7447". None finds the only robot
                that runs on this computer.
            name: Namespace of the robot. Needed where there are several robots.
            session: Path of the Zenoh session file of a lab. The file names the endpoint.

        Returns:
            The open connection. Use it in a `with` statement, or call `close`.

        Raises:
            ConfigError: An argument is malformed, or both `endpoint` and `session` are set.
            NotConnectedError: No robot answers within CONNECT_TIMEOUT_S.
            RefusedError: Several robots answer.
        """
        selection = _make_robot_selection(endpoint, name, session)
        deadline = time.monotonic() + CONNECT_TIMEOUT_S
        links = find_robots(selection)
        while not links and time.monotonic() < deadline:
            time.sleep(POLL_INTERVAL_S)
            links = find_robots(selection)
        if not links:
            name_phrase = "" if selection.namespace is None else f" named {selection.namespace}"
            raise NotConnectedError(
                f"no robot{name_phrase} on {', '.join(selection.list_endpoints())}; is its HAL host running?",
                code="network/no-robot",
            )
        if len(links) > 1:
            choices = [f"  endpoint={link.endpoint!r}, name={link.namespace!r}" for link in links]
            raise RefusedError(
                "several robots found; choose one:", *choices, code="network/several-robots"
            )
        return Robot(links[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disarm the robot if this connection armed it, and close the session."""
        try:
            if self._is_armed_by_us:
                self.disarm()
        finally:
            self._exit_stack.close()

    @property
    def joint_names(self) -> list[str]:
        """The names of the joints, tail to head."""
        return [joint.name for joint in self.description.joints]

    @property
    def status(self) -> RobotStatus:
        """The newest status: lifecycle state, its reason, faults and counters.

        Raises:
            NotConnectedError: The robot publishes no status.
        """
        return self._require_newest(keys.STATUS, RobotStatus)

    @property
    def joints(self) -> JointState | None:
        """The newest state of all joints, or None before the first one."""
        return self.read(keys.JOINTS)

    @property
    def pose(self) -> Pose | None:
        """The newest pose of the base, or None if the robot has no sensor for it."""
        return self.read(keys.POSE)

    @property
    def contacts(self) -> Contacts | None:
        """The newest contacts, or None if the robot has no sensor for them."""
        return self.read(keys.CONTACTS)

    @property
    def time_s(self) -> float:
        """Robot time of the current tick in s. Before the first command, of the newest tick."""
        return self._current_clock.timestamp_ns * 1e-9

    def age_s(self, message: Any) -> float:
        """Return the age of a message in s of robot time.

        Args:
            message: Any message with a timestamp, as `read` returns it.
        """
        return self.time_s - message.timestamp_ns * 1e-9

    def read(self, key: str) -> Any:
        """Return the newest message at a key.

        From the first command on, joints, pose and contacts are those of the current tick.

        Args:
            key: Key of the key space without the namespace, such as "sensor/imu".

        Returns:
            The message, or None if there is none. The first read of a key waits up to FIRST_MESSAGE_TIMEOUT_S.

        Raises:
            ConfigError: There is no such key.
        """
        if self._command_client is not None and key in READABLE_KEYS:
            return self._command_client.read(key)
        message_type = keys.find_message(key)
        if message_type is None or "*" in key:
            known = [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]
            raise ConfigError(
                f"no key {key!r} in the key space; {suggest_word(key, known)}see schemas/keys.md",
                code="network/unknown-key",
            )
        message_type = find_message_type(key, self.description) or message_type
        # A robot that this connection commands needs its next command in time, so it does not wait for a message then.
        may_wait = key not in self._reader_by_key and self._command_client is None
        return self._read_newest(key, message_type, FIRST_MESSAGE_TIMEOUT_S if may_wait else 0.0)

    def wait(self) -> float:
        """Wait for the next tick. If this connection commands the robot, the lease is renewed meanwhile.

        Returns:
            Robot time of the tick in s.

        Raises:
            StalledError: No tick came within TICK_TIMEOUT_S.
            RefusedError: This connection armed the robot, and the robot is not armed any more.
        """
        if self._command_client is None:
            return self._wait_for_clock_tick()
        clock = self._command_client.wait_for_tick()
        if self._is_armed_by_us and clock.lifecycle != "armed":
            self._is_armed_by_us = False
            raise RefusedError(
                f"{self._connection.namespace} is no longer armed, but {clock.lifecycle}: {self.status.reason}",
                code="robot/not-armed",
            )
        return clock.timestamp_ns * 1e-9

    def command(self, angles_rad: Sequence[float] | RequestedSetpoints) -> None:
        """Send a setpoint for every joint in this tick. The first command takes the lease.

        Args:
            angles_rad: An angle for each joint in rad, tail to head, (joints,). Or `RequestedSetpoints`, which also
                choose the mode and the torque limit of each joint.

        Raises:
            ConfigError: The values are not one finite number for each joint.
            RefusedError: Another controller commands the robot, or the lease was lost.
        """
        if isinstance(angles_rad, RequestedSetpoints):
            setpoints = angles_rad
        else:
            setpoints = make_position_setpoints(self.description, list(angles_rad))
        self._validate_joint_values("target", setpoints.target)
        self._validate_joint_values("torque_limit_nm", setpoints.torque_limit_nm)
        self._get_command_client().send_setpoints(setpoints)

    def arm(self, *, unchecked: bool = False) -> None:
        """Take the lease and arm the robot. It holds its pose until the first command.

        Args:
            unchecked: Also arm a robot whose joints were not checked as they are now. See docs/hardware/calibration.md.

        Raises:
            RefusedError: The robot is not ready within ARM_TIMEOUT_S, or refuses, or disarms at once.
        """
        control = self._get_command_client()

        def explain_not_armed() -> str:
            return f"not armed: {self.status.reason}"

        control.command_until(lambda: self.status.ready_to_arm, ARM_TIMEOUT_S, explain_not_armed)
        previous_session = self._current_clock.arm_session
        self._request_and_wait(
            make_arm_request(self.description, get_user_name(), unchecked=unchecked), "armed"
        )
        control.command_until(
            lambda: self._current_clock.arm_session > previous_session,
            ARM_TIMEOUT_S,
            explain_not_armed,
        )
        if self._current_clock.lifecycle != "armed":
            raise RefusedError(
                f"not armed any more, but {self._current_clock.lifecycle}: {self.status.reason}",
                code="robot/not-armed",
            )
        self._is_armed_by_us = True

    def disarm(self) -> None:
        """Disarm the robot. Its joints become passive.

        Raises:
            RefusedError: The robot refuses, or does not confirm.
        """
        self._request_and_wait(
            LifecycleRequest(action="disarm", requester=get_user_name()), "disarmed"
        )
        self._is_armed_by_us = False

    def reset_fault(self) -> None:
        """Reset a fault or an emergency stop. The robot is disarmed afterwards.

        Raises:
            RefusedError: The cause is still present, or the robot does not confirm.
        """
        self._request_and_wait(LifecycleRequest(action="reset", requester=get_user_name()), "reset")

    def estop(self) -> None:
        """Trigger the emergency stop, over the stop port and over the network.

        Raises:
            RefusedError: The robot does not confirm the stop.
        """
        output: list[str] = []
        self._is_armed_by_us = False
        selection = RobotSelection(
            self._connection.endpoint, self._connection.namespace, self._connection.session
        )
        exit_code = stop_robots(selection, output.append)
        if exit_code:
            raise RefusedError(*output, code="robot/not-confirmed")

    @property
    def parameters(self) -> dict[str, RobotParameter]:
        """Parameters of the running controller by name, such as "control.amplitude_rad": value, unit, range, meaning.

        Raises:
            NotConnectedError: No controller is running.
        """
        parameters = parse_parameters(read_parameters_in_force(self._session))
        return {f"control.{parameter.name}": parameter for parameter in parameters}

    def set(self, changes: Mapping[str, Any]) -> None:
        """Change parameters of the running controller, all or none.

        Raises:
            ConfigError: There is no such parameter.
            RefusedError: Control refuses a value.
            ControllerError: Control has set the values and has ended, because the controller cannot continue with them.
        """
        change_parameters(self._session, changes, get_user_name())

    @contextmanager
    def record(self, path: str | os.PathLike[str]) -> Iterator[Path]:
        """Record everything that the robot publishes, during a `with` block.

        Args:
            path: The MCAP file to create.

        Yields:
            The path of the file.

        Raises:
            ConfigError: The file exists already, or cannot be written.
        """
        should_stop = threading.Event()
        has_started = threading.Event()
        link = replace(self._connection, max_bytes=MAX_IMAGE_BYTES)
        with ThreadPoolExecutor(1) as executor:
            recording = executor.submit(
                record_to_file,
                link,
                Path(path),
                lambda: not should_stop.is_set(),
                lambda *_: has_started.set(),
            )
            try:
                deadline = time.monotonic() + RECORDING_START_TIMEOUT_S
                # Ticks must continue while the recorder starts and ends, or an armed robot would lose its lease.
                while (
                    not has_started.is_set()
                    and not recording.done()
                    and time.monotonic() < deadline
                ):
                    self._tick_or_sleep()
                yield Path(path)
            finally:
                should_stop.set()
                while not recording.done():
                    self._tick_or_sleep()
                recording.result()

    def _get_command_client(self) -> CommandingClient:
        """Return the client that sends commands. The first call creates it, and it takes the lease."""
        if self._command_client is None:
            self._command_client = CommandingClient(
                self._session, self.description, self.status.clock_mode
            )
        return self._command_client

    def _validate_joint_values(self, name: str, values: Sequence[float]) -> None:
        """Raise ConfigError unless there is one finite number for each joint."""
        count = len(self.joint_names)
        expected = f"{name} is {values!r:.80}, must be {count} finite numbers, tail to head"
        if len(values) != count:
            raise ConfigError(f"{expected}; got {len(values)}", code="python/invalid-argument")
        if not all(math.isfinite(value) for value in values):
            raise ConfigError(expected, code="python/invalid-argument")

    def _request_and_wait(self, request: LifecycleRequest, done: str) -> None:
        """Send a lifecycle request and wait until the robot confirms it. The lease is renewed meanwhile."""
        request_while_commanding(
            self._session, request, done, self._connection, self._tick_or_sleep
        )

    def _tick_or_sleep(self) -> None:
        """Run one tick if this connection commands the robot, so that its lease stays valid; otherwise sleep."""
        if self._command_client is None:
            time.sleep(POLL_INTERVAL_S)
        else:
            self._command_client.command_tick()

    @property
    def _current_clock(self) -> Clock:
        if self._command_client is not None and self._command_client.clock is not None:
            return self._command_client.clock
        return self._require_newest(keys.CLOCK, Clock)

    def _wait_for_clock_tick(self) -> float:
        """Wait for the next tick of a robot that this connection does not command, and return its robot time in s."""
        previous_tick = self._current_clock.tick
        deadline = time.monotonic() + TICK_TIMEOUT_S
        clock = self._current_clock
        while clock.tick == previous_tick:
            if time.monotonic() > deadline:
                raise StalledError(
                    f"no tick of {self._connection.namespace} for {TICK_TIMEOUT_S:g} s"
                )
            time.sleep(POLL_INTERVAL_S)
            clock = self._current_clock
        return clock.timestamp_ns * 1e-9

    def _require_newest(self, key: str, message_type: type[Message]) -> Any:
        """Return the newest message of a key that every robot publishes. Raises NotConnectedError."""
        newest = self._read_newest(key, message_type, CONNECT_TIMEOUT_S)
        if newest is None:
            raise NotConnectedError(
                f"{self._connection.namespace} publishes nothing on {key}; is its HAL host running?",
                code="network/no-robot",
            )
        return newest

    def _read_newest(
        self, key: str, message_type: type[Message], first_message_timeout_s: float
    ) -> Any:
        """Return the newest message of a key, or None. Wait only for the first message of a key."""
        reader = self._get_reader(key, message_type)
        timeout_s = 0.0 if key in self._newest_by_key else first_message_timeout_s
        deadline = time.monotonic() + timeout_s
        newest = reader.pop_newest(self._fits_robot)
        while newest is None and time.monotonic() < deadline:
            time.sleep(POLL_INTERVAL_S)
            newest = reader.pop_newest(self._fits_robot)
        if newest is not None:
            self._newest_by_key[key] = newest
        return self._newest_by_key.get(key)

    def _get_reader(self, key: str, message_type: type[Message]) -> SampleReader[Any]:
        """Return the reader of a key; the first call subscribes to it."""
        reader = self._reader_by_key.get(key)
        if reader is None:
            row = keys.find_row(key)
            if row is not None and row.kind == "latched":
                reader = self._session.declare_latched_reader(key, message_type)
            else:
                reader = self._session.declare_reader(key, message_type)
            self._reader_by_key[key] = reader
        return reader

    def _fits_robot(self, message: Message) -> bool:
        """Whether a message fits the robot's description, as far as the description is known."""
        robot = self._newest_by_key.get(keys.DESCRIPTION)
        return robot is None or find_mismatch(message, robot) is None


def _make_robot_selection(
    endpoint: str | None, name: str | None, session: str | os.PathLike[str] | None
) -> RobotSelection:
    """Convert the arguments of `Robot.connect` to a selection of robots. Raises ConfigError if one is not valid."""
    if endpoint is not None:
        check_endpoint(endpoint, "endpoint")
    if name is not None:
        check_namespace(name, "name")
    if session is None:
        return RobotSelection(endpoint, name)
    if endpoint is not None:
        raise ConfigError(
            "endpoint and session: the session file names the endpoint; leave one out",
            code="command/conflicting-options",
        )
    file = read_session(Path(session))
    return RobotSelection(file.endpoints[0], file.resolve_namespace(name), file)
