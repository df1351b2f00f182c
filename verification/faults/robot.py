"""Starts the processes of a robot as `snakesim run` starts them, and an observer on its network."""

import contextlib
import os
import random
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario, write_config
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_operator.run.processes import children
from snakesim_operator.run.processes.children import ChildProcess
from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.faults.host_watch import HostWatch, raise_priority
from verification.faults.observer import Observer, TrialError
from verification.faults.row import InjectionTrial, MeasurementRequest

# An emulated machine is slow.
START_TIMEOUT_S = 240.0 if os.environ.get("SNAKESIM_VCAN") == "guest" else 60.0
CONNECT_TIMEOUT_S = 0.5  # of one attempt
MOVING_S = 0.25  # from arming to the injection
SETTLED_S = 0.3  # in which jumps of targets are measured after a recovery
PERIOD_S = 0.01
ROUNDING_RAD = 1e-9


def make_config(backend: str, **overrides: Any) -> RunConfig:
    """Return the scenario `triplet` in real time at 100 Hz, for an hour.

    Args:
        backend: Name of the backend.
        overrides: Other values of the scenario. In their names, `__` stands for a dot.
    """
    values = {"backend": backend, "clock_mode": "realtime", "duration_s": 3600.0, **overrides}
    key_overrides = [
        KeyOverride(name.replace("__", "."), value, f"--{name}") for name, value in values.items()
    ]
    return load_scenario("triplet", key_overrides).config


class ProcessRobot:
    """Host, guidance, navigation and control as separate processes. A trial can kill, freeze and restart each of them.

    Attributes:
        running: Newest process of each name.
        host_watch: Statuses that the first host sends over its private channel.
        random: Source of the random phases of the injections.
    """

    def __init__(
        self,
        folder: Path,
        config: RunConfig,
        *,
        endpoint: str | None = None,
        has_router_process: bool = False,
    ) -> None:
        """Write the configuration. No process is started yet.

        Args:
            folder: Folder for the configuration, the logs and the run log.
            config: Configuration of the run.
            endpoint: Endpoint of the robot's network (default: a free port of this machine).
            has_router_process: A separate process listens at the endpoint, instead of the host.
        """
        self.folder = folder
        self.config = config
        self.endpoint = endpoint or find_free_endpoint()
        self.running: dict[str, ChildProcess] = {}
        self.host_watch = HostWatch()
        self.random = random.Random(config.seed)
        self._has_router_process = has_router_process
        self._stack = ExitStack()
        self._stack.callback(self.host_watch.close)
        write_config(config, self._config_path)

    def __enter__(self) -> "ProcessRobot":
        return self

    def __exit__(self, *_: object) -> None:
        for child in self.running.values():
            with contextlib.suppress(ProcessLookupError):
                child.process.send_signal(signal.SIGCONT)
        children.stop_children(list(self.running.values()))
        self._stack.close()

    @property
    def _config_path(self) -> Path:
        return self.folder / "config.json"

    def start_process(self, name: str) -> ChildProcess:
        """Start a process: `host`, `router`, or a service of the configuration."""
        inherited_fds: list[int] = []
        common = [str(self._config_path), "--endpoint", self.endpoint]
        match name:
            case "host":
                command = ["snakesim_hal.programs.host_program", *common]
                command += ["--out", str(self.folder)]
                command += ["--insecure"]  # a cut network needs an endpoint that is not loopback
                if self._has_router_process:
                    command += ["--router", self.endpoint]
                inherited_fds = [self.host_watch.inherited.fileno()]
                command += ["--parent-socket", str(inherited_fds[0])]
            case "router":
                command = ["snakesim_hal.programs.router_program", *common]
            case _:
                command = ["snakesim_hal.programs.service_program", name, *common]
        log = self._stack.enter_context((self.folder / f"{name}.log").open("ab", buffering=0))
        # State that outlives a run must not outlive the measurement.
        environment = {"XDG_STATE_HOME": str(self.folder)}
        child = children.start_child(
            name, command, log.write, pass_fds=inherited_fds, extra_env=environment
        )
        self.running[name] = child
        return child

    def start_all_processes(self) -> None:
        """Start the host and every service."""
        for name in ("host", *self.config.services):
            self.start_process(name)

    def connect_observer(self) -> Observer:
        """Connect an observer to the robot's network, as soon as the network exists.

        Raises:
            TrialError: A process has ended, or there is no network within START_TIMEOUT_S.
        """
        deadline_s = time.monotonic() + START_TIMEOUT_S
        settings = ConnectionSettings(self.endpoint, self.config.robot.name)
        while True:
            try:
                with raise_priority():
                    session = self._stack.enter_context(
                        open_session(settings, connect_timeout_s=CONNECT_TIMEOUT_S)
                    )
                return Observer(session)
            except NotConnectedError:
                exits = self.describe_exits()
                if exits or time.monotonic() > deadline_s:
                    raise TrialError(
                        f"no network: {'; '.join(exits)}; {self.read_last_output()}"
                    ) from None

    def describe_exits(self) -> list[str]:
        """Return a description of each process that has ended."""
        exits = [child.describe_exit() for child in self.running.values()]
        return [text for text in exits if text is not None]

    def read_last_output(self) -> str:
        """Return the last lines that the ended processes printed."""
        ended = [child for child in self.running.values() if child.describe_exit()]
        return " | ".join(line for child in ended for line in child.output.last_lines())

    def send_signal(self, name: str, number: signal.Signals) -> int:
        """Send a signal to a process. Return the time just before, by the monotonic clock in ns."""
        process = self.running[name].process
        signal_ns = time.monotonic_ns()
        os.kill(process.pid, number)
        if number is signal.SIGKILL:
            process.wait()
        return signal_ns

    def set_in_motion(self, observer: Observer) -> None:
        """Arm the robot if necessary, and let it move until a random phase of a control period.

        Raises:
            TrialError: The robot stopped meanwhile.
        """
        if observer.get_lifecycle() != "armed":
            observer.arm()
        observer.listen_for(MOVING_S + self.random.random() * PERIOD_S)
        observer.forget()
        if observer.get_lifecycle() != "armed":
            raise TrialError(
                f"the robot stopped before the injection: {observer.describe_status()}"
            )


