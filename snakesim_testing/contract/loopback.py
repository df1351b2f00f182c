"""Runs a backend behind the real HAL host, with a real client that commands it, over Zenoh on loopback."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Commander, HostClient
from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    Fault,
    JointCommand,
    JointMode,
    JointState,
    LifecycleRequest,
    LifecycleState,
    RobotDescription,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_testing.contract.rig import LEASE_HOLDER, JointTargets

TIMEOUT_S = 60.0  # for operations of a tenth of a second; a slow machine is not a failure
# Returns the commanded joints for a number of ticks since arming, or None to send nothing.
Plan = Callable[[int], "JointTargets | None"]


def hold_all_joints(_ticks: int) -> JointTargets:
    """Return a plan without commands, so that all joints hold their position."""
    return {}


def wait_until(condition: Callable[[], Any], description: str) -> None:
    """Wait until a condition returns a true value. Fails after TIMEOUT_S.

    Args:
        condition: The condition.
        description: Description of the condition, for the failure.
    """
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {TIMEOUT_S} s: {description}"
        time.sleep(0.002)


class RecordingBackend(Backend):
    """Forwards all calls to a backend, records the joint states, and can report a planted fault."""

    def __init__(self, inner: Backend) -> None:
        self._backend = inner
        self.joint_states: list[JointState] = []
        # For each tick, a fault to report besides those of the backend.
        self.planted_fault: Callable[[int], Fault | None] | None = None

    def describe(self) -> RobotDescription:
        return self._backend.describe()

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Sample the backend, and record the joint states."""
        samples = self._backend.sample(tick, timestamp_ns)
        self.joint_states.append(samples.joints)
        return samples

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        self._backend.enact(setpoints, lifecycle)

    def advance(self) -> None:
        self._backend.advance()

    def close(self) -> None:
        self._backend.close()

    def faults(self) -> list[Fault]:
        """Return the faults of the backend, and the planted one."""
        faults = self._backend.faults()
        planted = None
        if self.planted_fault is not None and self.joint_states:
            planted = self.planted_fault(self.joint_states[-1].tick)
        if planted is None:
            return faults
        return [*faults, planted]


@dataclass
class PlannedController:
    """A control service that commands joints by a plan, which is a function of the ticks since arming.

    A host accepts commands only from the holder of its command lease, and only those that name the current lease epoch
    and the current arm session. The epoch counts the leases, the arm session counts the armings. So a command from
    before an arming never moves a joint after it.
    """

    plan: Plan = hold_all_joints
    last_sent_tick: int = -1
    last_lease_epoch: int = 0  # lease epoch of the newest command that was sent
    arm_session: int = 0  # arm session of the newest command that was sent
    stop_event: threading.Event = field(default_factory=threading.Event)

    def run(self, connection: ConnectionSettings) -> None:
        """Connect to the host, and command it until `stop_event` is set.

        In every tick the controller acquires or renews the lease, and sends setpoints. Before an arming, these are the
        measured positions, which the host requires for arming. From the first tick of an arm session, the setpoints
        are the last positions that were measured before it, with the changes of the plan.

        Args:
            connection: How to reach the host.
        """
        with open_session(connection) as session:
            client = HostClient(session, LEASE_HOLDER)
            robot = client.wait_for_description()
            joint_state_subscription = client.subscribe(keys.JOINTS, JointState)
            commander = Commander(client, robot)
            client.announce()
            current_arm_session = -1  # the session that `armed_tick` belongs to
            armed_tick = -1  # first tick of that session
            # Setpoints that hold the newest positions before arming.
            held_setpoints: RequestedSetpoints | None = None
            for clock in client.iterate_ticks(silence_timeout_s=0.05):
                if self.stop_event.is_set():
                    return
                if clock is None:
                    continue
                measured_joints = client.read(joint_state_subscription)
                if measured_joints is None or not commander.ensure_lease(clock):
                    client.report_done(clock.tick)
                    continue
                if clock.lifecycle != "armed" or held_setpoints is None:
                    held_setpoints = commander.make_hold_setpoints(measured_joints)
                elif clock.arm_session != current_arm_session:
                    current_arm_session = clock.arm_session
                    armed_tick = clock.tick
                setpoints = self._plan_setpoints(clock, held_setpoints, clock.tick - armed_tick)
                if setpoints is not None:
                    commander.send_command(clock, measured_joints, setpoints)
                    self.last_sent_tick = clock.tick
                    self.last_lease_epoch = clock.lease_epoch
                    self.arm_session = clock.arm_session
                    client.report_done(clock.tick)

    def _plan_setpoints(
        self, clock: Clock, held_setpoints: RequestedSetpoints, ticks_since_arming: int
    ) -> RequestedSetpoints | None:
        """Return the setpoints of a tick: those that hold the position, changed by the plan while the robot is armed.

        Args:
            clock: Clock message of the tick, with the lifecycle state.
            held_setpoints: Setpoints that hold all joints.
            ticks_since_arming: Number of ticks since the arming.

        Returns:
            The setpoints, or None if the plan sends nothing in this tick.
        """
        targets: JointTargets | None = {}
        if clock.lifecycle == "armed":
            targets = self.plan(ticks_since_arming)
        if targets is None:
            return None
        mode = list(held_setpoints.mode)
        target = list(held_setpoints.target)
        for joint, (joint_mode, joint_target) in targets.items():
            mode[joint] = joint_mode
            target[joint] = joint_target
        return RequestedSetpoints(mode, target, held_setpoints.torque_limit_nm)


