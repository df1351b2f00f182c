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
from snakesim_hal.model.fault_plan import parse_planned_faults
from snakesim_hal.model.scenario import RunConfig, encode_config
from snakesim_hal.network.endpoint import require_safe_listening_endpoint
from snakesim_hal.network.local_registry import LocalRobot, register_robot
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.session_file import SessionFile
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.base import extras
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.run.ending import RunEnding, end_run_on_signals
from snakesim_operator.run.folder import choose_default_folder, lock_run_folder
from snakesim_operator.run.monitor import RUN_ON_AFTER_FAULT_S, RunMonitor
from snakesim_operator.run.processes.console_child import require_console, run_console
from snakesim_operator.run.processes.supervisor import HOST, RunSupervisor
from snakesim_operator.run.run_endpoint import check_no_other_robot, reserve_endpoint
from snakesim_operator.run.run_files import RunFiles

CONNECT_TIMEOUT_S = 0.5
# Between two lines on the terminal while the host has not opened its network.
REPORT_PERIOD_S = 20.0


@dataclass(frozen=True)
class RunRequest:
    """A run as requested on the command line."""

    config: RunConfig
    out: Path | None = None

    # The network.
    endpoint: str | None = None
    router: str | None = None
    session: SessionFile | None = None  # credentials for the router of a lab
    namespace: str | None = None
    with_router: bool = False  # start a router for the run
    insecure: bool = False  # listen even on interfaces that other machines can reach

    # Arming and faults.
    unchecked: bool = False  # also arm a robot whose joints have not been checked
    # A fault does not end the run: processes restart, and a person resets and arms.
    stay: bool = False

    # Output.
    record: bool = True  # every message, in recording.mcap
    raw_only: bool = False  # the recording has no topics for viewers
    console: bool = False  # show the run in the browser

    @property
    def robot_namespace(self) -> str:
        """Namespace of the robot."""
        if self.namespace:
            return self.namespace
        if self.session and self.session.namespace:
            return self.session.namespace
        return self.config.robot.name

    @property
    def router_link(self) -> ConnectionSettings | None:
        """Link to the router of a lab that the run joins; None if its processes connect on this computer."""
        if self.session is not None:
            return ConnectionSettings.from_session_file(self.session, self.robot_namespace)
        if self.router is not None:
            return ConnectionSettings(self.router, self.robot_namespace)
        return None


def run_in_processes(request: RunRequest) -> int:
    """Run a scenario in processes of its own, from the checks to the report.

    Returns:
        The exit code: 1 on a fault or an early end, 3 if the record has gaps, 130 if interrupted, otherwise 0.

    Raises:
        SnakesimError: A check failed, so no process was started.
    """
    request = replace(request, config=validate_and_complete_config(request.config))
    _check_request(request)
    link, stop_port = reserve_endpoint(
        request.endpoint, request.router_link, request.robot_namespace
    )
    ending = RunEnding()
    with (
        contextlib.closing(stop_port),
        open_run_files(request.config, request.out) as (files, config_file),
    ):
        supervisor = RunSupervisor(files, ending, print_line, stop_port, stay=request.stay)
        processes = _RunProcesses(request, supervisor, link, files, config_file)
        robot = LocalRobot.from_connection(
            link,
            request.config.robot.name,
            request.config.backend,
            stop_port,
            str(config_file.absolute()),
        )
        with end_run_on_signals(ending):
            with contextlib.ExitStack() as exit_stack:
                registry_failure = exit_stack.enter_context(register_robot(robot))
                if request.console:  # before the robot, because the operator waits for it
                    exit_stack.enter_context(
                        run_console(processes.common_arguments, link, files, print_line)
                    )
                if registry_failure is not None:
                    print_line(registry_failure)
                _run_until_over(processes, ending)
            return _conclude_run(request, supervisor, files, ending)


