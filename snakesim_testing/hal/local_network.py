"""Runs a HAL host and its clients in threads of the test, which communicate over a real Zenoh network.

The backend moves its joints with a first-order lag.
"""

import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.errors import BackendError
from snakesim_hal.faults.allowed import create_host_faults
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host, HostOptions
from snakesim_hal.model.scenario import RunConfig, describe_run_robot
from snakesim_hal.network.client import Commander, HostClient
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageT
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    Fault,
    JointMode,
    JointState,
    LifecycleRequest,
    LifecycleState,
    Message,
    RobotDescription,
    RobotStatus,
    SensorDescription,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_testing.hal.small_robots import make_pose
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until

TickMessageT = TypeVar("TickMessageT", Clock, JointState)

LIMIT_S = 20.0


@contextmanager
def fast_thread_switching(interval_s: float = 0.0005) -> Iterator[None]:
    """Switch between threads often. Here host and client share one interpreter, elsewhere they are processes."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(interval_s)
    try:
        yield
    finally:
        sys.setswitchinterval(before_s)


def wait_for_messages(
    reader: SampleReader[MessageT], description: str, count: int = 1
) -> list[MessageT]:
    """Wait until a reader has received at least `count` messages, and return them."""
    messages: list[MessageT] = []

    def has_enough() -> bool:
        messages.extend(reader.drain())
        return len(messages) >= count

    wait_until(has_enough, description)
    return messages


def wait_for_tick(
    reader: SampleReader[TickMessageT], tick: int, description: str
) -> list[TickMessageT]:
    """Wait until a reader has received the message of a tick or a later one, and return all that it has received."""
    messages: list[TickMessageT] = []

    def has_received_tick() -> bool:
        messages.extend(reader.drain())
        return bool(messages) and messages[-1].tick >= tick

    wait_until(has_received_tick, description)
    return messages


@contextmanager
def connected_sessions(*namespaces: str | None) -> Iterator[list[Session]]:
    """Open one session for each namespace, on a network of their own. The first session listens."""
    with ExitStack() as stack:
        endpoint = find_free_endpoint()
        connections = [
            ConnectionSettings(endpoint, namespace, listen=index == 0)
            for index, namespace in enumerate(namespaces)
        ]
        yield [stack.enter_context(open_session(connection)) for connection in connections]


class LagBackend(Backend):
    """Moves joints to their setpoints with a first-order lag, without mass and contacts."""

    class Settings(msgspec.Struct):
        """This backend has no settings."""

    def __init__(self, config: RunConfig, settings: Any = None) -> None:
        self._config = config
        count = config.robot.chain.modules
        self._period_s = config.period_ns * 1e-9
        self.angles = [0.0] * count
        self._setpoints = SafeSetpoints([JointMode.PASSIVE] * count, [0.0] * count, [0.0] * count)
        self.enacted: list[SafeSetpoints] = []
        self.advanced = 0
        self.fails_in: str | None = (
            None  # the method that raises `fails_with`: sample, enact, advance or faults
        )
        self.fails_with: Exception = BackendError("diverged")
        self.read_s = 0.0  # duration of `sample`
        self.next_faults: list[Fault] = []

    def describe(self) -> RobotDescription:
        """Describe the robot of the configuration, with a pose sensor."""
        described = msgspec.structs.replace(
            describe_run_robot(self._config, "lag"), simulated_time=True
        )
        if any(sensor.key == keys.POSE for sensor in described.sensors):
            return described
        pose_sensor = SensorDescription(
            key=keys.POSE, rate_hz=0.2e9 / self._config.period_ns, delay_s=0.0
        )
        return msgspec.structs.replace(described, sensors=[*described.sensors, pose_sensor])

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the joint state, and in every fifth tick also the pose."""
        self._fail("sample")
        time.sleep(self.read_s)
        count = len(self.angles)
        joints = JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=list(self.angles),
            velocity_rad_s=[0.0] * count,
            torque_nm=[0.0] * count,
            valid=[True] * count,
            age_ns=[0] * count,
        )
        if tick % 5:
            return Samples(joints)
        return Samples(
            joints, {keys.POSE: make_pose(tick, timestamp_ns, position_w=(0.001 * tick, 0.0, 0.0))}
        )

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Keep the setpoints, which the joints follow in the next periods."""
        self._fail("enact")
        self._setpoints = setpoints
        self.enacted.append(setpoints)

    def advance(self) -> None:
        """Move the joints for one period."""
        self._fail("advance")
        self.advanced += 1
        for i, (mode, target) in enumerate(
            zip(self._setpoints.mode, self._setpoints.target, strict=True)
        ):
            if mode == JointMode.POSITION:
                self.angles[i] += 0.5 * (target - self.angles[i])
            elif mode == JointMode.VELOCITY:
                self.angles[i] += target * self._period_s

    def faults(self) -> list[Fault]:
        """Return the faults that the test has put into `next_faults`, once."""
        self._fail("faults")
        new_faults = self.next_faults
        self.next_faults = []
        return new_faults

    def close(self) -> None:
        """Do nothing, because this backend has no resources."""

    def _fail(self, method: str) -> None:
        """Raise the error of the test if it is planned for this method."""
        if self.fails_in == method:
            raise self.fails_with


@dataclass
class SineFollower:
    """A control service that holds the lease, and moves every joint along a sine of the robot's time."""

    amplitude_rad: float = 0.2
    name: str = "control"
    ticks_seen: list[int] = field(default_factory=list[int])
    armed_ticks: list[int] = field(default_factory=list[int])
    stopped: threading.Event = field(default_factory=threading.Event)
    # While it is set, the follower receives messages but sends none.
    silent: threading.Event = field(default_factory=threading.Event)

    def run(self, connection: ConnectionSettings) -> None:
        """Connect to the host, and answer its clock until `stopped` is set."""
        with open_session(connection) as session:
            client = HostClient(session, self.name)
            robot = client.wait_for_description()
            joints = client.subscribe(keys.JOINTS, JointState)
            commander = Commander(client, robot)
            client.announce()
            for clock in client.iterate_ticks(silence_timeout_s=0.02):
                if self.stopped.is_set():
                    return
                if clock is None or self.silent.is_set():
                    continue
                self._command_joints(clock, client, commander, client.read(joints), robot)

    def _command_joints(
        self,
        clock: Clock,
        client: HostClient,
        commander: Commander,
        joints: JointState | None,
        robot: RobotDescription,
    ) -> None:
        self.ticks_seen.append(clock.tick)
        if joints is not None and commander.ensure_lease(clock):
            setpoints = commander.make_hold_setpoints(joints)
            if clock.lifecycle == "armed":
                self.armed_ticks.append(clock.tick)
                phase_rad = 2 * math.pi * clock.timestamp_ns * 1e-9
                angle_rad = self.amplitude_rad * math.sin(phase_rad)
                setpoints = RequestedSetpoints(
                    setpoints.mode, [angle_rad] * len(robot.joints), setpoints.torque_limit_nm
                )
            commander.send_command(clock, joints, setpoints)
        client.report_done(clock.tick)


