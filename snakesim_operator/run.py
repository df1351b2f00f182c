"""`snakesim run`: starts backend host and services, arms, shows progress, ends everything, writes what is left.

Nothing is started before the whole configuration has been checked. Whatever happens afterwards (the run completes,
somebody presses Ctrl-C, a part fails, this process is killed) no process stays behind.
"""

import contextlib
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import msgspec

from snakesim_hal.errors import ConfigError, NotConnectedError, SnakesimError
from snakesim_hal.files import Table
from snakesim_hal.host_process import HOST_RECORD
from snakesim_hal.injection import ROUTER
from snakesim_hal.planned import check_planned, planned
from snakesim_hal.plugins import BACKENDS, CONTROLLERS, SERVICES, find_plugin, plugin_settings
from snakesim_hal.scenario import RunConfig, write
from snakesim_hal.session import DEFAULT_PORT, Link, Session, open_session
from snakesim_operator.conduct import AFTER_FAULT_S, START_LIMIT_S, Conductor
from snakesim_operator.ending import Ending, interruptible
from snakesim_operator.record import CONFIG, REPORT, SUMMARY, TELEMETRY
from snakesim_operator.supervisor import HOST, Supervisor

CONNECT_S = 0.5


@dataclass(frozen=True)
class RunRequest:
    """What the command line asks for."""

    config: RunConfig
    out: Path | None = None
    endpoint: str | None = None
    router: str | None = None
    namespace: str | None = None
    stay: bool = False  # a fault ends nothing: processes are started again, a person clears and arms
    with_router: bool = False  # the run's parts meet at a router of its own


def check_plugins(config: RunConfig, table: Table | None = None) -> RunConfig:
    """Everything that a run needs is installed and agrees with its settings. Raises ConfigError.

    Returns the configuration, with a pace that the backend can keep: a scenario is written for any backend.
    """
    source = table.source if table is not None else f"scenario {config.name!r}"
    origin = table.origin if table is not None else None
    backend, controller = find_plugin(BACKENDS, config.backend), find_plugin(CONTROLLERS, config.controller)
    settings = plugin_settings(backend, config.backend_settings, source, config.backend_section, origin)
    plugin_settings(controller, config.control_settings, source, config.control_section, origin)
    for service in config.services:
        find_plugin(SERVICES, service)
    check_planned(config, table)
    paces = backend.check(config, settings)
    if config.pace in paces:
        return config
    asked_by = table.origin_of("pace") if table is not None else source
    if asked_by.startswith("--"):
        raise ConfigError(f"{asked_by}: backend {config.backend!r} cannot keep this pace, only {' or '.join(paces)}")
    return msgspec.structs.replace(config, pace=paces[0])


def run(request: RunRequest) -> int:
    """Run it. Returns 0, 1 on a fault, 130 when interrupted."""
    request = replace(request, config=check_plugins(request.config))
    _check_router(request)
    out = _folder(request)
    write(request.config, out / CONFIG)
    ending = Ending()
    supervisor = Supervisor(out, ending, _say, stay=request.stay)
    with interruptible(ending):
        _conduct(request, supervisor, out, ending)
    if not (out / HOST_RECORD).is_file():
        print(f"the run left no record: {ending.reason or 'the host ended early'}; what its parts said is in {out}")
        return 130 if ending.interrupted else 1
    from snakesim_operator.conclusion import conclude

    return conclude(out, ending, supervisor.restarts, supervisor.hosts, stay=request.stay)


def _check_router(request: RunRequest) -> None:
    if request.with_router:
        if request.router is not None:
            raise ConfigError(
                "--with-router starts a router of the run's own, --router joins another: give one of them"
            )
        return
    wanted = [injection for injection in planned(request.config) if injection.target == ROUTER]
    if wanted:
        raise ConfigError(f"fault {str(wanted[0])!r}: this run has no router of its own; add --with-router")


def _conduct(request: RunRequest, supervisor: Supervisor, out: Path, ending: Ending) -> None:
    config = request.config
    endpoint = request.router or request.endpoint or _free_endpoint()
    namespace = request.namespace or config.robot.name
    common = ["--config", str(out / CONFIG), "--endpoint", endpoint, "--namespace", namespace]
    ticks = round(config.duration_s * config.rate_hz)
    host_arguments = [
        *("snakesim_hal.host_process", *common, "--out", str(out), "--max-ticks", str(ticks)),
        *(["--stay"] if request.stay else ["--end-after-fault", str(AFTER_FAULT_S)]),
        *(["--router"] if request.router or request.with_router else []),
    ]
    try:
        if request.with_router:
            supervisor.start(ROUTER, ["snakesim_hal.router_process", *common])
        supervisor.start(HOST, host_arguments)
        for name, service in config.services.items():
            supervisor.start(name, ["snakesim_hal.serve", name, *common], may_restart=service.restart)
        with _joined(Link(endpoint, namespace), supervisor, ending) as session:
            _say(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.controller}, {config.pace}")
            _say(f"network: {endpoint}, namespace {namespace}")
            Conductor(config, session, supervisor, out, ending, _say, stay=request.stay).go()
    except SnakesimError as error:
        ending.because(str(error))
    finally:
        supervisor.end()


@contextlib.contextmanager
def _joined(link: Link, supervisor: Supervisor, ending: Ending) -> Iterator[Session]:
    """A session on the run's network, as soon as there is one. Raises NotConnectedError when a part has ended."""
    give_up = time.monotonic() + START_LIMIT_S
    with contextlib.ExitStack() as stack:
        while True:
            try:
                session = stack.enter_context(open_session(link, connect_timeout_s=CONNECT_S))
                break
            except NotConnectedError:
                ended = supervisor.first_ended()
                if ended is not None:
                    raise NotConnectedError(ended) from None
                if time.monotonic() > give_up or ending.interrupted:
                    raise
        yield session


def _folder(request: RunRequest) -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    out = request.out or Path("runs") / f"{request.config.name}-{stamp}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in (HOST_RECORD, SUMMARY, REPORT, TELEMETRY):
            (out / old).unlink(missing_ok=True)
        for old in out.glob(TELEMETRY.replace(".", "-*.")):
            old.unlink()
    except OSError as error:
        raise ConfigError(f"--out {out}: {error.strerror}; choose another folder") from error
    return out.resolve()


def _free_endpoint() -> str:
    """The default port, or any free one when another run has it."""
    for port in (DEFAULT_PORT, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(OSError):
                probe.bind(("127.0.0.1", port))
                return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    raise NotConnectedError("no free port on the loopback interface")


def _say(text: str) -> None:
    print(text, flush=True)
