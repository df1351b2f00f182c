"""A backend behind the real host, with a real client that commands it and an observer, over Zenoh on loopback."""

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
from snakesim_hal.network.client import Client, Commander
from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    Description,
    Fault,
    JointCommand,
    JointState,
    LifecycleRequest,
    LifecycleState,
    Mode,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_testing.contract.rig import HOLDER, JointTargets

LIMIT_S = 60.0  # for operations of a tenth of a second; a slow machine is not a failure
Plan = Callable[[int], "JointTargets | None"]  # ticks since arming -> commanded joints; None: send nothing


def stay(_ticks: int) -> JointTargets:
    """Command no joint: all hold their position."""
    return {}


def wait_until(happened: Callable[[], Any], what: str) -> None:
    """Wait until a condition holds. Fails with a description of the condition after LIMIT_S."""
    deadline = time.monotonic() + LIMIT_S
    while not happened():
        assert time.monotonic() < deadline, f"not within {LIMIT_S} s: {what}"
        time.sleep(0.002)


class RecordingBackend(Backend):
    """Forwards all calls to a backend, records the joint states, and can report a planted fault."""

    def __init__(self, inner: Backend) -> None:
        self._inner = inner
        self.joint_states: list[JointState] = []
        # For each tick, a fault to report besides those of the backend.
        self.planted_fault: Callable[[int], Fault | None] | None = None

    def describe(self) -> Description:
        return self._inner.describe()

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Sample the backend, and record the joint states."""
        samples = self._inner.sample(tick, timestamp_ns)
        self.joint_states.append(samples.joints)
        return samples

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        self._inner.enact(setpoints, lifecycle)

    def advance(self) -> None:
        self._inner.advance()

    def close(self) -> None:
        self._inner.close()

    def faults(self) -> list[Fault]:
        """Return the faults of the backend, and the planted one."""
        faults = self._inner.faults()
        planted = None
        if self.planted_fault is not None and self.joint_states:
            planted = self.planted_fault(self.joint_states[-1].tick)
        if planted is None:
            return faults
        return [*faults, planted]


@dataclass
class Controller:
    """A control service that commands joints by a plan, which counts ticks from the arming.

    A host accepts commands only from the holder of its command lease, and only those that name the present lease epoch
    and the present arm session. The epoch counts the leases, the arm session counts the armings. So a command from
    before an arming never moves a joint after it.
    """

    plan: Plan = stay
    last_sent_tick: int = -1
    epoch: int = 0  # lease epoch of the newest command that was sent
    arm_session: int = 0  # arm session of the newest command that was sent
    stopped: threading.Event = field(default_factory=threading.Event)

    def run(self, link: Link) -> None:
        """Connect to the host and command it until stopped.

        In every tick it acquires or renews the lease, and sends setpoints. Before an arming, these are the measured
        positions, which the host requires for arming. From the first tick of an arm session, the setpoints are the
        last measured positions with the changes of the plan.

        Args:
            link: to the host.
        """
        with open_session(link) as session:
            client = Client(session, HOLDER)
            robot = client.description()
            joints = client.subscribe(keys.JOINTS, JointState)
            commander = Commander(client, robot)
            client.announce()
            arm_session = -1  # the session that `armed_tick` is about
            armed_tick = -1  # first tick of that session
            held_setpoints: RequestedSetpoints | None = None  # that hold the newest positions from before the arming
            for clock in client.ticks(silence_s=0.05):
                if self.stopped.is_set():
                    return
                if clock is None:
                    continue
                measured = client.read(joints)
                if measured is None or not commander.ensure_lease(clock):
                    client.report_done(clock.tick)
                    continue
                if clock.lifecycle != "armed" or held_setpoints is None:
                    held_setpoints = commander.hold_position(measured)
                elif clock.arm_session != arm_session:
                    arm_session = clock.arm_session
                    armed_tick = clock.tick
                setpoints = self._plan_setpoints(clock, held_setpoints, clock.tick - armed_tick)
                if setpoints is not None:
                    commander.send(clock, measured, setpoints)
                    self.last_sent_tick = clock.tick
                    self.epoch = clock.lease_epoch
                    self.arm_session = clock.arm_session
                    client.report_done(clock.tick)

    def _plan_setpoints(
        self, clock: Clock, held_setpoints: RequestedSetpoints, ticks: int
    ) -> RequestedSetpoints | None:
        """Return the setpoints of a tick: those that hold the position, changed by the plan while the robot is armed.

        Args:
            clock: the tick, and the lifecycle state in it.
            held_setpoints: setpoints that hold all joints.
            ticks: since the arming.

        Returns:
            The setpoints; None if the plan sends nothing in this tick.
        """
        targets: JointTargets | None = {}
        if clock.lifecycle == "armed":
            targets = self.plan(ticks)
        if targets is None:
            return None
        mode = list(held_setpoints.mode)
        target = list(held_setpoints.target)
        for joint, (joint_mode, joint_target) in targets.items():
            mode[joint] = joint_mode
            target[joint] = joint_target
        return RequestedSetpoints(mode, target, held_setpoints.torque_limit_nm)


class Hosted:
    """Runs host and controller in threads until `close`, each with its own session, and observes them."""

    def __init__(self, backend: Backend, config: RunConfig) -> None:
        """Start a host with a backend, and a controller, in two threads that communicate over a loopback network.

        Args:
            backend: the backend under test, whose calls are recorded.
            config: configuration of the run.
        """
        link = Link(f"tcp/127.0.0.1:{find_free_port()}", f"contract/{config.robot.name}")
        self.backend = RecordingBackend(backend)
        self.controller = Controller()
        self.config = config
        self.armed_at = 0  # tick of the newest sample when the robot was armed last
        self._threads: list[threading.Thread] = []
        self._opened = contextlib.ExitStack()
        self._opened.callback(self.backend.close)
        self._opened.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(0.0005)  # host and controller share one interpreter here; otherwise they are processes
        try:
            host_session = self._opened.enter_context(open_session(replace(link, listen=True)))
            self.host = Host(config, GuardedBackend(self.backend), host_session)
            self.robot = self.host.description
            self.session: Session = self._opened.enter_context(open_session(link))
            self._commands = self.session.publisher(keys.JOINT_COMMAND, JointCommand)
            wait_until(self._commands.has_subscriber, "the host receives our commands")  # earlier ones are lost
            self._start("host", self.host.run, self.host.stop)
            self._start("controller", lambda: self.controller.run(link), self.controller.stopped.set)
        except BaseException:
            self._opened.close()
            raise

    @property
    def tick(self) -> int:
        """The tick of the newest sample."""
        return self.backend.joint_states[-1].tick if self.backend.joint_states else -1

    def lifecycle(self, action: Any) -> Answer:
        """Send a lifecycle request, which names the robot, the backend and the configuration."""
        robot = self.robot
        request = LifecycleRequest(
            action=action, robot=robot.robot, backend=robot.backend, config_hash=robot.config_hash
        )
        return self.session.request(keys.LIFECYCLE, request, timeout_s=10.0)

    def arm(self, plan: Plan) -> None:
        """Arm from any state; the controller acts by the plan from then on."""
        if self.host.authority.state == "armed":
            self.lifecycle("disarm")
        elif self.host.authority.state != "disarmed":
            self.lifecycle("reset")
        self.controller.plan = plan
        deadline = time.monotonic() + LIMIT_S
        while not (answer := self.lifecycle("arm")).ok and time.monotonic() < deadline:
            time.sleep(0.01)
        assert answer.ok, f"the robot cannot be armed: {answer.reason}"
        self.armed_at = self.tick

    def wait_for_lifecycle(self, state: LifecycleState) -> None:
        """Wait for a lifecycle state."""
        wait_until(
            lambda: self.host.authority.state == state or not self._threads_live(),
            f"lifecycle {state}",
        )
        assert self.host.authority.state == state, self.host.authority.reason

    def wait_for_ticks(self, periods: int) -> list[JointState]:
        """Wait for this many more ticks, and return their joint states."""
        since = len(self.backend.joint_states)
        wait_until(
            lambda: len(self.backend.joint_states) >= since + periods or not self._threads_live(), f"{periods} ticks"
        )
        assert len(self.backend.joint_states) >= since + periods, f"the host ended: {self.host.authority.reason}"
        return self.backend.joint_states[since:]

    def send_forged_command(self, **wrong: Any) -> None:
        """Publish a command that would turn the first joint.

        Args:
            wrong: invalid values by field; all other fields are valid.
        """
        count = len(self.robot.joints)
        valid_fields: dict[str, Any] = {
            "tick": self.tick,
            "sequence": 2**40,
            "lease_epoch": self.controller.epoch,
            "arm_session": self.controller.arm_session,
            "layout": self.robot.layout,
            "valid_for_ns": self.robot.lease_ns,
            "mode": [Mode.POSITION] * count,
            "target": [0.5] * count,
        }
        self._commands.put(JointCommand(**(valid_fields | wrong)))

    def close(self) -> None:
        """Stop everything and close the backend."""
        self._opened.close()

    def _start(self, name: str, run: Callable[[], None], stop: Callable[[], None]) -> None:
        thread = threading.Thread(target=run, name=name, daemon=True)
        self._threads.append(thread)

        def end() -> None:
            stop()
            thread.join(LIMIT_S)

        thread.start()
        self._opened.callback(end)

    def _threads_live(self) -> bool:
        return all(thread.is_alive() for thread in self._threads)
