"""`snakesim run`: starts backend host and services, arms, shows progress, ends everything, writes what is left.

Nothing is started before the whole configuration has been checked. Whatever happens afterwards (the run completes,
somebody presses Ctrl-C, a part fails, this process is killed) no process stays behind.
"""

import contextlib
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec

from snakesim_hal import keys
from snakesim_hal.errors import ConfigError, NotConnectedError, SnakesimError
from snakesim_hal.files import Table
from snakesim_hal.host_process import HOST_RECORD
from snakesim_hal.messages import ControlState, LifecycleRequest, Message, Status, World
from snakesim_hal.plugins import BACKENDS, CONTROLLERS, SERVICES, find_plugin, plugin_settings
from snakesim_hal.scenario import RunConfig, write
from snakesim_hal.session import DEFAULT_PORT, Link, Reader, Session, open_session
from snakesim_operator import children, lastrun
from snakesim_operator.children import Child
from snakesim_operator.progress import Progress
from snakesim_operator.record import CONFIG, REPORT, SUMMARY, TELEMETRY, RunRecord
from snakesim_operator.summary import RunSummary, summarise

START_LIMIT_S = 120.0  # MuJoCo on a slow machine
AFTER_FAULT_S = 1.5
POLL_S = 0.05
CONNECT_S = 0.5
TELEMETRY_DEPTH = 8192
WORLDS_PER_S = 20.0  # as often as control tells its state
JOINTS_SHOWN = 8


@dataclass(frozen=True)
class RunRequest:
    """What the command line asks for."""

    config: RunConfig
    out: Path | None = None
    endpoint: str | None = None
    router: str | None = None
    namespace: str | None = None


@dataclass
class Ending:
    """How the run ended, as it becomes known."""

    causes: list[str] = field(default_factory=list[str])
    interrupted: bool = False

    @property
    def reason(self) -> str | None:
        """Everything that went wrong, in the order in which it was noticed; None when nothing did."""
        return "; ".join(self.causes) or None

    def because(self, cause: str) -> None:
        """Note what went wrong."""
        if cause not in self.causes:
            self.causes.append(cause)


@dataclass
class Telemetry:
    """Writes control states and worlds as they come, decoded once."""

    file: Any
    control: Reader[ControlState]
    world: Reader[World]
    period_ns: int
    latest: ControlState | None = None
    _next_world_ns: int = field(default=0)

    def take_in(self) -> None:
        """Write what arrived."""
        for state in self.control.drain():
            self.latest = state
            self._write(keys.CONTROL_STATE, state)
        for world in self.world.drain():
            if world.stamp_ns >= self._next_world_ns:
                self._next_world_ns = world.stamp_ns + round(1e9 / WORLDS_PER_S)
                self._write(keys.WORLD, world)

    def _write(self, key: str, message: Message) -> None:
        self.file.write(msgspec.json.encode({"key": key, "message": message}) + b"\n")


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
    out = _folder(request)
    write(request.config, out / CONFIG)
    ending = Ending()
    with _interruptible(ending):
        _conduct(request, out, ending)
    if not (out / HOST_RECORD).is_file():
        print(f"the run left no record: {ending.reason or 'the host ended early'}; what its parts said is in {out}")
        return 130 if ending.interrupted else 1
    return _conclude(out, ending)


def _conduct(request: RunRequest, out: Path, ending: Ending) -> None:
    config = request.config
    endpoint = request.router or request.endpoint or _free_endpoint()
    namespace = request.namespace or config.robot.name
    common = ["--config", str(out / CONFIG), "--endpoint", endpoint, "--namespace", namespace]
    ticks = round(config.duration_s * config.rate_hz)
    host_arguments = [
        *("snakesim_hal.host_process", *common, "--out", str(out), "--max-ticks", str(ticks)),
        *("--end-after-fault", str(AFTER_FAULT_S)),
        *(["--router"] if request.router else []),
    ]
    started = [children.start("host", host_arguments, out / "host.log")]
    try:
        for name in config.services:
            log = out / f"{name}.log"
            started.append(children.start(name, ["snakesim_hal.serve", name, *common], log))
        with _joined(Link(endpoint, namespace), started) as session:
            _say(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.controller}, {config.pace}")
            _say(f"network: {endpoint}, namespace {namespace}")
            _watch(config, session, started, out, ending)
    except SnakesimError as error:
        ending.because(str(error))
    finally:
        _await_host(started[0], ending)
        _somebody_failed(started[1:], ending)
        children.stop_all(started)
        _print_last_words(started, ending)


@contextlib.contextmanager
def _joined(link: Link, started: Sequence[Child]) -> Iterator[Session]:
    """A session on the run's network, as soon as there is one. Raises NotConnectedError when a part has ended."""
    give_up = time.monotonic() + START_LIMIT_S
    with contextlib.ExitStack() as stack:
        while True:
            try:
                yield stack.enter_context(open_session(link, connect_timeout_s=CONNECT_S))
                return
            except NotConnectedError:
                ended = [how for child in started if (how := child.how_it_ended()) is not None]
                if ended:
                    raise NotConnectedError(ended[0]) from None
                if time.monotonic() > give_up:
                    raise


