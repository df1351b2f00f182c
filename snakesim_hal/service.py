"""The interface of a service, and the loop around it.

The loop connects a service to its robot, calls it for every tick that is due, publishes its outputs, and reports to the
host that the tick is done.
"""

import contextlib
import traceback
from collections.abc import Callable, Iterator
from typing import Protocol

import msgspec

from snakesim_hal.base.errors import NotConnectedError, ServiceError, SnakesimError, WireError, raised
from snakesim_hal.faults.allowed import faults_of_service
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scenario import Service as Schedule
from snakesim_hal.network.client import Client
from snakesim_hal.network.process_entries import own_entry, show_process
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Description, Message

SILENCE_S = 1.0
MOST_SHOWN = 16  # keys
TRY_S = 2.0  # to meet the robot
START_LIMIT_S = 600.0  # until a part of a run is there: MuJoCo starts slowly in an emulated machine on a busy one


class Service(Protocol):
    """What stands behind an entry point in the group `snakesim.services`, and in `[services.NAME]` of a scenario.

    The constructor subscribes to everything that the service will read.
    """

    name: str
    urgent: bool = False  # whether the robot waits for this service in every tick
    too_slow: str = ""  # what shows that it cannot keep up in real time; empty: nothing does

    def __init__(self, client: Client, config: RunConfig) -> None: ...

    def configure(self, robot: Description) -> None:
        """Learn what robot is there; called before the first tick, and again when the HAL has started over."""
        ...

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """What to publish for a tick, as (key, message); None when the service is not able to say anything yet."""
        ...

    def silence(self) -> list[tuple[str, Message]]:
        """What to publish when the HAL's clock has been silent for a second."""
        return []

    def pause(self, clock: Clock) -> None:
        """Called some 20 times a second while a simulator is paused, for requests that need no tick."""


class ServiceLoop:
    """One service of one robot, over one session."""

    def __init__(
        self,
        service_type: type[Service],
        config: RunConfig,
        session: Session,
        goes_on: Callable[[], bool] = lambda: False,
    ) -> None:
        """Meets the robot. Raises NotConnectedError when there is none.

        goes_on: called after each try that found no robot; whether to try again.
        """
        name = service_type.name
        schedule = config.services.get(name, Schedule())
        self._who = f"service {schedule.code or name} (class {getattr(service_type, '__name__', service_type)})"
        self._module = service_type.__module__
        self._client = client = Client(session, name, decimation=schedule.decimation, clock_mode=config.clock_mode)
        with self._named("__init__"):
            self.service = service_type(client, config)
        robot = _met(client, goes_on)
        with self._named("configure"):
            self.service.configure(robot)
        self._faults = faults_of_service(name, config, session, robot, lambda: client.newest_clock)
        self._due = client.ticks(0.0, pauses=True)
        self._session, self._entry = session, own_entry(name, config)

    def join(self) -> None:
        """Show that the service is here. From now on the robot may be armed, perhaps before the first tick here."""
        clock = self._client.wait_for_clock(SILENCE_S)
        if clock is not None:
            self._faults.turn(clock.timestamp_ns, clock.arm_session, clock.lifecycle)
        self._shown = show_process(self._session, self._entry)
        self._client.announce()

    def run(self, over: Callable[[], bool] = lambda: False) -> None:
        """Act on every tick that is due, for as long as this process lives; over: or until it is true."""
        for clock in self._client.ticks(SILENCE_S, pauses=True):
            if over():
                return
            if clock is not None:
                self._act(clock)
                continue
            self._faults.idle()
            with self._named("silence"):
                for key, message in self.service.silence():
                    self._client.put(key, message)

    def act(self) -> None:
        """Act on the ticks that are due now, and return."""
        while (clock := next(self._due)) is not None:
            self._act(clock)

    def close(self) -> None:
        """Send nothing more that is late."""
        self._faults.close()

    def _act(self, clock: Clock) -> None:
        """A tick that is shown again, because the robot is not armed yet, is answered again."""
        if clock.paused:
            self._faults.idle()
            with self._named("pause"):
                self.service.pause(clock)
            return
        self._faults.turn(clock.timestamp_ns, clock.arm_session, clock.lifecycle)
        robot = self._client.new_description()
        if robot is not None:
            with self._named("configure"):
                self.service.configure(robot)
        with self._named("outputs"):
            outputs = self.service.outputs(clock)
            if clock.lifecycle != "armed":
                if keys.JOINTS in self._client.lacks:
                    outputs = None  # they come every tick; once armed it would be too late to hear of them
                self._show_waiting([] if outputs is not None else sorted(self._client.lacks)[:MOST_SHOWN])
            if outputs is None:
                return
            for key, message in outputs:
                self._client.put(key, message)
        self._client.done(clock.tick)

    def _show_waiting(self, lacks: list[str]) -> None:
        """Tell the host what this service waits for, so that whoever waits for the service knows it."""
        if lacks != self._entry.waits_for:
            self._entry = msgspec.structs.replace(self._entry, waits_for=lacks)
            self._shown.put(self._entry)

    @contextlib.contextmanager
    def _named(self, method: str) -> Iterator[None]:
        """Turn exceptions of a method into errors that name the service, which may be third-party code."""
        try:
            yield
        except WireError as error:
            raise ServiceError(f"{self._who}: {error.detail}") from None
        except SnakesimError:
            raise
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            raise ServiceError(f"{self._who}: {method}() {raised(error, self._module)}") from error


def _met(client: Client, goes_on: Callable[[], bool]) -> Description:
    while True:
        try:
            return client.description(TRY_S)
        except NotConnectedError:
            if not goes_on():
                raise
