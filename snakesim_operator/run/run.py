"""`snakesim run`: starts backend host and services, arms, shows progress, ends everything, writes what is left.

Nothing is started before the whole configuration has been checked. Whatever happens afterwards (the run completes,
somebody presses Ctrl-C, a part fails, this process is killed) no process stays behind.
"""

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from snakesim_hal.base.atomic_write import write_whole
from snakesim_hal.base.errors import ConfigError, NotConnectedError, SnakesimError
from snakesim_hal.base.terminal import say
from snakesim_hal.model.fault_kinds import ROUTER
from snakesim_hal.model.fault_plan import planned
from snakesim_hal.model.scenario import RunConfig, written
from snakesim_hal.network.endpoint import check_guarded
from snakesim_hal.network.local_registry import LocalRobot, registered
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.session_file import SessionFile
from snakesim_hal.programs.preflight import check_plugins
from snakesim_hal.service import START_LIMIT_S
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.base import extras
from snakesim_operator.results.record import CONFIG
from snakesim_operator.run.console_child import check_console, console_beside
from snakesim_operator.run.ending import Ending, interruptible
from snakesim_operator.run.folder import claimed, named_after
from snakesim_operator.run.meeting import meeting_point, refuse_second_robot
from snakesim_operator.run.monitor import AFTER_FAULT_S, RunMonitor
from snakesim_operator.run.run_files import RunFiles
from snakesim_operator.run.supervisor import HOST, Supervisor

CONNECT_S = 0.5
TELL_S = 20.0  # between two signs of life while nothing is heard


@dataclass(frozen=True)
class RunRequest:
    """What the command line asks for."""

    config: RunConfig
    out: Path | None = None
    endpoint: str | None = None
    router: str | None = None
    session: SessionFile | None = None  # how to connect to a lab's router
    namespace: str | None = None
    unchecked: bool = False  # arm also a robot whose joints nobody has checked
    stay: bool = False  # a fault ends nothing: processes are started again, a person clears and arms
    with_router: bool = False  # the run's parts meet at a router of its own
    insecure: bool = False  # listen even where other machines can connect
    record: bool = True  # every message, in recording.mcap
    raw_only: bool = False  # in it: without topics for viewers
    console: bool = False  # show it in the browser

    @property
    def network_name(self) -> str:
        """The robot's namespace."""
        return self.namespace or (self.session and self.session.namespace) or self.config.robot.name

    @property
    def lab(self) -> Link | None:
        """How to reach the router that the run joins; None when its parts meet on this computer."""
        if self.session is not None:
            return Link.of_file(self.session, self.network_name)
        return None if self.router is None else Link(self.router, self.network_name)


def run(request: RunRequest) -> int:
    """Run it. Returns 0, 1 on a fault or an early end, 3 when the record lacks something, 130 when interrupted."""
    request = replace(request, config=check_plugins(request.config))
    _check_router(request)
    check_recorder(record=request.record)
    if request.console:
        check_console()
    if request.endpoint is not None:
        check_guarded(request.endpoint, "--endpoint", insecure=request.insecure)
    refuse_second_robot(request.endpoint, request.lab)
    link, stop_port = meeting_point(request.endpoint, request.lab, request.network_name)
    ending = Ending()
    with contextlib.closing(stop_port), opened_files(request.config, request.out) as (files, config_file):
        supervisor = Supervisor(files, ending, say, stop_port, stay=request.stay)
        names = (request.config.robot.name, request.config.backend)
        common = [str(config_file), "--namespace", request.network_name, *_meeting(link)]
        with interruptible(ending):
            with (
                registered(LocalRobot.on(link, *names, stop_port, str(config_file.absolute()))) as failure,
                # first, because somebody waits for it
                console_beside(common, files, say) if request.console else contextlib.nullcontext(),
            ):
                if failure is not None:
                    say(failure)
                _conduct(request, supervisor, link, files, config_file, ending)
            from snakesim_operator.run.conclusion import Outcome, conclude

            lost = list(supervisor.lost.values())
            outcome = Outcome(supervisor.host_record(), supervisor.robot(), supervisor.restarts, supervisor.hosts, lost)
            return conclude(request.config, files, ending, outcome, stay=request.stay)


