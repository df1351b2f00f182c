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
from snakesim_hal.network.process_entries import HOST, describe_differences
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import ProcessInfo, RobotDescription, RobotStatus
from snakesim_operator.base.targets import (
    CONNECT_TIMEOUT_S,
    RobotSelection,
    get_namespace,
    make_robot_flags,
)
from snakesim_operator.results import last_run

MESSAGE_WAIT_S = 1.0  # for the messages of a network
# As a time to connect: Zenoh tries once, and reports a refused connection at once.
SINGLE_ATTEMPT_TIMEOUT_S = 0.0


# Lifecycle states of a robot without a fault.
STATES_WITHOUT_FAULT = ("armed", "disarmed")


@dataclass(frozen=True)
class _ReachableRobot:
    """A robot on the network with its newest messages, as `snakesim status` prints them."""

    link: ConnectionSettings
    # Newest status of each host with the robot's name; more than one means an impostor.
    statuses: list[RobotStatus]
    processes: list[ProcessInfo]  # running processes of the robot
    # From the host with the last of these statuses; None if none arrived.
    description: RobotDescription | None

    @property
    def status(self) -> RobotStatus:
        """The status that is printed."""
        return self.statuses[-1]

    @property
    def is_impostor(self) -> bool:
        """Whether more than one host has the robot's name."""
        return len({status.host for status in self.statuses}) > 1


def print_status(selection: RobotSelection, *, as_json: bool = False) -> int:
    """Print the state of every reachable robot, and name robots of this computer that do not answer.

    Args:
        selection: Selects the robots.
        as_json: Whether to print one JSON object instead of text.

    Returns:
        The exit code: 0 if there is a robot, all robots answer and none has a fault; otherwise 1.
    """
    local_robots = selection.list_local_robots()
    local_endpoints = {robot.endpoint for robot in local_robots}
    robots: list[_ReachableRobot] = []
    for link in selection.list_networks():
        with contextlib.suppress(NotConnectedError):
            robots += _find_robots(link, _choose_connect_timeout_s(link, local_endpoints))
    reachable_addresses = {(robot.link.endpoint, robot.link.namespace) for robot in robots}
    # Listed again: a robot whose run has ended in the meantime is not silent.
    silent_robots = [
        robot
        for robot in selection.list_local_robots()
        if (robot.endpoint, robot.namespace) not in reachable_addresses
    ]
    has_fault = any(robot.status.lifecycle not in STATES_WITHOUT_FAULT for robot in robots)
    is_all_right = bool(robots) and not has_fault and not silent_robots
    exit_code = 0 if is_all_right else 1
    if as_json:
        print_json(
            {"robots": [_convert_to_json(robot) for robot in robots], "silent": silent_robots}
        )
        return exit_code
    for robot in silent_robots:
        print_line(
            f"{robot.namespace}: NO ANSWER on {robot.endpoint}; its run is process {robot.pid}"
        )
    if not robots and not silent_robots:
        _print_no_robot(selection)
    for robot in robots:
        _print_robot(robot)
    return exit_code


def _print_no_robot(selection: RobotSelection) -> None:
    """Print how the last run on this computer ended, and how to start another."""
    last = last_run.read_last_run()
    ending = (
        f"; the last run on this computer ended so: {last.ended} ({last.folder})"
        if last is not None
        else ""
    )
    print_line(f"no robot answers on {', '.join(selection.list_endpoints())}{ending}")
    print_line("  next: `snakesim run triplet --console`, or another of `snakesim scenario list`")


def _print_robot(robot: _ReachableRobot) -> None:
    """Print state, processes and next commands of a robot, with a warning if another host uses its name."""
    lines = [*_describe_robot(robot), *describe_processes(robot.processes)]
    if robot.is_impostor:
        lines.append(
            "  IMPOSTOR: more than one host publishes a status under this name; trust none of them"
        )
    lines += _suggest_next_commands(robot.link, robot.status)
    for line in lines:
        print_line(line)


class _NetworkMessages:
    """Collects the messages of all robots on one network."""

    def __init__(self, connection: ConnectionSettings) -> None:
        self._connection = connection
        self._decoders = {
            keys.STATUS: MessageDecoder(RobotStatus),
            keys.PROCESS_ALL: MessageDecoder(ProcessInfo),
            keys.DESCRIPTION: MessageDecoder(RobotDescription),
        }
        self.statuses: dict[str, dict[str | None, RobotStatus]] = {}  # by robot, then by host
        self.descriptions: dict[tuple[str, str | None], RobotDescription] = {}  # by robot and host
        self.processes: dict[str, list[ProcessInfo]] = {}  # by robot

    def read(self, session: Session) -> None:
        """Subscribe to status, descriptions and processes, and collect these messages for MESSAGE_WAIT_S."""
        arrivals: Mailbox[ReceivedSample] = Mailbox()
        prefix = "" if self._connection.namespace is not None else "**/"
        for key in self._decoders:
            session.on_latched_arrival(f"{prefix}{key}", arrivals.put)
        live_process_keys = set(session.list_tokens(f"{prefix}{keys.PROCESS_ALL}"))
        deadline_s = time.monotonic() + MESSAGE_WAIT_S
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            try:
                arrival = arrivals.get(timeout=remaining_s)
            except Empty:
                break
            with contextlib.suppress(WireError):
                self._decode_and_store(arrival, live_process_keys)

    def _decode_and_store(self, arrival: ReceivedSample, live_process_keys: set[str]) -> None:
        """Decode a message and store it.

        Args:
            arrival: The message, with its key.
            live_process_keys: Keys of the processes that run. The entries of other processes are ignored.

        Raises:
            WireError: The message is invalid.
        """
        # Keys of processes end in the name of the process, so they are recognized by exclusion.
        decoder = self._decoders[keys.PROCESS_ALL]
        for key in (keys.STATUS, keys.DESCRIPTION):
            if arrival.key.endswith(key):
                decoder = self._decoders[key]
        message = decoder.decode(arrival.payload, arrival.encoding)
        name = self._connection.namespace or get_namespace(arrival.key)
        match message:
            case RobotStatus():
                self.statuses.setdefault(name, {})[message.host] = message
            case RobotDescription():
                self.descriptions[name, message.host] = message
            case ProcessInfo():
                if arrival.key in live_process_keys:
                    self.processes.setdefault(name, []).append(message)


