"""A real backend of first-order joints, a host that runs it in a thread, and a client in another, over real Zenoh."""

import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

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

LIMIT_S = 20.0


@contextmanager
def fast_thread_switching(every_s: float = 0.0005) -> Iterator[None]:
    """Threads take turns so often: host and client share one interpreter here; in real life they are processes."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(every_s)
    try:
        yield
    finally:
        sys.setswitchinterval(before_s)


def wait_for_messages(reader: SampleReader[MessageT], what: str, count: int = 1) -> list[MessageT]:
    """What a reader has got, as soon as it is so many."""
    found: list[MessageT] = []
    wait_until(lambda: found.extend(reader.drain()) or len(found) >= count, what)
    return found


@contextmanager
def connected_sessions(*namespaces: str | None) -> Iterator[list[Session]]:
    """Sessions on a network of their own; the first one listens."""
    with ExitStack() as stack:
        endpoint = find_free_endpoint()
        links = [
            ConnectionSettings(endpoint, name, listen=not i) for i, name in enumerate(namespaces)
        ]
        yield [stack.enter_context(open_session(each)) for each in links]


class LagBackend(Backend):
    """Joints that follow their setpoints with a first-order lag. Neither mass nor contacts."""

    class Settings(msgspec.Struct):
        """None."""

    def __init__(self, config: RunConfig, settings: Any = None) -> None:
        self._config = config
        count = config.robot.chain.modules
        self._period_s = config.period_ns * 1e-9
        self.angles = [0.0] * count
        self._points = SafeSetpoints([JointMode.PASSIVE] * count, [0.0] * count, [0.0] * count)
        self.enacted: list[SafeSetpoints] = []
        self.advanced = 0
        self.fails_in: str | None = None  # sample, enact, advance or faults
        self.fails_with: Exception = BackendError("diverged")
        self.read_s = 0.0  # what a sample takes
        self.next_faults: list[Fault] = []

    def describe(self) -> RobotDescription:
        """From the robot file, and the pose."""
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
        """Joints every tick, the pose every fifth."""
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
        """From now on."""
        self._fail("enact")
        self._points = setpoints
        self.enacted.append(setpoints)

    def advance(self) -> None:
        """One period."""
        self._fail("advance")
        self.advanced += 1
        for i, (mode, target) in enumerate(
            zip(self._points.mode, self._points.target, strict=True)
        ):
            if mode == JointMode.POSITION:
                self.angles[i] += 0.5 * (target - self.angles[i])
            elif mode == JointMode.VELOCITY:
                self.angles[i] += target * self._period_s

    def faults(self) -> list[Fault]:
        """Those that the test planted."""
        self._fail("faults")
        found, self.next_faults = self.next_faults, []
        return found

    def close(self) -> None:
        """Nothing to release."""

    def _fail(self, where: str) -> None:
        if self.fails_in == where:
            raise self.fails_with


@dataclass
class SineFollower:
    """A control service: holds the lease and has every joint follow a sine of the robot's time."""

    amplitude_rad: float = 0.2
    name: str = "control"
    ticks_seen: list[int] = field(default_factory=list[int])
    armed_ticks: list[int] = field(default_factory=list[int])
    stopped: threading.Event = field(default_factory=threading.Event)
    # Receives everything, sends nothing.
    silent: threading.Event = field(default_factory=threading.Event)

    def run(self, connection: ConnectionSettings) -> None:
        """Until stopped."""
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
                self._act(clock, client, commander, client.read(joints), robot)

    def _act(
        self,
        clock: Clock,
        client: HostClient,
        commander: Commander,
        joints: JointState | None,
        robot: RobotDescription,
    ) -> None:
        self.ticks_seen.append(clock.tick)
        if joints is not None and commander.ensure_lease(clock):
            points = commander.make_hold_setpoints(joints)
            if clock.lifecycle == "armed":
                self.armed_ticks.append(clock.tick)
                wave = self.amplitude_rad * math.sin(2 * math.pi * clock.timestamp_ns * 1e-9)
                points = RequestedSetpoints(
                    points.mode, [wave] * len(robot.joints), points.torque_limit_nm
                )
            commander.send_command(clock, joints, points)
        client.report_done(clock.tick)


@dataclass
class RunningHost:
    """A host at work."""

    host: Host
    backend: LagBackend
    link: ConnectionSettings  # for clients
    session: Session  # of a client that watches
    thread: threading.Thread
    _statuses: SampleReader[RobotStatus]
    _status: RobotStatus | None = None

    @property
    def status(self) -> RobotStatus:
        """The newest that was published."""
        wait_until(lambda: self._refresh() is not None, "a status")
        assert self._status is not None
        return self._status

    def _refresh(self) -> RobotStatus | None:
        found = self._statuses.drain()
        self._status = found[-1] if found else self._status
        return self._status

    def request(self, key: str, request: Message) -> Answer:
        """Ask the host; a no is an answer too."""
        return self.session.send_request(key, request)

    def request_lifecycle(self, action: Any) -> Answer:
        """Arm (naming the robot rightly), disarm, reset or finish."""
        config_hash = self.host.description.config_hash
        request = LifecycleRequest(
            action=action, robot="worm", backend="lag", config_hash=config_hash
        )
        return self.request(keys.LIFECYCLE, request)

    def arm(self) -> None:
        """As soon as the host is ready: on a busy machine a status is soon out of date."""
        wait_until(lambda: self.status.ready_to_arm and self.request_lifecycle("arm").ok, "armed")

    def wait_for_lifecycle(self, lifecycle: str) -> None:
        """Wait for a state to be shown."""
        wait_until(lambda: self.status.lifecycle == lifecycle, f"lifecycle {lifecycle}")

    def has_ended(self) -> bool:
        """Whether the host's loop is over."""
        return not self.thread.is_alive()


@contextmanager
def running_host(config: RunConfig, **host: Any) -> Iterator[RunningHost]:
    """A host of a `LagBackend`, and a client that watches it. The host is stopped at the end."""
    endpoint, backend = find_free_endpoint(), LagBackend(config)
    link = ConnectionSettings(endpoint, "lab/worm")
    with (
        open_session(ConnectionSettings(endpoint, "lab/worm", listen=True)) as own,
        open_session(link) as watcher,
    ):
        faulty, faults = create_host_faults(config, GuardedBackend(backend), own)
        made = Host(config, faulty, own, HostOptions(faults=faults, **host))
        thread = threading.Thread(target=made.run, name="host")
        statuses = watcher.declare_latched_reader(keys.STATUS, RobotStatus)
        thread.start()
        try:
            yield RunningHost(made, backend, link, watcher, thread, statuses)
        finally:
            made.request_stop()
            thread.join(LIMIT_S)
            assert not thread.is_alive(), "the host did not stop"


@contextmanager
def running_commanded_host(
    config: RunConfig, ticks: int = 5, **host: Any
) -> Iterator[tuple[RunningHost, SineFollower]]:
    """A host that is armed, and a follower that has commanded it for more ticks than that."""
    with running_host(config, **host) as run, running_follower(run.link, SineFollower()) as control:
        run.arm()
        wait_until(lambda: len(control.armed_ticks) > ticks, "commands")
        yield run, control


@contextmanager
def running_follower(
    connection: ConnectionSettings, follower: SineFollower
) -> Iterator[SineFollower]:
    """A follower in a thread of its own."""
    thread = threading.Thread(target=follower.run, args=(connection,), name=follower.name)
    thread.start()
    try:
        yield follower
    finally:
        follower.stopped.set()
        thread.join(LIMIT_S)
        assert not thread.is_alive(), "the follower did not stop"