class HostedBackend:
    """The backend under test behind a real host, commanded by a real controller; both run in threads until `close`."""

    def __init__(self, backend: Backend, config: RunConfig) -> None:
        """Start a host with a backend, and a controller, in two threads that communicate over a loopback network.

        Args:
            backend: The backend under test, whose joint states are recorded.
            config: Configuration of the run.
        """
        link = ConnectionSettings(
            f"tcp/127.0.0.1:{find_free_port()}", f"contract/{config.robot.name}"
        )
        self.backend = RecordingBackend(backend)
        self.controller = PlannedController()
        self.config = config
        self.armed_tick = 0  # tick of the newest sample when the robot was armed last
        self._threads: list[threading.Thread] = []
        self._exit_stack = contextlib.ExitStack()
        self._exit_stack.callback(self.backend.close)
        self._exit_stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        # Host and controller share one interpreter here; otherwise they are processes.
        sys.setswitchinterval(0.0005)
        try:
            host_session = self._exit_stack.enter_context(open_session(replace(link, listen=True)))
            self.host = Host(config, GuardedBackend(self.backend), host_session)
            self.robot = self.host.description
            self.session: Session = self._exit_stack.enter_context(open_session(link))
            self._command_publisher = self.session.declare_publisher(
                keys.JOINT_COMMAND, JointCommand
            )
            # Commands that are sent earlier are lost.
            wait_until(self._command_publisher.has_subscriber, "the host subscribes to commands")
            self._start_thread("host", self.host.run, self.host.request_stop)
            self._start_thread(
                "controller", lambda: self.controller.run(link), self.controller.stop_event.set
            )
        except BaseException:
            self._exit_stack.close()
            raise

    @property
    def tick(self) -> int:
        """The tick of the newest sample."""
        return self.backend.joint_states[-1].tick if self.backend.joint_states else -1

    def request_lifecycle(self, action: Any) -> Answer:
        """Send a lifecycle request to the host, and return the answer.

        Args:
            action: The requested action, such as "arm".
        """
        robot = self.robot
        request = LifecycleRequest(
            action=action, robot=robot.robot, backend=robot.backend, config_hash=robot.config_hash
        )
        return self.session.send_request(keys.LIFECYCLE, request, timeout_s=10.0)

    def arm(self, plan: Plan) -> None:
        """Arm the robot from any state, and let the controller follow a plan. Fails if the host refuses for too long.

        Args:
            plan: Returns the commanded joints for a number of ticks since arming.
        """
        if self.host.authority.state == "armed":
            self.request_lifecycle("disarm")
        elif self.host.authority.state != "disarmed":
            self.request_lifecycle("reset")
        self.controller.plan = plan
        deadline_s = time.monotonic() + TIMEOUT_S
        while not (response := self.request_lifecycle("arm")).ok and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert response.ok, f"the robot cannot be armed: {response.reason}"
        self.armed_tick = self.tick

    def wait_for_lifecycle(self, state: LifecycleState) -> None:
        """Wait until the host is in a lifecycle state. Fails if the host ends in another state."""
        wait_until(
            lambda: self.host.authority.state == state or not self._are_threads_alive(),
            f"lifecycle {state}",
        )
        assert self.host.authority.state == state, self.host.authority.reason

    def wait_for_ticks(self, tick_count: int) -> list[JointState]:
        """Wait until the host has run some more ticks, and return the joint states of these ticks."""
        first_index = len(self.backend.joint_states)
        wait_until(
            lambda: (
                len(self.backend.joint_states) >= first_index + tick_count
                or not self._are_threads_alive()
            ),
            f"{tick_count} ticks",
        )
        assert len(self.backend.joint_states) >= first_index + tick_count, (
            f"the host ended: {self.host.authority.reason}"
        )
        return self.backend.joint_states[first_index:]

    def send_forged_command(self, **invalid_fields: Any) -> None:
        """Publish a command that would move the joints if the host accepted it.

        Args:
            invalid_fields: Invalid values by name of the field; all other fields are valid.
        """
        count = len(self.robot.joints)
        valid_fields: dict[str, Any] = {
            "tick": self.tick,
            "sequence": 2**40,
            "lease_epoch": self.controller.last_lease_epoch,
            "arm_session": self.controller.arm_session,
            "layout": self.robot.layout,
            "valid_for_ns": self.robot.lease_ns,
            "mode": [JointMode.POSITION] * count,
            "target": [0.5] * count,
        }
        self._command_publisher.put(JointCommand(**(valid_fields | invalid_fields)))

    def close(self) -> None:
        """Stop controller and host, and close their sessions and the backend."""
        self._exit_stack.close()

    def _start_thread(self, name: str, run: Callable[[], None], stop: Callable[[], None]) -> None:
        thread = threading.Thread(target=run, name=name, daemon=True)
        self._threads.append(thread)

        def end() -> None:
            stop()
            thread.join(TIMEOUT_S)

        thread.start()
        self._exit_stack.callback(end)

    def _are_threads_alive(self) -> bool:
        return all(thread.is_alive() for thread in self._threads)
