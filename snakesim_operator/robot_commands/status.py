"""`snakesim status`: the state of running robots."""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from queue import Empty

from snakesim_hal.base.errors import NotConnectedError, WireError
from snakesim_hal.base.terminal import say, say_json
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.process_entries import HOST, differences
from snakesim_hal.network.session import Arrival, Link, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Description, Process, Status
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, flags_of, namespace_of
from snakesim_operator.results import last_run

STATUS_WAIT_S = 1.0


@dataclass(frozen=True)
class _Robot:
    """What a robot on the network says of itself."""

    link: Link
    statuses: list[Status]  # the newest of each of its hosts
    processes: list[Process]  # that live
    description: Description | None  # of the host with the last of these statuses; None: none arrived

    @property
    def status(self) -> Status:
        """The one that is shown."""
        return self.statuses[-1]

    @property
    def is_impostor(self) -> bool:
        """Whether more than one host has its name."""
        return len({status.host for status in self.statuses}) > 1


def show_status(where: RobotSelection, *, as_json: bool = False) -> int:
    """Print the state of every reachable robot. Returns 0 without faults, 1 otherwise."""
    found: list[_Robot] = []
    for link in where.networks():
        with contextlib.suppress(NotConnectedError):
            found += _robots(link)
    silent = [
        robot
        for robot in where.local()
        if not any(shown.link.endpoint == robot.endpoint and shown.link.namespace == robot.namespace for shown in found)
    ]
    well = bool(found) and all(robot.status.lifecycle in ("armed", "disarmed") for robot in found)
    if as_json:
        say_json({"robots": [_for_scripts(robot) for robot in found], "silent": silent})
        return 0 if well and not silent else 1
    for robot in silent:
        say(f"{robot.namespace}: NO ANSWER on {robot.endpoint}; its run is process {robot.pid}")
    if not found and not silent:
        noted = last_run.recall()
        last = f"; the last run on this computer ended so: {noted.ended} ({noted.folder})" if noted is not None else ""
        say(f"no robot answers on {', '.join(where.endpoints())}{last}")
        say("  next: `snakesim run triplet --console`, or another of `snakesim scenarios`")
        return 1
    for robot in found:
        lines = [*_in_words(robot), *processes_in_words(robot.processes)]
        if robot.is_impostor:
            lines.append("  IMPOSTOR: more than one host publishes a status under this name; trust none of them")
        for line in [*lines, *_what_to_type(robot.link, robot.status)]:
            say(line)
    return 0 if well and not silent else 1


def _robots(link: Link) -> list[_Robot]:
    """Those on a network."""
    arrivals: Mailbox[Arrival] = Mailbox()
    decoders = {
        keys.STATUS: Decoder(Status),
        keys.PROCESS_ALL: Decoder(Process),
        keys.DESCRIPTION: Decoder(Description),
    }
    found: dict[str, dict[str | None, Status]] = {}
    descriptions: dict[tuple[str, str | None], Description] = {}  # by robot and host
    processes: dict[str, list[Process]] = {}
    prefix = "" if link.namespace is not None else "**/"
    with open_session(link, CONNECT_S) as session:
        for key in decoders:
            session.on_latched_arrival(f"{prefix}{key}", arrivals.put)
        live = set(session.present(f"{prefix}{keys.PROCESS_ALL}"))
        until = time.monotonic() + STATUS_WAIT_S
        while (left := until - time.monotonic()) > 0:
            try:
                arrival = arrivals.get(timeout=left)
                row = next((key for key in (keys.STATUS, keys.DESCRIPTION) if arrival.key.endswith(key)), None)
                message = decoders[row or keys.PROCESS_ALL].decode(arrival.payload, arrival.encoding)
            except Empty:
                break
            except WireError:
                continue
            name = link.namespace or namespace_of(arrival.key)
            match message:
                case Status():
                    found.setdefault(name, {})[message.host] = message
                case Description():
                    descriptions[name, message.host] = message
                case _:
                    if arrival.key in live:
                        processes.setdefault(name, []).append(message)
    robots: list[_Robot] = []
    for name, of_host in sorted(found.items()):
        statuses = list(of_host.values())
        description = descriptions.get((name, statuses[-1].host))
        robots.append(_Robot(replace(link, namespace=name), statuses, processes.get(name, []), description))
    return robots