@dataclass
class RunningHost:
    """A HAL host that runs in a thread, and a client that watches it."""

    host: Host
    backend: LagBackend
    link: ConnectionSettings  # for clients
    session: Session  # of a client that watches
    thread: threading.Thread
    _statuses: SampleReader[RobotStatus]
    _status: RobotStatus | None = None

    @property
    def status(self) -> RobotStatus:
        """The newest status that the host has published. It waits for the first one."""
        wait_until(lambda: self._refresh() is not None, "a status")
        assert self._status is not None
        return self._status

    def _refresh(self) -> RobotStatus | None:
        new_statuses = self._statuses.drain()
        if new_statuses:
            self._status = new_statuses[-1]
        return self._status

    def request(self, key: str, request: Message) -> Answer:
        """Send a request to the host, and return its answer, which may be a refusal."""
        return self.session.send_request(key, request)

    def request_lifecycle(self, action: Any) -> Answer:
        """Request the host to "arm" with the right name of the robot, to "disarm", to "reset" or to "finish"."""
        config_hash = self.host.description.config_hash
        request = LifecycleRequest(
            action=action, robot="worm", backend="lag", config_hash=config_hash
        )
        return self.request(keys.LIFECYCLE, request)

    def arm(self) -> None:
        """Arm the robot as soon as the host is ready. On a busy machine the first request may come too early."""
        wait_until(lambda: self.status.ready_to_arm and self.request_lifecycle("arm").ok, "armed")

    def wait_for_lifecycle(self, lifecycle: str) -> None:
        """Wait until the host publishes this lifecycle state."""
        wait_until(lambda: self.status.lifecycle == lifecycle, f"lifecycle {lifecycle}")

    def has_ended(self) -> bool:
        """Return whether the thread of the host has ended."""
        return not self.thread.is_alive()


@contextmanager
def running_host(config: RunConfig, **options: Any) -> Iterator[RunningHost]:
    """Run a host of a `LagBackend` and a client that watches it, and stop the host at the end of the context.

    Args:
        config: Configuration of the run.
        **options: Fields of `HostOptions`.
    """
    endpoint = find_free_endpoint()
    backend = LagBackend(config)
    connection = ConnectionSettings(endpoint, "lab/worm")
    with (
        open_session(ConnectionSettings(endpoint, "lab/worm", listen=True)) as host_session,
        open_session(connection) as watcher,
    ):
        faulty_backend, faults = create_host_faults(config, GuardedBackend(backend), host_session)
        host = Host(config, faulty_backend, host_session, HostOptions(faults=faults, **options))
        thread = threading.Thread(target=host.run, name="host")
        statuses = watcher.declare_latched_reader(keys.STATUS, RobotStatus)
        thread.start()
        try:
            yield RunningHost(host, backend, connection, watcher, thread, statuses)
        finally:
            host.request_stop()
            thread.join(LIMIT_S)
            assert not thread.is_alive(), f"the host did not stop within {LIMIT_S:g} s"


@contextmanager
def running_commanded_host(
    config: RunConfig, ticks: int = 5, **options: Any
) -> Iterator[tuple[RunningHost, SineFollower]]:
    """Run an armed host and a follower that has already commanded it for more than `ticks` ticks.

    Args:
        config: Configuration of the run.
        ticks: Number of ticks with commands before the context is entered.
        **options: Fields of `HostOptions`.
    """
    with (
        running_host(config, **options) as run,
        running_follower(run.link, SineFollower()) as control,
    ):
        run.arm()
        wait_until(lambda: len(control.armed_ticks) > ticks, "commands")
        yield run, control


@contextmanager
def running_follower(
    connection: ConnectionSettings, follower: SineFollower
) -> Iterator[SineFollower]:
    """Run a follower in a thread, and stop it at the end of the context."""
    thread = threading.Thread(target=follower.run, args=(connection,), name=follower.name)
    thread.start()
    try:
        yield follower
    finally:
        follower.stopped.set()
        thread.join(LIMIT_S)
        assert not thread.is_alive(), f"the follower did not stop within {LIMIT_S:g} s"