def _watch(config: RunConfig, session: Session, started: Sequence[Child], out: Path, ending: Ending) -> None:
    statuses = session.latched_reader(keys.STATUS, Status)
    control = session.reader(keys.CONTROL_STATE, ControlState, depth=TELEMETRY_DEPTH)
    world = session.reader(keys.WORLD, World, depth=TELEMETRY_DEPTH)
    with (out / TELEMETRY).open("wb") as file, Progress(config) as progress:
        telemetry = Telemetry(file, control, world, config.period_ns)
        armed = False
        give_up = time.monotonic() + START_LIMIT_S
        status: Status | None = None
        while started[0].process.poll() is None:
            status = (statuses.drain() or [status])[-1]
            telemetry.take_in()
            progress.show(status, telemetry.latest, armed=armed)
            if _somebody_failed(started[1:], ending) or ending.interrupted:
                break
            if status is not None and status.faults:
                ending.because(status.faults[0].cause)
            if not armed and status is not None and status.ready_to_arm:
                _arm(session, status)
                armed = True
            if not armed and time.monotonic() > give_up:
                ending.because(
                    f"not ready to arm within {START_LIMIT_S:.0f} s: {status.why if status else 'no status'}"
                )
                break
            time.sleep(POLL_S)
        if ending.reason is not None and armed and not ending.interrupted:
            _let_it_settle(started[0], telemetry, progress, statuses, ending)
        telemetry.take_in()


def _let_it_settle(
    host: Child, telemetry: Telemetry, progress: Progress, statuses: Reader[Status], ending: Ending
) -> None:
    """After a failure the host goes on for a moment: the safe stop belongs in the record, and in `snakesim status`."""
    deadline = time.monotonic() + 2 * AFTER_FAULT_S
    while host.process.poll() is None and time.monotonic() < deadline and not ending.interrupted:
        for status in statuses.drain():
            progress.show(status, telemetry.latest, armed=True)
        telemetry.take_in()
        time.sleep(POLL_S)


def _somebody_failed(services: Sequence[Child], ending: Ending) -> bool:
    for child in services:
        how = child.how_it_ended()
        if how is not None:
            ending.because(how)
            return True
    return False


def _arm(session: Session, status: Status) -> None:
    session.ask(
        keys.LIFECYCLE,
        LifecycleRequest(action="arm", robot=status.robot, backend=status.backend),
        timeout_s=10.0,
    )


def _await_host(host: Child, ending: Ending) -> None:
    """Have the host end in order, so that its record is written."""
    if host.process.poll() is None:
        host.process.send_signal(signal.SIGTERM)
        with contextlib.suppress(Exception):
            host.process.wait(children.STOP_LIMIT_S)
    how = host.how_it_ended()
    if host.process.returncode not in (0, 1, None) and how is not None:
        ending.because(how)


def _print_last_words(started: Sequence[Child], ending: Ending) -> None:
    if ending.reason is None or ending.interrupted:
        return
    for child in started:
        words = child.last_words()
        if words:
            _say(f"--- {child.name} said:\n{words}")


def _conclude(out: Path, ending: Ending) -> int:
    from snakesim_operator.report import write_report

    record = RunRecord.load(out)
    for fault in record.host.faults:
        ending.because(fault.cause)
    ended = "interrupted" if ending.interrupted else ending.reason or "complete"
    summary = summarise(record, ended)
    (out / SUMMARY).write_bytes(msgspec.json.format(msgspec.json.encode(summary), indent=2))
    write_report(record, summary)
    _print_summary(summary)
    print(f"summary: {out / SUMMARY}\nreport:  {out / REPORT}")
    failed = ended not in ("complete", "interrupted")
    lastrun.remember(out, ended)
    if failed:
        print(f"fault: {ended}")
    return 130 if ending.interrupted else 1 if failed else 0


def _print_summary(summary: RunSummary) -> None:
    def number(value: float | None, unit: str, digits: int = 2) -> str:
        return "unknown" if value is None else f"{value:.{digits}f} {unit}"

    rows = [
        ("moved along the path", number(summary.path_distance_m, "m", 3)),
        (
            "time",
            f"{summary.duration_s:.2f} s in {summary.wall_s:.2f} s ({number(summary.real_time_factor, 'x', 1)})",
        ),
        (
            "locomoting",
            "unknown" if summary.locomoting_fraction is None else f"{100 * summary.locomoting_fraction:.0f} %",
        ),
        ("propulsion joints", _in_short(summary.propulsion_joints)),
        ("peak joint torque", number(summary.peak_joint_torque_nm, "N·m")),
        ("peak contact force", number(summary.peak_contact_force_n, "N", 1)),
        ("last state", f"{summary.last_state or 'unknown'}: {summary.last_reason or ''}"),
        ("command digest", summary.command_digest[:16]),
    ]
    if summary.jammed:
        rows.append(("JAMMED", "the controller reported a jam; see the report"))
    for name, value in rows:
        print(f"  {name:<22}{value}")


def _in_short(joints: Sequence[str]) -> str:
    if len(joints) <= JOINTS_SHOWN:
        return " -> ".join(joints) or "none"
    return f"{' -> '.join(joints[:JOINTS_SHOWN])} -> ... ({len(joints)} hand-overs in all)"


def _folder(request: RunRequest) -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    out = request.out or Path("runs") / f"{request.config.name}-{stamp}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in (HOST_RECORD, SUMMARY, REPORT, TELEMETRY):
            (out / old).unlink(missing_ok=True)
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


@contextlib.contextmanager
def _interruptible(ending: Ending) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the run in order; a second one is left to the default."""

    def handle(number: int, _frame: FrameType | None) -> None:
        ending.interrupted = True
        signal.signal(number, signal.SIG_DFL)

    old = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def _say(text: str) -> None:
    print(text, flush=True)
