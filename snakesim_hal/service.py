"""The interface of a service, and the loop around it.

The loop connects a service to its robot, calls it for every tick that is due, publishes its outputs, and reports to the
host that the tick is done.
"""

import contextlib
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import ClassVar

import msgspec

from snakesim_hal.base.errors import (
    NotConnectedError,
    ServiceError,
    SnakesimError,
    WireError,
    describe_exception,
)
from snakesim_hal.faults.allowed import create_service_faults
from snakesim_hal.model.scenario import RunConfig, ServiceSchedule
from snakesim_hal.network.client import HostClient
from snakesim_hal.network.process_entries import make_own_entry, publish_process_entry
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Message, RobotDescription

SILENCE_S = 1.0  # a clock that is silent for longer has stopped
MAX_SHOWN_KEYS = 16  # bound of `waits_for` in a process entry
CONNECT_ATTEMPT_S = 2.0  # duration of one attempt to find the robot
# Until every part of a run has started: MuJoCo starts slowly in an emulated, busy machine.
SERVICE_START_LIMIT_S = 600.0


class Service(ABC):
    """A service of a robot: the class behind an entry point in the group `snakesim.services`, and `[services.NAME]`.

    Derive from it, give it a `name`, and implement `outputs`. One thread makes all calls, one after the other: the
    constructor, then `configure`, then `outputs` for each due tick. While the clock is silent it calls `silence`, and
    while a simulator is paused `pause`. An exception of any call ends the service, and its log names the call.
    """

    # Of its section in a scenario, and the first part of the keys that it writes.
    name: ClassVar[str] = ""
    # True: the robot waits for this service in every tick, so it gets a high priority.
    urgent: ClassVar[bool] = False
    too_slow: str = ""  # evidence that it is too slow for real time (empty: none)

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to everything that the service will read. Called before the robot is known.

        Args:
            client: Connection to the robot, for subscriptions and requests.
            config: Configuration of the run, with the robot and the settings of its backend.
        """
        del client, config

    def configure(self, robot: RobotDescription) -> None:
        """Prepare for a robot. Called before the first tick, and again after a restart of the HAL host.

        Args:
            robot: Description of the robot.
        """
        del robot

    @abstractmethod
    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Return what to publish for a tick.

        May take `decimation` control periods, and in lockstep any time: the run waits for it. Until the robot is armed
        the same tick may come again.

        Args:
            clock: The tick, with the robot's time and lifecycle.

        Returns:
            Pairs of key and message. None while the service has no output yet, so that the robot is not armed.
        """

    def silence(self) -> list[tuple[str, Message]]:
        """Return what to publish when the HAL's clock has been silent for a second, as (key, message)."""
        return []

    def pause(self, clock: Clock) -> None:
        """Serve requests that need no tick. Called about 20 times a second while a simulator is paused.

        Args:
            clock: The tick at which the simulator is paused.
        """
        del clock


