"""The right to command one robot from this process, as its service `control`: a lease, and a command for each tick.

It is a client like any other. The host's limiter limits each command; without commands the lease ends within 50 to 100
ms, and an armed robot goes into its stop mode.
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

SILENCE_S = 2.0
LEASE_S = 10.0
READ = {keys.JOINTS: JointState, keys.POSE: Pose, keys.CONTACTS: Contacts}


class Commanding:
    """Takes the place of the run's control service, from construction to the end of the session."""

    def __init__(self, session: Session, robot: Description, clock_mode: ClockMode) -> None:
        """Takes the lease. Raises RefusedError when somebody else commands the robot."""
        if session.present(keys.alive(CONTROL)):
            raise RefusedError(
                f"{robot.robot} has a controller already; to command it from here start it without one: "
                "--set services.control.external=true"
            )
        self._client = Client(session, CONTROL, clock_mode=clock_mode)
        self._feeds: dict[str, Feed] = {key: self._client.subscribe(key, message) for key, message in READ.items()}
        self._client.description()
        self._ticks = self._client.ticks(SILENCE_S)
        self._commander = Commander(self._client, robot)
        self._last: RequestedSetpoints | None = None
        self.clock: Clock | None = None
        self._mine = False
        tune_garbage_collector()  # looking through all objects of a notebook may take longer than a lease
        self._client.announce()
        self.turn_until(self._lent, LEASE_S, lambda: f"no right to command {robot.robot}: {self._commander.refusal}")

    def wait(self) -> Clock:
        """The next tick. What was not commanded in the last one is told to the host, which may wait for it."""
        if self.clock is not None:
            self._client.done(self.clock.tick)
        clock = next(self._ticks)
        if clock is None:
            raise StalledError(f"no tick of the robot for {SILENCE_S:g} s; is its HAL host running?")
        self.clock, self._mine = clock, self._commander.holds(clock)
        return clock

    def host_changed(self) -> bool:
        """Whether another host drives the robot now, as after a restart; the lease is to be taken anew then."""
        return self._client.new_description() is not None

    def read(self, key: str) -> Message | None:
        """The sample that is valid at this tick; None when there is none."""
        return self._client.read(self._feeds[key])

    @property
    def mine(self) -> bool:
        """Whether the lease is ours at this tick."""
        return self._mine

    def send(self, points: RequestedSetpoints) -> None:
        """Command these in this tick. Raises RefusedError without the lease."""
        joints = self.read(keys.JOINTS)
        if not isinstance(joints, JointState) or self.clock is None:
            return
        if not self._mine:
            raise RefusedError(f"the right to command is lost: {self._commander.refusal or 'no command came in time'}")
        self._commander.send(self.clock, joints, points)
        self._last = points

    def turn(self) -> None:
        """A tick without news: stay while not armed, then go on with the last command."""
        clock, joints = self.wait(), self.read(keys.JOINTS)
        if not isinstance(joints, JointState) or not self._mine:
            return
        if clock.lifecycle != "armed" or self._last is None:
            self._last = self._commander.stay(joints)
        self.send(self._last)

    def turn_until(self, condition: Callable[[], bool], limit_s: float, why: Callable[[], str]) -> None:
        """Turn until then. Raises RefusedError after so long."""
        deadline = time.monotonic() + limit_s
        while True:
            self.turn()
            if condition():
                return
            if time.monotonic() > deadline:
                raise RefusedError(why())

    def _lent(self) -> bool:
        """Whether the host's clock shows the lease, which it does a tick after it was granted."""
        return self._mine and self.clock is not None and self.clock.lease_epoch != 0
