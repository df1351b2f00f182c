"""`snakesim status`: prints the state of running robots."""

import contextlib
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from queue import Empty
from typing import Any

from snakesim_hal.base.errors import NotConnectedError, WireError
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.endpoint import is_exposed
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.process_entries import HOST, find_differences
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.streams import Arrival
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Description, Process, Status
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, flags_of, namespace_of
from snakesim_operator.results import last_run

STATUS_WAIT_S = 1.0  # for the messages of a network
ONE_ATTEMPT_S = 0.0  # as a time to connect: Zenoh tries once, and reports a refused connection at once


@dataclass(frozen=True)
class _Robot:
    """What a robot on the network has published."""

    link: Link
    statuses: list[Status]  # the newest of each of its hosts
    processes: list[Process]  # that live
    description: Description | None  # of the host with the last of these statuses; None: none arrived

    @property
    def status(self) -> Status:
        """The status that is shown."""
        return self.statuses[-1]

    @property
    def is_impostor(self) -> bool:
        """Whether more than one host has the robot's name."""
        return len({status.host for status in self.statuses}) > 1


def show_status(where: RobotSelection, *, as_json: bool = False) -> int:
    """Print the state of every reachable robot, and name robots of this computer that do not answer.

    Args:
        where: Selects the robots.
        as_json: Print one JSON object instead of text.

    Returns:
        0 if there is a robot, all robots answer and none has a fault; otherwise 1.
    """
    local_robots = where.local()
    local_endpoints = {robot.endpoint for robot in local_robots}
    robots: list[_Robot] = []
    for link in where.networks():
        with contextlib.suppress(NotConnectedError):
            robots += _find_robots(link, _choose_connect_time(link, local_endpoints))
    reachable = {(robot.link.endpoint, robot.link.namespace) for robot in robots}
    silent = [robot for robot in where.local() if (robot.endpoint, robot.namespace) not in reachable]
    has_fault = any(robot.status.lifecycle not in ("armed", "disarmed") for robot in robots)
    is_all_right = bool(robots) and not has_fault and not silent
    exit_code = 0 if is_all_right else 1
    if as_json:
        print_json({"robots": [_as_json(robot) for robot in robots], "silent": silent})
        return exit_code
    for robot in silent:
        print_line(f"{robot.namespace}: NO ANSWER on {robot.endpoint}; its run is process {robot.pid}")
    if not robots and not silent:
        _print_no_robot(where)
    for robot in robots:
        _print_robot(robot)
    return exit_code


def _print_no_robot(where: RobotSelection) -> None:
    """Print how the last run on this computer ended, and how to start another."""
    last = last_run.read_last_run()
    ending = f"; the last run on this computer ended so: {last.ended} ({last.folder})" if last is not None else ""
    print_line(f"no robot answers on {', '.join(where.endpoints())}{ending}")
    print_line("  next: `snakesim run triplet --console`, or another of `snakesim scenario list`")


def _print_robot(robot: _Robot) -> None:
    lines = [*_describe_robot(robot), *processes_in_words(robot.processes)]
    if robot.is_impostor:
        lines.append("  IMPOSTOR: more than one host publishes a status under this name; trust none of them")
    lines += _next_commands(robot.link, robot.status)
    for line in lines:
        print_line(line)


class _NetworkMessages:
    """Collects the messages of all robots on one network."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._decoders = {
            keys.STATUS: Decoder(Status),
            keys.PROCESS_ALL: Decoder(Process),
            keys.DESCRIPTION: Decoder(Description),
        }
        self.statuses: dict[str, dict[str | None, Status]] = {}  # by robot, then by host
        self.descriptions: dict[tuple[str, str | None], Description] = {}  # by robot and host
        self.processes: dict[str, list[Process]] = {}  # by robot

    def read(self, session: Session) -> None:
        """Subscribe, and collect messages for STATUS_WAIT_S."""
        arrivals: Mailbox[Arrival] = Mailbox()
        prefix = "" if self._link.namespace is not None else "**/"
        for key in self._decoders:
            session.on_latched_arrival(f"{prefix}{key}", arrivals.put)
        live = set(session.present(f"{prefix}{keys.PROCESS_ALL}"))
        deadline = time.monotonic() + STATUS_WAIT_S
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                arrival = arrivals.get(timeout=left_s)
            except Empty:
                break
            with contextlib.suppress(WireError):
                self._add(arrival, live)

    def _add(self, arrival: Arrival, live: set[str]) -> None:
        """Decode a message and keep it. live: keys of the processes that run. Raises WireError."""
        decoder = self._decoders[keys.PROCESS_ALL]
        for key in (keys.STATUS, keys.DESCRIPTION):
            if arrival.key.endswith(key):
                decoder = self._decoders[key]
        message = decoder.decode(arrival.payload, arrival.encoding)
        name = self._link.namespace or namespace_of(arrival.key)
        match message:
            case Status():
                self.statuses.setdefault(name, {})[message.host] = message
            case Description():
                self.descriptions[name, message.host] = message
            case Process():
                if arrival.key in live:
                    self.processes.setdefault(name, []).append(message)


def _choose_connect_time(link: Link, running_here: Collection[str]) -> float:
    """Return how long to try to connect to a network, in s.

    On loopback Zenoh reports at once whether a process listens, so one attempt is enough. It is repeated where a run of
    this computer is about to listen, and where packets may be lost on the way.
    """
    if link.session is None and link.endpoint not in running_here and not is_exposed(link.endpoint):
        return ONE_ATTEMPT_S
    return CONNECT_S


def _find_robots(link: Link, connect_s: float) -> list[_Robot]:
    """Return the robots on a network, sorted by name. Raises NotConnectedError."""
    messages = _NetworkMessages(link)
    with open_session(link, connect_s) as session:
        messages.read(session)
    robots: list[_Robot] = []
    for name, status_by_host in sorted(messages.statuses.items()):
        statuses = list(status_by_host.values())
        description = messages.descriptions.get((name, statuses[-1].host))
        processes = messages.processes.get(name, [])
        robots.append(_Robot(replace(link, namespace=name), statuses, processes, description))
    return robots


def _as_json(robot: _Robot) -> dict[str, Any]:
    return {
        "namespace": robot.link.namespace,
        "endpoint": robot.link.endpoint,
        "emulated": None if robot.description is None else robot.description.emulated,  # null: unknown
        "impostor": robot.is_impostor,
        "processes": robot.processes,
        "status": robot.status,
    }


def processes_in_words(processes: Sequence[Process]) -> list[str]:
    """Return lines for each process: machine, version, uptime, and how its configuration differs from the host's."""
    host = next((entry for entry in processes if entry.name == HOST), None)
    lines: list[str] = []
    for entry in sorted(processes, key=lambda entry: (entry.name != HOST, entry.name, entry.machine, entry.pid)):
        uptime_s = time.time() - entry.started_unix_s
        uptime = "its clock is ahead of this one's"
        if uptime_s >= 0:
            uptime = f"for {timedelta(seconds=round(uptime_s))}"
        lines.append(
            f"  process {entry.name}: {entry.machine}, {entry.pid} of {entry.user}, snakesim {entry.version}, {uptime}"
        )
        if host is not None:
            lines += [f"    DIFFERS: {difference}" for difference in find_differences(entry, host)]
    return lines


