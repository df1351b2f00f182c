"""The right to command one robot from this process, as its service `control`: a lease, and a command for each tick.

It is a client like any other. The host's limiter limits each command; without commands the lease ends within 50 to 100
ms, and an armed robot goes into its stop mode.

Threads: the thread that creates a `CommandingClient` makes every call. Commands are sent only while it is in a call,
so it must call `wait` or `turn` in every tick.
"""

import time
from collections.abc import Callable

from snakesim_hal.base.errors import RefusedError, StalledError
from snakesim_hal.base.process import tune_garbage_collector
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.network.client import Client, Commander, Feed
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, ClockMode, Contacts, Description, JointState, Message, Pose
from snakesim_hal.wire.setpoints import RequestedSetpoints

SILENCE_S = 2.0  # without a clock: the host has stalled
LOCKSTEP_SILENCE_S = 15.0  # longer than a host waits for another service by default: `stall_limit_s` is 10 s
LEASE_TIMEOUT_S = 20.0  # to get the lease, after at most one wait of the host for another service
READABLE_KEYS = {keys.JOINTS: JointState, keys.POSE: Pose, keys.CONTACTS: Contacts}


class CommandingClient:
    """Takes the place of the run's control service, from construction to the end of the session."""

    def __init__(self, session: Session, robot: Description, clock_mode: ClockMode) -> None:
        """Subscribe to the robot's samples, and wait until this client holds the command lease.

        Args:
            session: a session in the robot's namespace.
            robot: description of the robot.
            clock_mode: clock mode of the run.

        Raises:
            RefusedError: another client commands the robot.
            StalledError: the robot publishes no clock.
        """
        self._silence_s = LOCKSTEP_SILENCE_S if clock_mode == "lockstep" else SILENCE_S
        if session.present(keys.alive_key(CONTROL)):
            raise RefusedError(
                f"{robot.robot} has a controller already; to command it from here start it without one: "
                "--set services.control.external=true",
                code="robot/has-controller",
            )
        self._client = Client(session, CONTROL, clock_mode=clock_mode)
        self._feeds: dict[str, Feed] = {}
        for key, message in READABLE_KEYS.items():
            self._feeds[key] = self._client.subscribe(key, message)
        self._client.description()
        self._ticks = self._client.ticks(self._silence_s)
        self._commander = Commander(self._client, robot)
        self._last_setpoints: RequestedSetpoints | None = None
        self.clock: Clock | None = None  # of the current tick
        self._holds_lease = False
        tune_garbage_collector()  # looking through all objects of a notebook may take longer than a lease
        self._client.announce()
        self.turn_until(
            self._is_lease_shown,
            LEASE_TIMEOUT_S,
            lambda: f"no right to command {robot.robot}: {self._commander.refusal or 'the host has not answered'}",
        )

    def wait(self) -> Clock:
        """Wait for the next tick, and return its clock.

        If the last tick was not commanded, this reports it as done, because a lockstep host waits for its output.

        Raises:
            StalledError: no clock arrived within SILENCE_S, or in lockstep LOCKSTEP_SILENCE_S.
        """
        if self.clock is not None:
            self._client.report_done(self.clock.tick)
        clock = next(self._ticks)
        if clock is None:
            raise StalledError(f"no tick of the robot for {self._silence_s:g} s; is its HAL host running?")
        self.clock = clock
        self._holds_lease = self._commander.ensure_lease(clock)
        return clock

    def host_changed(self) -> bool:
        """Return whether another host drives the robot now, as after a restart. Acquire the lease again then."""
        return self._client.new_description() is not None

    def read(self, key: str) -> Message | None:
        """Return the sample of a key in READ that is valid at this tick, or None if there is none."""
        return self._client.read(self._feeds[key])

    @property
    def mine(self) -> bool:
        """Return whether this process holds the lease at this tick."""
        return self._holds_lease

    def send(self, points: RequestedSetpoints) -> None:
        """Command setpoints in this tick. Does nothing while no joint state has arrived.

        Raises:
            RefusedError: this process does not hold the lease.
        """
        joints = self.read(keys.JOINTS)
        if not isinstance(joints, JointState) or self.clock is None:
            return
        if not self._holds_lease:
            raise RefusedError(
                f"the right to command is lost: {self._commander.refusal or 'no command came in time'}",
                code="robot/lease-lost",
            )
        self._commander.send(self.clock, joints, points)
        self._last_setpoints = points

    def command_tick(self) -> None:
        """Wait for the next tick, and command it as before: hold still while not armed, then the last setpoints."""
        clock = self.wait()
        joints = self.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not self._holds_lease:
            return
        if clock.lifecycle != "armed" or self._last_setpoints is None:
            self._last_setpoints = self._commander.hold_position(joints)
        self.send(self._last_setpoints)

    def turn_until(self, condition: Callable[[], bool], limit_s: float, why: Callable[[], str]) -> None:
        """Command ticks as `turn` does until a condition is true.

        Args:
            condition: function that is called after each tick; True ends the wait.
            limit_s: maximum wall time until the condition is true.
            why: function that returns the text of the error.

        Raises:
            RefusedError: the condition is not true within `limit_s`.
        """
        deadline = time.monotonic() + limit_s
        while True:
            self.command_tick()
            if condition():
                return
            if time.monotonic() > deadline:
                raise RefusedError(why())

    def _is_lease_shown(self) -> bool:
        """Return whether the host's clock shows the lease, one tick after it was granted."""
        return self._holds_lease and self.clock is not None and self.clock.lease_epoch != 0