class ServiceLoop:
    """Runs one service of one robot, over one session."""

    def __init__(
        self,
        service_type: type[Service],
        config: RunConfig,
        session: Session,
        should_retry: Callable[[], bool] = lambda: False,
    ) -> None:
        """Construct the service, and wait for its robot.

        Args:
            service_type: Class of the service.
            config: Configuration of the run.
            session: Connection to the network.
            should_retry: Function that is called after each attempt that found no robot. It returns whether to try
                again.

        Raises:
            NotConnectedError: The robot is not found.
            ServiceError: The service raised an error. The error names the service.
        """
        name = service_type.name
        schedule = config.services.get(name, ServiceSchedule())

        # For errors.
        self._label = f"service {schedule.plugin or name} (class {service_type.__name__})"
        self._module = service_type.__module__

        # The service, which subscribes in its constructor, before the robot is known.
        client = HostClient(
            session, name, decimation=schedule.decimation, clock_mode=config.clock_mode
        )
        self._client = client
        with self._name_service_in_errors("__init__"):
            self.service = service_type(client, config)
        robot = _wait_for_robot(client, should_retry)
        with self._name_service_in_errors("configure"):
            self.service.configure(robot)
        self._faults = create_service_faults(
            name, config, session, robot, lambda: client.newest_clock
        )
        self._due_ticks = client.iterate_ticks(0.0, include_paused=True)

        # What other processes see of it.
        self._session = session
        self._entry = make_own_entry(name, config)

    def connect(self) -> None:
        """Announce the service. From now on the robot may be armed, perhaps before the first tick arrives here."""
        clock = self._client.wait_for_clock(SILENCE_S)
        if clock is not None:
            self._faults.update(clock.timestamp_ns, clock.arm_session, clock.lifecycle)
        self._entry_publisher = publish_process_entry(self._session, self._entry)
        self._client.announce()

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Process every clock as long as this process lives, or until a function returns True.

        Args:
            should_stop: Function that is called at each clock, and after each second without a clock.
        """
        for clock in self._client.iterate_ticks(SILENCE_S, include_paused=True):
            if should_stop():
                return
            if clock is None:
                self._process_silence()
            else:
                self._process_clock(clock)

    def step(self) -> None:
        """Process the clocks that have arrived, and return."""
        while (clock := next(self._due_ticks)) is not None:
            self._process_clock(clock)

    def close(self) -> None:
        """Drop the messages that injected faults still delay."""
        self._faults.close()

    def _process_silence(self) -> None:
        """Answer requests for faults, and publish what the service publishes without a clock."""
        self._faults.answer_requests()
        with self._name_service_in_errors("silence"):
            for key, message in self.service.silence():
                self._client.publish(key, message)

    def _process_clock(self, clock: Clock) -> None:
        """Compute and publish the outputs of the service for a tick, and report the tick as done.

        Until the robot is armed, the host repeats the same tick, and each repetition is answered. A paused clock is not
        a tick, and has no outputs.

        Args:
            clock: Clock of a tick that is due, or of a paused simulator.
        """
        if clock.paused:
            self._faults.answer_requests()
            with self._name_service_in_errors("pause"):
                self.service.pause(clock)
            return
        self._faults.update(clock.timestamp_ns, clock.arm_session, clock.lifecycle)
        robot = self._client.fetch_changed_description()
        if robot is not None:
            with self._name_service_in_errors("configure"):
                self.service.configure(robot)
        with self._name_service_in_errors("outputs"):
            outputs = self.service.outputs(clock)
            if clock.lifecycle != "armed":
                outputs = self._filter_outputs_before_arming(outputs)
            if outputs is None:
                return
            for key, message in outputs:
                self._client.publish(key, message)
        self._client.report_done(clock.tick)

    def _filter_outputs_before_arming(
        self, outputs: list[tuple[str, Message]] | None
    ) -> list[tuple[str, Message]] | None:
        """Return the outputs to publish before the robot is armed, and publish the keys that the service waits for.

        Without joint states a service has no output, even if it does not need them. They are published in every tick,
        and after the arming it would be too late to detect that they do not arrive.

        Args:
            outputs: Outputs of the service. None if it has no output yet.

        Returns:
            The same outputs, or None if joint states are missing.
        """
        missing = self._client.missing_keys
        if keys.JOINTS in missing:
            outputs = None
        if outputs is None:
            self._publish_awaited_keys(sorted(missing)[:MAX_SHOWN_KEYS])
        else:
            self._publish_awaited_keys([])
        return outputs

    def _publish_awaited_keys(self, missing: list[str]) -> None:
        """Publish the keys that this service waits for, so that the host can name them."""
        if missing != self._entry.waits_for:
            self._entry = msgspec.structs.replace(self._entry, waits_for=missing)
            self._entry_publisher.put(self._entry)

    @contextlib.contextmanager
    def _name_service_in_errors(self, method: str) -> Iterator[None]:
        """Convert exceptions of a method of the service into errors that name the service and the method.

        Args:
            method: Name of the method, which may be third-party code.
        """
        try:
            yield
        except WireError as error:
            raise ServiceError(f"{self._label}: {error.detail}") from None
        except SnakesimError:
            raise
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            raise ServiceError(
                f"{self._label}: {method}() {describe_exception(error, self._module)}"
            ) from error


def _wait_for_robot(client: HostClient, should_retry: Callable[[], bool]) -> RobotDescription:
    """Wait for the description of the robot, and return it.

    Raises:
        NotConnectedError: The robot is not found, and `should_retry` returns False.
    """
    while True:
        try:
            return client.wait_for_description(CONNECT_ATTEMPT_S)
        except NotConnectedError:
            if not should_retry():
                raise