def _for_scripts(robot: _Robot):
    """One robot, as JSON."""
    return {
        "namespace": robot.link.namespace,
        "endpoint": robot.link.endpoint,
        "emulated": None if robot.description is None else robot.description.emulated,  # null: unknown
        "impostor": robot.is_impostor,
        "processes": robot.processes,
        "status": robot.status,
    }


def processes_in_words(processes: Sequence[Process]) -> list[str]:
    """One line for each process: machine, version, age, and what is set up differently from the host."""
    host = next((entry for entry in processes if entry.name == HOST), None)
    lines: list[str] = []
    for entry in sorted(processes, key=lambda entry: (entry.name != HOST, entry.name, entry.machine, entry.pid)):
        age_s = time.time() - entry.started_unix_s
        since = f"for {timedelta(seconds=round(age_s))}" if age_s >= 0 else "its clock is ahead of this one's"
        lines.append(
            f"  process {entry.name}: {entry.machine}, {entry.pid} of {entry.user}, snakesim {entry.version}, {since}"
        )
        lines += [f"    DIFFERS: {what}" for what in (differences(entry, host) if host is not None else [])]
    return lines


def _in_words(robot: _Robot) -> list[str]:
    link, status = robot.link, robot.status

    def counts(numbers: dict[str, int]) -> str:
        return ", ".join(f"{word} {number}" for word, number in sorted(numbers.items())) or "none"

    lines = [
        f"{link.namespace}: {status.lifecycle} - {status.why}",
        f"  {describe_what_moves(robot.description)}",
        f"  robot {status.robot}, backend {status.backend}, "
        f"{status.clock_mode} at {status.rate_hz:g} Hz, tick {status.tick}"
        f", on {link.endpoint}",
        f"  lease: {status.lease_holder or 'free'} (epoch {status.lease_epoch})",
        f"  alive: {', '.join(status.alive) or 'none'}",
        f"  commands: {status.commands_accepted} accepted, {status.commands_standby} while disarmed, rejected: "
        f"{counts(status.commands_rejected)}; joint targets limited: {counts(status.commands_limited)}",
    ]
    if status.paused_by is not None:
        lines.append(f"  PAUSED by {status.paused_by}; `snakesim sim resume` or `step` go on")
    elif status.speed != 1.0:
        lines.append(f"  speed {status.speed:g} is wanted")
    for joint, share in sorted(status.derated.items()):
        lines.append(f"  derated: {joint} has {100 * share:.0f} % of its torque left")
    if status.isolated:
        lines.append(f"  isolated: {', '.join(status.isolated)}; passive until a clear")
    lines += [f"  real time: {what}" for what in status.realtime_warnings]
    lines += [f"  not checked: {what}" for what in filter(None, [status.unchecked])]
    lines += [f"  injected fault: {what}" for what in status.injected]
    if status.waiting_for:
        lines.append(f"  waiting for: {', '.join(status.waiting_for)}")
    ticks: dict[tuple[str, str, str], list[int]] = {}
    for fault in status.faults:
        ticks.setdefault((fault.what, f" at {fault.joint}" if fault.joint else "", fault.cause), []).append(fault.tick)
    for (what, where, cause), at in ticks.items():
        more = f" and {len(at) - 1} times more" if len(at) > 1 else ""
        lines.append(f"  fault {what}{where} at tick {at[0]}{more}: {cause}")
    if status.faults_left_out:
        lines.append(f"  and {status.faults_left_out} more faults, between the first and the newest of these")
    return lines


def _what_to_type(link: Link, status: Status) -> list[str]:
    """The next commands for a person."""
    where = flags_of(link, status.robot)
    arm = f"`snakesim arm {status.robot} {status.backend}{where}`"
    if status.lifecycle in ("fault", "estop"):
        return [f"  next: `snakesim clear{where}`, then {arm}"]
    if status.isolated and status.lifecycle == "disarmed":
        back = f"`snakesim clear{where}`, to end the isolation of {', '.join(status.isolated)}"
        return [f"  next: {back}", *([f"  or, without: {arm}"] if status.ready_to_arm else [])]
    if status.lifecycle == "armed":
        return [f"  next: `snakesim console{where}` to watch, `snakesim disarm{where}` or `snakesim estop` to stop it"]
    if status.ready_to_arm:
        return [f"  next: {arm}"]
    missing = ", ".join(f"`snakesim service {name} SCENARIO{where}`" for name in status.waiting_for)
    return [f"  next: {missing or '`snakesim status` again: what prevents arming is named above'}"]
