"""Services in threads of their own, on a real host and real Zenoh, with a controller that shows what it was given."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.service import Control
from snakesim_gnc.guidance.service import Guidance
from snakesim_gnc.navigation.service import Navigation
from snakesim_hal.errors import SnakesimError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Link, Reader, Session, open_session
from snakesim_hal.service import Service, ServiceLoop
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, Trajectory
from tests.harness.wait import wait_until
from tests.unit.hal.local_network import Running, running
from tests.unit.hal.rig import run_config

SERVICES: dict[str, type[Service]] = {"guidance": Guidance, "navigation": Navigation, "control": Control}
SCHEDULE: dict[str, Any] = {"guidance": {"every_ticks": 2}, "navigation": {"every_ticks": 5}, "control": {}}
POSE = {"robot__sensors__pose": {"rate_hz": 10.0}}  # as the host's backend of the tests gives it
MODULE = "snakesim_plugin_showing"  # as a controller file of this name is loaded
SHOWING = """
from snakesim_gnc.control.controller import Action, positions
from snakesim_gnc.control.hold import Hold

VIEWS = []
ANSWERS = []


class Showing(Hold):
    def update(self, view):
        VIEWS.append(view)
        return ANSWERS[0](self, view) if ANSWERS else super().update(view)
"""


class StopError(BaseException):
    """The test is over."""


@dataclass
class Serving:
    """A service at work."""

    thread: threading.Thread
    stopped: threading.Event
    error: SnakesimError | None = None

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
    trajectories: Reader[Trajectory]
    reported: list[ControlState] = field(default_factory=list[ControlState])

    @property
    def views(self) -> list[View]:
        """What the controller was given so far."""
        return sys.modules[MODULE].VIEWS

    def answer(self, how: Callable[[Any, View], Any]) -> None:
        """From now on the controller answers like this."""
        sys.modules[MODULE].ANSWERS[:] = [how]

    def state(self) -> ControlState | None:
        """The newest of what control told."""
        self.reported += self.states.drain()
        return self.reported[-1] if self.reported else None

    def tells(self, words: str) -> ControlState:
        """Wait until control has told a reason with these words."""

        def found() -> list[ControlState]:
            self.state()
            return [state for state in self.reported if words in state.reason]

        wait_until(found, f"{words!r} told; last: {self.reported[-1].reason if self.reported else 'nothing'}")
        return found()[0]


@contextmanager
def stage(folder: Path, **config: Any) -> Iterator[Stage]:
    """The worm in real time, with guidance, navigation, and control with the controller that shows its views."""
    (folder / "showing.py").write_text(SHOWING)
    controller = f"{folder / 'showing.py'}:Showing"
    made = run_config(
        controller=controller,
        pace="realtime",
        services=SCHEDULE,
        rate_hz=50.0,
        faults_allowed=True,
        **{**POSE, **config},
    )
    with running(made) as run, open_session(run.link) as session, ExitStack() as stack:
        states, trajectories = (
            session.reader(keys.CONTROL_STATE, ControlState),
            session.reader(keys.TRAJECTORY, Trajectory),
        )
        services: dict[str, Serving] = {}
        for name in SERVICES:
            services[name] = _serve(name, made, run.link)
            stack.callback(services[name].stop)
        wait_until(lambda: set(SERVICES) <= set(run.status.alive), "all services")
        yield Stage(run, services, states, trajectories)


def _serve(name: str, config: RunConfig, link: Link) -> Serving:
    serving = Serving(threading.Thread(name=name), threading.Event())

    def work() -> None:
        with open_session(link) as session:
            try:
                _loop(session)
            except StopError:
                pass
            except SnakesimError as error:
                serving.error = error

    def _loop(session: Session) -> None:
        loop = ServiceLoop(SERVICES[name], config, session)
        outputs = loop.service.outputs

        def stoppable(clock: Any) -> Any:
            if serving.stopped.is_set():
                raise StopError
            return outputs(clock)

        loop.service.outputs = stoppable
        loop.join()
        loop.run()

    serving.thread = threading.Thread(target=work, name=name)
    serving.thread.start()
    return serving
