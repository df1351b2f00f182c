"""`snakesim run`: starts host and services, arms the robot, shows progress, ends all processes and writes the results.

No process is started before the whole configuration has been checked. No process is left afterwards, whether the run
completes, the operator presses Ctrl-C, a part fails or this process is killed.
"""

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.base.errors import ConfigError, NotConnectedError, SnakesimError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.fault_kinds import ROUTER
from snakesim_hal.model.fault_plan import parse_planned
from snakesim_hal.model.scenario import RunConfig, encode_config
from snakesim_hal.network.endpoint import check_guarded
from snakesim_hal.network.local_registry import LocalRobot, registered
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.session_file import SessionFile
from snakesim_hal.programs.preflight import check_plugins
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.base import extras
from snakesim_operator.results.run_reader import CONFIG
from snakesim_operator.run.console_child import check_console, console_beside
from snakesim_operator.run.ending import Ending, interruptible
from snakesim_operator.run.folder import default_folder, locked_folder
from snakesim_operator.run.meeting import meeting_point, refuse_second_robot
from snakesim_operator.run.monitor import AFTER_FAULT_S, RunMonitor
from snakesim_operator.run.run_files import RunFiles
from snakesim_operator.run.supervisor import HOST, Supervisor

CONNECT_S = 0.5
REPORT_PERIOD_S = 20.0  # between two lines on the terminal while the host has not opened its network


@dataclass(frozen=True)
class RunRequest:
    """A run, as the command line describes it."""

    config: RunConfig
    out: Path | None = None

    # The network.
    endpoint: str | None = None
    router: str | None = None
    session: SessionFile | None = None  # how to connect to a lab's router
    namespace: str | None = None
    with_router: bool = False  # the run's parts meet at a router of its own
    insecure: bool = False  # listen even where other machines can connect

    # Arming and faults.
    unchecked: bool = False  # arm also a robot whose joints have not been checked
    stay: bool = False  # a fault does not end the run: processes are started again, a person resets and arms

    # Output.
    record: bool = True  # every message, in recording.mcap
    raw_only: bool = False  # the recording has no topics for viewers
    console: bool = False  # show the run in the browser

    @property
    def network_name(self) -> str:
        """The robot's namespace."""
        if self.namespace:
            return self.namespace
        if self.session and self.session.namespace:
            return self.session.namespace
        return self.config.robot.name

    @property
    def lab(self) -> Link | None:
        """How to reach the router that the run joins; None when its parts meet on this computer."""
        if self.session is not None:
            return Link.from_session_file(self.session, self.network_name)
        if self.router is not None:
            return Link(self.router, self.network_name)
        return None


def run(request: RunRequest) -> int:
    """Run a scenario in processes of its own, from the checks to the report.

    Returns:
        The exit code: 0, or 1 on a fault or an early end, 3 when the record has gaps, 130 when interrupted.

    Raises:
        SnakesimError: a check failed; no process was started.
    """
    request = replace(request, config=check_plugins(request.config))
    _check_request(request)
    link, stop_port = meeting_point(request.endpoint, request.lab, request.network_name)
    ending = Ending()
    with contextlib.closing(stop_port), opened_files(request.config, request.out) as (files, config_file):
        supervisor = Supervisor(files, ending, print_line, stop_port, stay=request.stay)
        processes = _RunProcesses(request, supervisor, link, files, config_file)
        robot = LocalRobot.describe(
            link, request.config.robot.name, request.config.backend, stop_port, str(config_file.absolute())
        )
        with interruptible(ending):
            with contextlib.ExitStack() as opened:
                registry_failure = opened.enter_context(registered(robot))
                if request.console:  # before the robot, because the operator waits for it
                    opened.enter_context(console_beside(processes.common_arguments, link, files, print_line))
                if registry_failure is not None:
                    print_line(registry_failure)
                _run_processes(processes, ending)
            return _conclude(request, supervisor, files, ending)


def _check_request(request: RunRequest) -> None:
    """Raise SnakesimError when the run cannot be started as requested."""
    _check_router(request)
    check_recorder(record=request.record)
    if request.console:
        check_console()
    if request.endpoint is not None:
        check_guarded(request.endpoint, "--endpoint", insecure=request.insecure)
    refuse_second_robot(request.endpoint, request.lab)


def _conclude(request: RunRequest, supervisor: Supervisor, files: RunFiles, ending: Ending) -> int:
    """Write and print the results. Returns the exit code."""
    # Imported only now, because the start of the robot does not need it.
    from snakesim_operator.run.conclusion import Outcome, conclude

    outcome = Outcome(
        host=supervisor.host_record(),
        robot=supervisor.robot(),
        restarts=supervisor.restarts,
        hosts=supervisor.hosts,
        lost=list(supervisor.lost.values()),
    )
    return conclude(request.config, files, ending, outcome, stay=request.stay)


@contextlib.contextmanager
def opened_files(config: RunConfig, out: Path | None) -> Iterator[tuple[RunFiles, Path]]:
    """Lock the run's folder for as long as the context lives, and write the configuration into it.

    If the folder is not writable, the run continues without files. Its processes then read the configuration from
    memory, because each of them needs a path.

    Args:
        config: Configuration of the run.
        out: The folder; None for the default one.

    Yields:
        The writer of the run's files, and the path of the configuration.
    """
    out = out or default_folder(config.name)
    content = encode_config(config)
    with contextlib.ExitStack() as resources:
        try:
            folder = resources.enter_context(locked_folder(out, print_line))
            write_atomically(folder / CONFIG, content)
        except OSError as error:
            resources.close()
            print_line(f"warning: --out {out}: {error.strerror}; the run continues, but nothing of it is recorded")
            memory_file = os.memfd_create("snakesim-config")
            resources.callback(os.close, memory_file)
            os.write(memory_file, content)
            yield RunFiles(None, _warn), Path(f"/proc/{os.getpid()}/fd/{memory_file}")
        else:
            yield RunFiles(folder, _warn), folder / CONFIG


