"""Services in threads of their own, on a real host and real Zenoh, with a controller that shows what it was given."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

from snakesim_gnc.control.hold import HoldPose
from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.controller import ControllerCommand, Observation
from snakesim_hal.model.plugins import CONTROLLERS, register_plugin_temporarily
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.programs.preflight import load_service_class
from snakesim_hal.service import ServiceLoop
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState
from snakesim_testing.hal.local_network import RunningHost, running_host
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.harness.wait import wait_until

SCHEDULE: dict[str, Any] = {
    "guidance": {"decimation": 2},
    "navigation": {"decimation": 5},
    "control": {},
}
POSE = {"robot__sensors__pose": {"rate_hz": 10.0}}  # as the host's backend of the tests gives it


class ObservationRecorder(HoldPose):
    """A controller that records its observations, and holds the joints unless a test sets another response."""

    observations: list[Observation]
    # Its only entry is the function that answers an observation.
    answers: list[Callable[["ObservationRecorder", Observation], Any]]

    def update(self, observation: Observation) -> ControllerCommand:
        """Record the observation, and return the command that the test has set, or one that holds the joints."""
        self.observations.append(observation)
        if self.answers:
            return self.answers[0](self, observation)
        return super().update(observation)


class ServiceThread:
    """A service that runs in a thread."""

    def __init__(self, name: str, config: RunConfig, connection: ConnectionSettings) -> None:
        self.stopped = threading.Event()
        self.error: SnakesimError | None = None
        self.thread = threading.Thread(
            target=self._run_service, args=(name, config, connection), name=name
        )
        self.thread.start()

    def _run_service(self, name: str, config: RunConfig, connection: ConnectionSettings) -> None:
        with open_session(connection) as session:
            try:
                service_loop = ServiceLoop(load_service_class(config, name), config, session)
                service_loop.connect()
                service_loop.run(self.stopped.is_set)
            except SnakesimError as error:
                self.error = error

    def stop(self) -> None:
        """Stop the service without any message to the host, as when its process ends."""
        self.stopped.set()
        self.thread.join(20.0)
        assert not self.thread.is_alive(), "the service did not stop"


@dataclass
class RunningServices:
    """A running host, its services, and what their controller has reported."""

    run: RunningHost
    services: dict[str, ServiceThread]
    states: SampleReader[ControlState]
    observations: list[Observation]  # what the controller was given so far
    reported: list[ControlState] = field(default_factory=list[ControlState])

    def read_newest_state(self) -> ControlState | None:
        """Return the newest state that control has reported; None if there is none."""
        self.reported += self.states.drain()
        return self.reported[-1] if self.reported else None

    def wait_for_reason(self, words: str) -> ControlState:
        """Wait until control has reported a reason that contains some words, and return that report."""

        def list_states_with_reason() -> list[ControlState]:
            self.read_newest_state()
            return [state for state in self.reported if words in state.reason]

        wait_until(
            list_states_with_reason,
            f"{words!r} reported; last: {self.reported[-1].reason if self.reported else 'nothing'}",
        )
        return list_states_with_reason()[0]


@contextmanager
def running_services(**config_changes: Any) -> Iterator[RunningServices]:
    """Run a host and the services guidance, navigation and control in real time, in threads of this process.

    The controller records its observations. Host and services end with the context.

    Args:
        config_changes: Changes of the configuration, as `make_run_config` takes them.

    Yields:
        The host and the services, once all services are alive.
    """
    defaults = {
        "controller": "showing",
        "clock_mode": "realtime",
        "services": SCHEDULE,
        "rate_hz": 50.0,
        "allow_fault_injection": True,
        **POSE,
    }
    run_settings = make_run_config(**{**defaults, **config_changes})
    ObservationRecorder.observations = []
    ObservationRecorder.answers = []
    with (
        register_plugin_temporarily(CONTROLLERS, "showing", ObservationRecorder),
        running_host(run_settings) as run,
        open_session(run.link) as session,
        ExitStack() as stack,
    ):
        state_reader = session.declare_reader(keys.CONTROL_STATE, ControlState)
        services: dict[str, ServiceThread] = {}
        for name in SCHEDULE:
            services[name] = ServiceThread(name, run_settings, run.link)
            stack.callback(services[name].stop)
        wait_until(lambda: set(SCHEDULE) <= set(run.status.alive), "all services")
        yield RunningServices(run, services, state_reader, ObservationRecorder.observations)