def _check_request(request: RunRequest) -> None:
    """Raise SnakesimError if the run cannot be started as requested."""
    _check_router(request)
    require_recorder(record=request.record)
    if request.console:
        require_console()
    if request.endpoint is not None:
        require_safe_listening_endpoint(request.endpoint, "--endpoint", insecure=request.insecure)
    check_no_other_robot(request.endpoint, request.router_link)


def _conclude_run(
    request: RunRequest, supervisor: RunSupervisor, files: RunFiles, ending: RunEnding
) -> int:
    """Write and print the results of a run, close its files, and return the exit code."""
    # Imported only now, because the start of the robot does not need it.
    from snakesim_operator.run.conclusion import RunConclusion, write_and_print_results

    outcome = RunConclusion(
        host_record=supervisor.read_host_record(),
        description=supervisor.get_description(),
        restarts=supervisor.restarts,
        host_count=supervisor.host_count,
        recording_losses=list(supervisor.losses_by_process.values()),
    )
    return write_and_print_results(request.config, files, ending, outcome, stay=request.stay)


@contextlib.contextmanager
def open_run_files(
    config: RunConfig, output_folder: Path | None
) -> Iterator[tuple[RunFiles, Path]]:
    """Lock the folder of a run while the context is active, and write the configuration into it.

    If the folder cannot be created, locked or written because of the file system, the run continues without files. The
    configuration is then in a memory file, because each process of the run needs a path to read it from.

    Args:
        config: Configuration of the run.
        output_folder: Path of the folder; None for the default folder.

    Yields:
        The writer of the files of the run, and the path of the configuration.

    Raises:
        ConfigError: Another run has locked the folder.
    """
    if output_folder is None:
        output_folder = choose_default_folder(config.name)
    content = encode_config(config)
    with contextlib.ExitStack() as exit_stack:
        try:
            folder = exit_stack.enter_context(lock_run_folder(output_folder, print_line))
            write_atomically(folder / CONFIG_FILENAME, content)
        except OSError as error:
            exit_stack.close()
            print_line(
                f"warning: --out {output_folder}: {error.strerror}; the run continues, but nothing of it is recorded"
            )
            memory_file = os.memfd_create("snakesim-config")
            exit_stack.callback(os.close, memory_file)
            os.write(memory_file, content)
            yield RunFiles(None, _print_file_warning), Path(f"/proc/{os.getpid()}/fd/{memory_file}")
        else:
            yield RunFiles(folder, _print_file_warning), folder / CONFIG_FILENAME


def require_recorder(*, record: bool) -> None:
    """Raise ConfigError if a recording is requested, but the packages for it are not installed."""
    if record:
        extras.require_extra("record", "a recording of the run", "; or run with --no-record")


def _print_file_warning(failure: str) -> None:
    """Print that a file of the run cannot be written."""
    print_line(f"warning: {failure}; the run continues, and its record may be incomplete")


def _check_router(request: RunRequest) -> None:
    """Raise ConfigError if the run has two routers, or a fault on its router but no router of its own."""
    if request.with_router:
        if request.router_link is not None:
            raise ConfigError(
                "--with-router starts a router of the run's own, --router and --session join another: give one of them",
                code="command/conflicting-options",
            )
        return
    router_faults = [
        injection
        for injection in parse_planned_faults(request.config)
        if injection.target == ROUTER
    ]
    if router_faults:
        raise ConfigError(
            f"fault {str(router_faults[0])!r}: this run has no router of its own; add --with-router",
            code="injection/not-supported",
        )


