"""The right to command one robot from this process, as its service `control`: a lease, and a command for each tick.

It is a client like any other. The host's limiter limits each command; without commands the lease ends within 50 to 100
ms, and an armed robot goes into its stop mode.

Threads: the thread that creates a `CommandingClient` makes every call. Commands are sent only while it is in a call,
so it must call `wait` or `command_tick` in every tick.
"""

import time
from collections.abc import Callable

from snakesim_hal.base.errors import RefusedError, StalledError
from snakesim_hal.base.process import tune_garbage_collector
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.network.client import Commander, HostClient, SampleFeed
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    ClockMode,
    Contacts,
    JointState,
    Message,
    Pose,
    RobotDescription,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints

CLOCK_TIMEOUT_S = 2.0  # without a clock: the host has stalled
# Longer than a host waits for another service by default: `stall_limit_s` is 10 s.
LOCKSTEP_CLOCK_TIMEOUT_S = 15.0
LEASE_TIMEOUT_S = 20.0  # to get the lease, after at most one wait of the host for another service
READABLE_KEYS = {keys.JOINTS: JointState, keys.POSE: Pose, keys.CONTACTS: Contacts}


class CommandingClient:
    """Takes the place of the run's control service, from construction to the end of the session."""

    def __init__(self, session: Session, robot: RobotDescription, clock_mode: ClockMode) -> None:
        """Subscribe to the robot's samples, and wait until this client holds the command lease.

        Args:
            session: Session in the robot's namespace.
            robot: Description of the robot.
            clock_mode: Clock mode of the run.

        Raises:
            RefusedError: The robot has a controller already, or the lease is not granted.
            StalledError: The robot publishes no clock.
        """
        self._clock_timeout_s = (
            LOCKSTEP_CLOCK_TIMEOUT_S if clock_mode == "lockstep" else CLOCK_TIMEOUT_S
        )
        if session.list_tokens(keys.alive_key(CONTROL)):
            raise RefusedError(
                f"{robot.robot} has a controller already; to command it from here start it without one: "
                "--set services.control.external=true",
                code="robot/has-controller",
            )
        self._client = HostClient(session, CONTROL, clock_mode=clock_mode)
        self._feeds: dict[str, SampleFeed] = {}
        for key, message in READABLE_KEYS.items():
            self._feeds[key] = self._client.subscribe(key, message)
        self._client.wait_for_description()
        self._ticks = self._client.iterate_ticks(self._clock_timeout_s)
        self._commander = Commander(self._client, robot)
        self._last_setpoints: RequestedSetpoints | None = None
        self.clock: Clock | None = None  # of the current tick
        self._holds_lease = False
        tune_garbage_collector()  # a collection of all objects of a notebook may take longer than a lease
        self._client.announce()
        self.command_until(
            self._is_lease_shown,
            LEASE_TIMEOUT_S,
            lambda: (
                f"no right to command {robot.robot}: {self._commander.lease_refusal or 'the host has not answered'}"
            ),
        )

    def wait_for_tick(self) -> Clock:
        """Wait for the next tick, and return its clock.

        First it reports the last tick as done, because a lockstep host waits for an output in each tick. If a command
        has answered that tick, nothing is sent, as a command implies it. At the end it requests the command lease if
        this process does not hold it; see `holds_lease`.

        Raises:
            StalledError: No clock arrived within CLOCK_TIMEOUT_S, or in lockstep LOCKSTEP_CLOCK_TIMEOUT_S.
        """
        if self.clock is not None:
            self._client.report_done(self.clock.tick)  # sends nothing for a commanded tick
        clock = next(self._ticks)
        if clock is None:
            raise StalledError(
                f"no tick of the robot for {self._clock_timeout_s:g} s; is its HAL host running?"
            )
        self.clock = clock
        self._holds_lease = self._commander.ensure_lease(clock)
        return clock

    def has_host_changed(self) -> bool:
        """Return whether another host may drive the robot since the last call, so that the lease is lost."""
        return self._client.fetch_changed_description() is not None

    def read(self, key: str) -> Message | None:
        """Return the sample of a key in READABLE_KEYS that is valid at this tick, or None if there is none."""
        return self._client.read(self._feeds[key])

    @property
    def holds_lease(self) -> bool:
        """Return whether this process holds the lease at this tick."""
        return self._holds_lease

    def send_setpoints(self, setpoints: RequestedSetpoints) -> None:
        """Send setpoints in this tick. Nothing is sent while no joint state has arrived.

        Args:
            setpoints: One mode, target and torque limit for each joint.

        Raises:
            RefusedError: This process does not hold the lease.
        """
        joints = self.read(keys.JOINTS)
        if not isinstance(joints, JointState) or self.clock is None:
            return
        if not self._holds_lease:
            raise RefusedError(
                f"the right to command is lost: {self._commander.lease_refusal or 'no command came in time'}",
                code="robot/lease-lost",
            )
        self._commander.send_command(self.clock, joints, setpoints)
        self._last_setpoints = setpoints

    def command_tick(self) -> None:
        """Wait for the next tick, and send the last setpoints. While the robot is not armed, hold the measured pose."""
        clock = self.wait_for_tick()
        joints = self.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not self._holds_lease:
            return
        if clock.lifecycle != "armed" or self._last_setpoints is None:
            self._last_setpoints = self._commander.make_hold_setpoints(joints)
        self.send_setpoints(self._last_setpoints)

    def command_until(
        self, condition: Callable[[], bool], timeout_s: float, describe_timeout: Callable[[], str]
    ) -> None:
        """Command ticks as `command_tick` does until a condition is true.

        Args:
            condition: Function that is called after each tick. True ends the wait.
            timeout_s: Maximum wall time in s until the condition is true.
            describe_timeout: Function that returns the text of the error after a timeout.

        Raises:
            RefusedError: The condition is not true in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            self.command_tick()
            if condition():
                return
            if time.monotonic() > deadline_s:
                raise RefusedError(describe_timeout())

    def _is_lease_shown(self) -> bool:
        """Return whether the host's clock shows the lease, one tick after it was granted."""
        return self._holds_lease and self.clock is not None and self.clock.lease_epoch != 0