@contextlib.contextmanager
def opened_files(config: RunConfig, out: Path | None) -> Iterator[tuple[RunFiles, Path]]:
    """The run's folder, held, and where its configuration is.

    A folder that cannot be written to is no reason not to run: then nothing is kept.
    """
    out = out or named_after(config.name)
    content = written(config)
    with contextlib.ExitStack() as held:
        try:
            folder = held.enter_context(claimed(out, say))
            write_whole(folder / CONFIG, content)
        except OSError as error:
            held.close()
            say(f"warning: --out {out}: {error.strerror}; the run goes on, but nothing of it is recorded")
            memory = os.memfd_create("snakesim-config")
            held.callback(os.close, memory)
            os.write(memory, content)
            yield RunFiles(None, _warn), Path(f"/proc/{os.getpid()}/fd/{memory}")
        else:
            yield RunFiles(folder, _warn), folder / CONFIG


def check_recorder(*, record: bool) -> None:
    """Raise ConfigError when a recording is wanted that cannot be written: what a run did cannot be had again."""
    if record:
        extras.check("record", "a recording of the run", "; or run with --no-record")


def _warn(failure: str) -> None:
    say(f"warning: {failure}; the run goes on, its record may lack something")


def _check_router(request: RunRequest) -> None:
    if request.with_router:
        if request.lab is not None:
            raise ConfigError(
                "--with-router starts a router of the run's own, --router and --session join another: give one of them"
            )
        return
    wanted = [injection for injection in planned(request.config) if injection.target == ROUTER]
    if wanted:
        raise ConfigError(f"fault {str(wanted[0])!r}: this run has no router of its own; add --with-router")


def _conduct(
    request: RunRequest, supervisor: Supervisor, link: Link, files: RunFiles, config_file: Path, ending: Ending
) -> None:
    """Start the programs `snakesim host` and `snakesim service` as children, and see the run through."""
    config = request.config
    common = [str(config_file), "--namespace", request.network_name]
    meeting = _meeting(link)
    listening = ["--insecure"] if request.insecure else []
    joins = request.router is not None or request.with_router
    host_arguments = [
        *("snakesim_hal.programs.host_program", *common, *listening, "--once", "--memory", supervisor.memory),
        *(["--router", link.endpoint] if joins else meeting),
        *(["--out", str(files.folder)] if files.folder else []),
        *([] if request.stay else ["--end-after-fault", str(AFTER_FAULT_S)]),
    ]
    try:
        if request.with_router:
            supervisor.start(ROUTER, ["snakesim_hal.programs.router_program", *common, *meeting, *listening])
        supervisor.start(HOST, host_arguments)
        for name, service in config.own_services.items():
            if name in config.beside:
                continue
            supervisor.start(
                name, ["snakesim_hal.programs.service_program", name, *common, *meeting], may_restart=service.restart
            )
        if request.record and files.folder is not None:
            recorder = ["snakesim_operator.recording.process", *common, *meeting, "--out", str(files.folder)]
            recorder += ["--raw-only"] if request.raw_only else []
            supervisor.start(RECORDER, recorder, vital=False)
        with _session_of_run(link, supervisor, ending) as session:
            say(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander}, {config.clock_mode}")
            say(f"network: {link.endpoint}, namespace {link.namespace}")
            if not config.has_own_control:
                say("no control service of its own: a client that takes the lease commands and arms the robot")
            RunMonitor(config, session, supervisor, ending, say, stay=request.stay, unchecked=request.unchecked).run()
    except SnakesimError as error:
        ending.because(str(error))
    finally:
        ending.over = True
        supervisor.end()


def _meeting(link: Link) -> list[str]:
    return ["--session", str(link.session.path)] if link.session else ["--endpoint", link.endpoint]


@contextlib.contextmanager
def _session_of_run(link: Link, supervisor: Supervisor, ending: Ending) -> Iterator[Session]:
    """A session on the run's network, as soon as there is one. Raises NotConnectedError when a part has ended."""
    began = shown_at = time.monotonic()
    with contextlib.ExitStack() as stack:
        while True:
            try:
                session = stack.enter_context(open_session(link, connect_timeout_s=CONNECT_S))
                break
            except NotConnectedError:
                ended = supervisor.describe_first_end()
                if ended is not None:
                    raise NotConnectedError(ended) from None
                now = time.monotonic()
                if now > began + START_LIMIT_S or ending.interrupted:
                    raise
                if now > shown_at + TELL_S:
                    say(f"starting: the host has not opened its network yet, after {now - began:.0f} s")
                    shown_at = now
        yield session
