"""Services in threads of their own, on a real host and real Zenoh, with a controller that shows what it was given."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

from snakesim_gnc.control.hold import Hold
from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.controller import ControllerCommand, Observation
from snakesim_hal.model.plugins import CONTROLLERS, offer_plugin
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Link, open_session
from snakesim_hal.network.streams import Reader
from snakesim_hal.programs.preflight import find_service
from snakesim_hal.service import ServiceLoop
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState
from snakesim_testing.hal.local_network import Running, running
from snakesim_testing.hal.small_robots import run_config
from snakesim_testing.harness.wait import wait_until

SCHEDULE: dict[str, Any] = {"guidance": {"decimation": 2}, "navigation": {"decimation": 5}, "control": {}}
POSE = {"robot__sensors__pose": {"rate_hz": 10.0}}  # as the host's backend of the tests gives it


class Showing(Hold):
    """Holds, unless it is to answer otherwise."""

    observations: list[Observation]
    answers: list[Callable[["Showing", Observation], Any]]  # its only entry is how it answers

    def update(self, observation: Observation) -> ControllerCommand:
        """Keeps what it was given."""
        self.observations.append(observation)
        return self.answers[0](self, observation) if self.answers else super().update(observation)


class Serving:
    """A service at work in a thread."""

    def __init__(self, name: str, config: RunConfig, link: Link) -> None:
        self.stopped, self.error = threading.Event(), None
        self.thread = threading.Thread(target=self._work, args=(name, config, link), name=name)
        self.thread.start()

    def _work(self, name: str, config: RunConfig, link: Link) -> None:
        with open_session(link) as session:
            try:
                loop = ServiceLoop(find_service(config, name), config, session)
                loop.join()
                loop.run(self.stopped.is_set)
            except SnakesimError as error:
                self.error = error

    def stop(self) -> None:
        """End it as a process ends: without a word."""
        self.stopped.set()
        self.thread.join(20.0)
        assert not self.thread.is_alive(), "the service did not stop"


@dataclass
class Stage:
    """A host, its services, and who watches them."""

    run: Running
    services: dict[str, Serving]
    states: Reader[ControlState]
    observations: list[Observation]  # what the controller was given so far
    reported: list[ControlState] = field(default_factory=list[ControlState])

    def state(self) -> ControlState | None:
        """The newest state that control reported."""
        self.reported += self.states.drain()
        return self.reported[-1] if self.reported else None

    def wait_for_reason(self, words: str) -> ControlState:
        """Wait until control has reported a reason with these words."""

        def found() -> list[ControlState]:
            self.state()
            return [state for state in self.reported if words in state.reason]

        wait_until(found, f"{words!r} reported; last: {self.reported[-1].reason if self.reported else 'nothing'}")
        return found()[0]


@contextmanager
def stage(**config: Any) -> Iterator[Stage]:
    """Run the worm in real time with guidance, navigation and control; the controller records its observations.

    Args:
        config: Changes of the configuration, as for `run_config`.
    """
    defaults = {
        "controller": "showing",
        "clock_mode": "realtime",
        "services": SCHEDULE,
        "rate_hz": 50.0,
        "allow_fault_injection": True,
        **POSE,
    }
    run_settings = run_config(**{**defaults, **config})
    Showing.observations = []
    Showing.answers = []
    with (
        offer_plugin(CONTROLLERS, "showing", Showing),
        running(run_settings) as run,
        open_session(run.link) as session,
        ExitStack() as stack,
    ):
        states = session.reader(keys.CONTROL_STATE, ControlState)
        services: dict[str, Serving] = {}
        for name in SCHEDULE:
            services[name] = Serving(name, run_settings, run.link)
            stack.callback(services[name].stop)
        wait_until(lambda: set(SCHEDULE) <= set(run.status.alive), "all services")
        yield Stage(run, services, states, Showing.observations)