def _choose_connect_timeout_s(
    connection: ConnectionSettings, local_endpoints: Collection[str]
) -> float:
    """Return the time in s for which to try to connect to a network.

    On loopback Zenoh reports at once whether a process listens, so one attempt is enough. Attempts are repeated where
    a run on this computer is about to listen, and where packets may be lost on the way.

    Args:
        connection: How to reach the network.
        local_endpoints: Endpoints of the robots that run on this computer.
    """
    if (
        connection.session is None
        and connection.endpoint not in local_endpoints
        and not is_exposed(connection.endpoint)
    ):
        return SINGLE_ATTEMPT_TIMEOUT_S
    return CONNECT_TIMEOUT_S


def _find_robots(connection: ConnectionSettings, connect_timeout_s: float) -> list[_ReachableRobot]:
    """Return the robots on a network with their newest messages, sorted by name.

    Args:
        connection: How to reach the network.
        connect_timeout_s: Time for which to try to connect.

    Raises:
        NotConnectedError: The network cannot be reached.
    """
    messages = _NetworkMessages(connection)
    with open_session(connection, connect_timeout_s) as session:
        messages.read(session)
    robots: list[_ReachableRobot] = []
    for name, status_by_host in sorted(messages.statuses.items()):
        statuses = list(status_by_host.values())
        description = messages.descriptions.get((name, statuses[-1].host))
        processes = messages.processes.get(name, [])
        robots.append(
            _ReachableRobot(replace(connection, namespace=name), statuses, processes, description)
        )
    return robots


def _convert_to_json(robot: _ReachableRobot) -> dict[str, Any]:
    """Return what `snakesim status --json` prints of a robot."""
    is_emulated = None  # unknown
    if robot.description is not None:
        is_emulated = robot.description.emulated
    return {
        "namespace": robot.link.namespace,
        "endpoint": robot.link.endpoint,
        "emulated": is_emulated,
        "impostor": robot.is_impostor,
        "processes": robot.processes,
        "status": robot.status,
    }


def describe_processes(processes: Sequence[ProcessInfo]) -> list[str]:
    """Return lines for each process: machine, version, uptime, and how its configuration differs from the host's."""
    host = next((entry for entry in processes if entry.name == HOST), None)
    lines: list[str] = []
    for entry in sorted(
        processes, key=lambda entry: (entry.name != HOST, entry.name, entry.machine, entry.pid)
    ):
        uptime_s = time.time() - entry.started_unix_s
        uptime = "its clock is ahead of this one's"
        if uptime_s >= 0:
            uptime = f"for {timedelta(seconds=round(uptime_s))}"
        lines.append(
            f"  process {entry.name}: {entry.machine}, {entry.pid} of {entry.user}, snakesim {entry.version}, {uptime}"
        )
        if host is not None:
            lines += [
                f"    DIFFERS: {difference}" for difference in describe_differences(entry, host)
            ]
    return lines


def _describe_robot(robot: _ReachableRobot) -> list[str]:
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


def _describe_limits(status: RobotStatus) -> list[str]:
    """Return lines about restrictions of the robot: pause, speed, derating, isolated joints, injected faults and so on.

    Args:
        status: Newest status of the robot.

    Returns:
        One line for each restriction; empty if there is none.
    """
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


def _describe_faults(status: RobotStatus) -> list[str]:
    """Return a line for each kind of fault, with its first tick and its count."""
    ticks_by_fault: dict[tuple[str, str, str], list[int]] = {}
    for fault in status.faults:
        joint_text = f" at {fault.joint}" if fault.joint else ""
        ticks_by_fault.setdefault((fault.what, joint_text, fault.cause), []).append(fault.tick)
    lines: list[str] = []
    for (what, joint_text, cause), fault_ticks in ticks_by_fault.items():
        repetitions = f" and {len(fault_ticks) - 1} times more" if len(fault_ticks) > 1 else ""
        lines.append(f"  fault {what}{joint_text} at tick {fault_ticks[0]}{repetitions}: {cause}")
    if status.faults_left_out:
        lines.append(
            f"  and {status.faults_left_out} more faults, between the first and the newest of these"
        )
    return lines


def _suggest_next_commands(connection: ConnectionSettings, status: RobotStatus) -> list[str]:
    """Return lines with the commands that the operator may type next, which depend on the state of the robot.

    Args:
        connection: How to reach the robot. The suggested commands get the same options.
        status: Newest status of the robot.
    """
    flags = make_robot_flags(connection, status.robot)
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
    start_commands = [
        f"`snakesim start service {name} SCENARIO{flags}`" for name in status.waiting_for
    ]
    if start_commands:
        return [f"  next: {', '.join(start_commands)}"]
    return ["  next: `snakesim status` again: what prevents arming is named above"]