def check_recorder(*, record: bool) -> None:
    """Raise ConfigError when a recording is requested that cannot be written: a run cannot be recorded afterwards."""
    if record:
        extras.require("record", "a recording of the run", "; or run with --no-record")


def _warn(failure: str) -> None:
    print_line(f"warning: {failure}; the run continues, and its record may be incomplete")


def _check_router(request: RunRequest) -> None:
    """Raise ConfigError when the run has two routers, or a fault that needs a router of its own and no such router."""
    if request.with_router:
        if request.lab is not None:
            raise ConfigError(
                "--with-router starts a router of the run's own, --router and --session join another: give one of them",
                code="command/conflicting-options",
            )
        return
    router_faults = [injection for injection in parse_planned(request.config) if injection.target == ROUTER]
    if router_faults:
        raise ConfigError(
            f"fault {str(router_faults[0])!r}: this run has no router of its own; add --with-router",
            code="injection/not-supported",
        )


class _RunProcesses:
    """Starts the processes of one run: router, host, services and recorder, each with its command line."""

    def __init__(
        self, request: RunRequest, supervisor: Supervisor, link: Link, files: RunFiles, config_file: Path
    ) -> None:
        self.request = request
        self.supervisor = supervisor
        self.link = link
        self._files = files
        self._scenario = [str(config_file), "--namespace", request.network_name]
        if link.session:
            self._network = ["--session", str(link.session.path)]
        else:
            self._network = ["--endpoint", link.endpoint]
        self._listening = ["--insecure"] if request.insecure else []

    @property
    def common_arguments(self) -> list[str]:
        """Arguments that name the scenario and the network."""
        return [*self._scenario, *self._network]

    def start(self) -> None:
        """Start all processes, in the order in which they need one another."""
        if self.request.with_router:
            self._start_router()
        self._start_host()
        self._start_services()
        if self.request.record and self._files.folder is not None:
            self._start_recorder(self._files.folder)

    def _start_router(self) -> None:
        arguments = ["snakesim_hal.programs.router_program", *self.common_arguments, *self._listening]
        self.supervisor.start(ROUTER, arguments)

    def _start_host(self) -> None:
        arguments = ["snakesim_hal.programs.host_program", *self._scenario, *self._listening]
        arguments += ["--end-after-duration", "--memory", self.supervisor.memory]
        if self.request.router is not None or self.request.with_router:
            arguments += ["--router", self.link.endpoint]
        else:
            arguments += self._network
        if self._files.folder:
            arguments += ["--out", str(self._files.folder)]
        if not self.request.stay:
            arguments += ["--end-after-fault", str(AFTER_FAULT_S)]
        self.supervisor.start(HOST, arguments)

    def _start_services(self) -> None:
        """Start each service that is the run's own, except those that run inside the host."""
        config = self.request.config
        for name, service in config.own_services.items():
            if name in config.in_host_services:
                continue
            arguments = ["snakesim_hal.programs.service_program", name, *self.common_arguments]
            self.supervisor.start(name, arguments, may_restart=service.restart)

    def _start_recorder(self, folder: Path) -> None:
        arguments = ["snakesim_operator.recording.recorder_process", *self.common_arguments, "--out", str(folder)]
        if self.request.raw_only:
            arguments.append("--raw-only")
        self.supervisor.start(RECORDER, arguments, vital=False)


def _run_processes(processes: _RunProcesses, ending: Ending) -> None:
    """Start the processes of a run, monitor them until the run is over, and end all of them."""
    request = processes.request
    supervisor = processes.supervisor
    try:
        processes.start()
        with _session_of_run(processes.link, supervisor, ending) as session:
            _print_start(request.config, processes.link)
            monitor = RunMonitor(
                request.config, session, supervisor, ending, print_line, stay=request.stay, unchecked=request.unchecked
            )
            monitor.run()
    except SnakesimError as error:
        ending.add_cause(str(error))
    finally:
        ending.over = True
        supervisor.end()


def _print_start(config: RunConfig, link: Link) -> None:
    print_line(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander}, {config.clock_mode}")
    print_line(f"network: {link.endpoint}, namespace {link.namespace}")
    if not config.has_own_control:
        print_line("no control service of its own: a client that takes the lease commands and arms the robot")


@contextlib.contextmanager
def _session_of_run(link: Link, supervisor: Supervisor, ending: Ending) -> Iterator[Session]:
    """Connect to the run's network, and try again until the host has opened it.

    Args:
        link: How to reach the network.
        supervisor: Reports whether a process of the run has ended.
        ending: Reports whether the operator has interrupted the run.

    Yields:
        The session, which is closed when the context ends.

    Raises:
        NotConnectedError: A process has ended, the operator interrupted the run, or the host took too long.
    """
    start_s = time.monotonic()
    last_report_s = start_s
    with contextlib.ExitStack() as stack:
        while True:
            try:
                session = stack.enter_context(open_session(link, connect_timeout_s=CONNECT_S))
                break
            except NotConnectedError:
                ended_process = supervisor.describe_first_end()
                if ended_process is not None:
                    raise NotConnectedError(ended_process, code="run/failed") from None
                now_s = time.monotonic()
                if now_s > start_s + SERVICE_START_LIMIT_S or ending.interrupted:
                    raise
                if now_s > last_report_s + REPORT_PERIOD_S:
                    print_line(f"starting: the host has not opened its network yet, after {now_s - start_s:.0f} s")
                    last_report_s = now_s
        yield session