def _describe_robot(robot: _Robot) -> list[str]:
    link = robot.link
    status = robot.status
    return [
        f"{link.namespace}: {status.lifecycle} - {status.reason}",
        f"  {describe_what_moves(robot.description)}",
        f"  robot {status.robot}, backend {status.backend}, {status.clock_mode} at {status.rate_hz:g} Hz, "
        f"tick {status.tick}, on {link.endpoint}",
        f"  lease: {status.lease_holder or 'free'} (epoch {status.lease_epoch})",
        f"  alive: {', '.join(status.alive) or 'none'}",
        f"  commands: {status.commands_accepted} accepted, {status.commands_standby} while disarmed, rejected: "
        f"{_format_counts(status.commands_rejected)}; "
        f"joint targets limited: {_format_counts(status.commands_limited)}",
        *_describe_limits(status),
        *_describe_faults(status),
    ]


def _format_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in sorted(counts.items())) or "none"


def _describe_limits(status: Status) -> list[str]:
    """Return what keeps the robot from its full performance; empty if there is nothing."""
    lines: list[str] = []
    if status.paused_by is not None:
        lines.append(f"  PAUSED by {status.paused_by}; `snakesim sim resume` or `step` continues")
    elif status.speed != 1.0:
        lines.append(f"  speed {status.speed:g} is requested")
    for joint, fraction in sorted(status.derated.items()):
        lines.append(f"  derated: {joint} has {100 * fraction:.0f} % of its torque left")
    if status.isolated:
        lines.append(f"  isolated: {', '.join(status.isolated)}; passive until a reset")
    lines += [f"  real time: {warning}" for warning in status.realtime_warnings]
    if status.unchecked:
        lines.append(f"  not checked: {status.unchecked}")
    lines += [f"  injected fault: {fault}" for fault in status.injected]
    if status.waiting_for:
        lines.append(f"  waiting for: {', '.join(status.waiting_for)}")
    return lines


def _describe_faults(status: Status) -> list[str]:
    """Return a line for each kind of fault, with its first tick and its count."""
    ticks: dict[tuple[str, str, str], list[int]] = {}
    for fault in status.faults:
        joint_text = f" at {fault.joint}" if fault.joint else ""
        ticks.setdefault((fault.what, joint_text, fault.cause), []).append(fault.tick)
    lines: list[str] = []
    for (what, joint_text, cause), fault_ticks in ticks.items():
        repetitions = f" and {len(fault_ticks) - 1} times more" if len(fault_ticks) > 1 else ""
        lines.append(f"  fault {what}{joint_text} at tick {fault_ticks[0]}{repetitions}: {cause}")
    if status.faults_left_out:
        lines.append(f"  and {status.faults_left_out} more faults, between the first and the newest of these")
    return lines


def _next_commands(link: Link, status: Status) -> list[str]:
    """Return lines with the commands that the operator may type next, which depend on the state of the robot.

    Args:
        link: How to reach the robot; the commands get the same options.
        status: The newest status of the robot.
    """
    flags = flags_of(link, status.robot)
    reset = f"`snakesim robot reset{flags}`"
    arm = f"`snakesim robot arm {status.robot} {status.backend}{flags}`"
    if status.lifecycle in ("fault", "estop"):
        return [f"  next: {reset}, then {arm}"]
    if status.isolated and status.lifecycle == "disarmed":
        lines = [f"  next: {reset}, to end the isolation of {', '.join(status.isolated)}"]
        if status.ready_to_arm:
            lines.append(f"  or, without: {arm}")
        return lines
    if status.lifecycle == "armed":
        return [
            f"  next: `snakesim console{flags}` to watch, `snakesim robot disarm{flags}` or `snakesim estop` to stop it"
        ]
    if status.ready_to_arm:
        return [f"  next: {arm}"]
    starts = [f"`snakesim start service {name} SCENARIO{flags}`" for name in status.waiting_for]
    if starts:
        return [f"  next: {', '.join(starts)}"]
    return ["  next: `snakesim status` again: what prevents arming is named above"]