@contextlib.contextmanager
def start_robot(
    request: MeasurementRequest,
    config: RunConfig | None = None,
    *,
    has_router_process: bool = False,
    **overrides: Any,
) -> Iterator[tuple[ProcessRobot, Observer]]:
    """Start all processes of a robot, connect an observer, and arm the robot.

    Args:
        request: Measurement to which the robot belongs. Its failed armings are counted as retries.
        config: Configuration of the run (default: `make_config` with the overrides).
        has_router_process: The router is a separate process, instead of a part of the host.
        overrides: Other values of the scenario, see `make_config`.

    Yields:
        The robot and its observer. All processes end with the context.
    """
    config = config or make_config(request.backend, **overrides)
    with ProcessRobot(request.folder, config, has_router_process=has_router_process) as robot:
        if has_router_process:
            robot.start_process("router")
            robot.connect_observer().session.close()  # waits until the router listens
        robot.start_all_processes()
        observer = robot.connect_observer()
        observer.arm(START_TIMEOUT_S)
        yield robot, observer
        request.count_retries(observer.failed_armings)


def recover_robot(
    observer: Observer, value: float | None, failures: Sequence[str] = ()
) -> InjectionTrial:
    """Reset and arm the robot as an operator does, and check that no target jumps.

    Args:
        observer: Observer of the robot.
        value: Measured value of the trial, in the unit of the row.
        failures: What was wrong in the trial so far.

    Returns:
        The trial with the result of the recovery.
    """
    failures = list(failures)
    try:
        observer.arm(START_TIMEOUT_S)
    except TrialError as error:
        failures.append(str(error))
        return InjectionTrial(value=value, failure="; ".join(failures), recovered=False)
    observer.listen_for(SETTLED_S)
    steps = observer.measure_target_steps()
    max_step_rad = observer.get_description().max_step_rad
    if max(steps.step_rad, steps.first_rad) > max_step_rad + ROUNDING_RAD:
        failures.append(f"a target jumped by more than {max_step_rad} rad at recovery")
    return InjectionTrial(
        value=value,
        failure="; ".join(failures),
        recovered=True,
        step_rad=steps.step_rad,
        first_rad=steps.first_rad,
    )
