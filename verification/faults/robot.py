"""One robot's processes, started as `snakesim run` starts them, and an observer beside them."""

import contextlib
import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario, write_config
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_operator.run import children
from snakesim_operator.run.children import ChildProcess
from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.faults.host_watch import HostWatch, raised_priority
from verification.faults.observer import Observer, TrialError
from verification.faults.row import InjectionTrial, MeasurementRequest

# An emulated machine is slow.
START_LIMIT_S = 240.0 if os.environ.get("SNAKESIM_VCAN") == "guest" else 60.0
MOVING_S = 0.25  # from arming to the injection
SETTLED_S = 0.3  # how long steps are watched after a recovery
PERIOD_S = 0.01


def configuration(backend: str, **dotted: Any) -> RunConfig:
    """The triplet in real time at 100 Hz, for as long as anybody likes; `__` in a name stands for the dot."""
    values = {"backend": backend, "clock_mode": "realtime", "duration_s": 3600.0, **dotted}
    overrides = [
        KeyOverride(name.replace("__", "."), value, f"--{name}") for name, value in values.items()
    ]
    return load_scenario("triplet", overrides).config


class ProcessRobot:
    """Host, guidance, navigation and control, each a process of its own; any can be killed, frozen, started again."""

    def __init__(
        self, folder: Path, config: RunConfig, *, endpoint: str | None = None, router: bool = False
    ) -> None:
        """router: another process listens at the endpoint."""
        self.folder, self.config, self.router = folder, config, router
        self.endpoint = endpoint or find_free_endpoint()
        self.running: dict[str, ChildProcess] = {}
        self._stack = ExitStack()
        self.host = HostWatch()  # of the first host
        self._stack.callback(self.host.close)
        self.random = random.Random(config.seed)
        write_config(config, folder / "config.json")

    def __enter__(self) -> "ProcessRobot":
        return self

    def __exit__(self, *_: object) -> None:
        for child in self.running.values():
            with contextlib.suppress(ProcessLookupError):
                child.process.send_signal(signal.SIGCONT)
        children.stop_children(list(self.running.values()))
        self._stack.close()

    def start(self, name: str) -> ChildProcess:
        """Start one of its processes."""
        common = [str(self.folder / "config.json"), "--endpoint", self.endpoint]
        inherits: list[int] = []
        if name == "host":
            module = [
                "snakesim_hal.programs.host_program",
                *common,
                "--out",
                str(self.folder),
                "--insecure",
            ]  # network_cut
            module += ["--router", self.endpoint] if self.router else []
            inherits = [self.host.inherited.fileno()]
            module += ["--parent-socket", str(inherits[0])]
        elif name == "router":
            module = ["snakesim_hal.programs.router_program", *common]
        else:
            module = ["snakesim_hal.programs.service_program", name, *common]
        log = self._stack.enter_context((self.folder / f"{name}.log").open("ab", buffering=0))
        # What outlives a run must not outlive this one.
        state = {"XDG_STATE_HOME": str(self.folder)}
        self.running[name] = children.start_child(
            name, module, log.write, pass_fds=inherits, extra_env=state
        )
        return self.running[name]

    def start_all(self) -> None:
        """All of them."""
        for name in ("host", *self.config.services):
            self.start(name)

    def observe(self) -> Observer:
        """Join the network as soon as there is one."""
        deadline = time.monotonic() + START_LIMIT_S
        link = ConnectionSettings(self.endpoint, self.config.robot.name)
        while True:
            try:
                with raised_priority():
                    session = self._stack.enter_context(open_session(link, connect_timeout_s=0.5))
                return Observer(session)
            except NotConnectedError:
                if time.monotonic() > deadline or self.ended():
                    raise TrialError(
                        f"no network: {'; '.join(self.ended())}; {self.last_words()}"
                    ) from None

    def ended(self) -> list[str]:
        """Which of its processes are gone, and how."""
        return [
            ending
            for child in self.running.values()
            if (ending := child.describe_exit()) is not None
        ]

    def last_words(self) -> str:
        """Of those that are gone."""
        ended = [child for child in self.running.values() if child.describe_exit()]
        return " | ".join(line for child in ended for line in child.output.last_lines())

    def signal(self, name: str, number: signal.Signals) -> int:
        """Send a signal to one of its processes; when, by the monotonic clock."""
        pid = self.running[name].process.pid
        now_ns = time.monotonic_ns()
        os.kill(pid, number)
        if number is signal.SIGKILL:
            self.running[name].process.wait()
        return now_ns

    def set_in_motion(self, observer: Observer) -> None:
        """Armed, and moving for a moment; what follows happens at any phase of a period."""
        if observer.state() != "armed":
            observer.arm()
        observer.watch(MOVING_S + self.random.random() * PERIOD_S)
        observer.forget()
        if observer.state() != "armed":
            raise TrialError(f"the robot stopped before the injection: {observer.in_words()}")


@contextlib.contextmanager
def robot(
    request: MeasurementRequest,
    config: RunConfig | None = None,
    *,
    router: bool = False,
    **dotted: Any,
) -> Iterator[tuple[ProcessRobot, Observer]]:
    """A robot with all its processes, and who watches it. config: other than `configuration` with these values."""
    with ProcessRobot(
        request.folder, config or configuration(request.backend, **dotted), router=router
    ) as started_robot:
        if router:
            started_robot.start("router")
            started_robot.observe().session.close()  # it is there
        started_robot.start_all()
        observer = started_robot.observe()
        observer.arm(START_LIMIT_S)
        yield started_robot, observer
        request.retry(observer.stumbles)


def recovered(observer: Observer, value: float | None, failure: str = "") -> InjectionTrial:
    """Bring the robot back by an operator's commands, and look at how its targets step."""
    try:
        observer.arm(START_LIMIT_S)
    except TrialError as error:
        return InjectionTrial(
            value=value, failure="; ".join(filter(None, (failure, str(error)))), recovered=False
        )
    observer.watch(SETTLED_S)
    steps = observer.steps()
    bound = observer.description().max_step_rad
    if max(steps.values()) > bound + 1e-9:
        failure = "; ".join(
            filter(None, (failure, f"a target jumped by more than {bound} rad at recovery"))
        )
    return InjectionTrial(value=value, failure=failure, recovered=True, **steps)