class _RunProcesses:
    """Starts the processes of one run: router, host, services and recorder, each with its command line."""

    def __init__(
        self,
        request: RunRequest,
        supervisor: RunSupervisor,
        connection: ConnectionSettings,
        files: RunFiles,
        config_file: Path,
    ) -> None:
        self.request = request
        self.supervisor = supervisor
        self.link = connection
        self._files = files
        self._scenario = [str(config_file), "--namespace", request.robot_namespace]
        if connection.session:
            self._network = ["--session", str(connection.session.path)]
        else:
            self._network = ["--endpoint", connection.endpoint]
        self._listening = ["--insecure"] if request.insecure else []

    @property
    def common_arguments(self) -> list[str]:
        """Command-line arguments that name the scenario and the network."""
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
        arguments = [
            "snakesim_hal.programs.router_program",
            *self.common_arguments,
            *self._listening,
        ]
        self.supervisor.start(ROUTER, arguments)

    def _start_host(self) -> None:
        arguments = ["snakesim_hal.programs.host_program", *self._scenario, *self._listening]
        arguments += ["--end-after-duration", "--memory", self.supervisor.host_record_path]
        if self.request.router is not None or self.request.with_router:
            arguments += ["--router", self.link.endpoint]
        else:
            arguments += self._network
        if self._files.folder:
            arguments += ["--out", str(self._files.folder)]
        if not self.request.stay:
            arguments += ["--end-after-fault", str(RUN_ON_AFTER_FAULT_S)]
        self.supervisor.start(HOST, arguments)

    def _start_services(self) -> None:
        """Start each service that is the run's own, except those that run inside the host."""
        config = self.request.config
        for name, service in config.internal_services.items():
            if name in config.in_host_services:
                continue
            arguments = ["snakesim_hal.programs.service_program", name, *self.common_arguments]
            self.supervisor.start(name, arguments, may_restart=service.restart)

    def _start_recorder(self, folder: Path) -> None:
        arguments = [
            "snakesim_operator.recording.recorder_process",
            *self.common_arguments,
            "--out",
            str(folder),
        ]
        if self.request.raw_only:
            arguments.append("--raw-only")
        self.supervisor.start(
            RECORDER, arguments, vital=False, written_file=folder / RECORDING_FILENAME
        )


def _run_until_over(processes: _RunProcesses, ending: RunEnding) -> None:
    """Start the processes of a run, monitor them until the run is over, and end all of them."""
    request = processes.request
    supervisor = processes.supervisor
    try:
        processes.start()
        with _open_run_session(processes.link, supervisor, ending) as session:
            _print_start(request.config, processes.link)
            monitor = RunMonitor(
                request.config,
                session,
                supervisor,
                ending,
                print_line,
                stay=request.stay,
                unchecked=request.unchecked,
            )
            monitor.run()
    except SnakesimError as error:
        ending.add_cause(str(error))
    finally:
        ending.is_over = True
        supervisor.end_all_processes()


def _print_start(config: RunConfig, connection: ConnectionSettings) -> None:
    print_line(
        f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander_name}, {config.clock_mode}"
    )
    print_line(f"network: {connection.endpoint}, namespace {connection.namespace}")
    if not config.has_internal_control:
        print_line(
            "no control service of its own: a client that takes the lease commands and arms the robot"
        )


@contextlib.contextmanager
def _open_run_session(
    connection: ConnectionSettings, supervisor: RunSupervisor, ending: RunEnding
) -> Iterator[Session]:
    """Connect to the network of the run, and retry until the host has opened it.

    Args:
        connection: Link to the network of the run.
        supervisor: Supervisor of the processes; if one of them ends, connecting is given up.
        ending: Shows whether the operator has interrupted the run.

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
                session = stack.enter_context(
                    open_session(connection, connect_timeout_s=CONNECT_TIMEOUT_S)
                )
                break
            except NotConnectedError:
                ended_process = supervisor.describe_first_end()
                if ended_process is not None:
                    raise NotConnectedError(ended_process, code="run/failed") from None
                now_s = time.monotonic()
                if now_s > start_s + SERVICE_START_LIMIT_S or ending.is_interrupted:
                    raise
                if now_s > last_report_s + REPORT_PERIOD_S:
                    print_line(
                        f"starting: the host has not opened its network yet, after {now_s - start_s:.0f} s"
                    )
                    last_report_s = now_s
        yield session
