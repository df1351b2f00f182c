"""`snakesim status`: the state of running robots."""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from queue import Empty

from snakesim_hal.errors import NotConnectedError, WireError
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.process_entries import HOST, differences
from snakesim_hal.network.session import Arrival, Link, open_session
from snakesim_hal.terminal import say, say_json
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import Process, Status
from snakesim_operator.results import last_run
from snakesim_operator.tools.targets import CONNECT_S, RobotSelection, flags_of, namespace_of

STATUS_WAIT_S = 1.0
Robot = tuple[Link, list[Status], list[Process]]  # the newest status of each of its hosts, and its live processes


def show_status(where: RobotSelection, *, as_json: bool = False) -> int:
    """Print the state of every reachable robot. Returns 0 without faults, 1 otherwise."""
    found: list[Robot] = []
    for link in where.networks():
        with contextlib.suppress(NotConnectedError):
            found += _robots(link)
    silent = [
        robot
        for robot in where.local()
        if not any(link.endpoint == robot.endpoint and link.namespace == robot.namespace for link, *_ in found)
    ]
    well = bool(found) and all(statuses[-1].lifecycle in ("armed", "disarmed") for _, statuses, _ in found)
    if as_json:
        say_json({"robots": [_for_scripts(*robot) for robot in found], "silent": silent})
        return 0 if well and not silent else 1
    for robot in silent:
        say(f"{robot.namespace}: NO ANSWER on {robot.endpoint}; its run is process {robot.pid}")
    if not found and not silent:
        noted = last_run.recall()
        last = f"; the last run on this computer ended so: {noted.ended} ({noted.folder})" if noted is not None else ""
        say(f"no robot answers on {', '.join(where.endpoints())}{last}")
        say("  next: `snakesim run triplet --console`, or another of `snakesim scenarios`")
        return 1
    for link, statuses, processes in found:
        lines = [*_in_words(link, statuses[-1]), *processes_in_words(processes)]
        if len({status.host for status in statuses}) > 1:
            lines.append("  IMPOSTOR: more than one host publishes a status under this name; trust none of them")
        for line in [*lines, *_what_to_type(link, statuses[-1])]:
            say(line)
    return 0 if well and not silent else 1


def _robots(link: Link) -> list[Robot]:
    """Those on a network."""
    arrivals: Mailbox[Arrival] = Mailbox()
    decoders = {keys.STATUS: Decoder(Status), keys.PROCESS_ALL: Decoder(Process)}
    found: dict[str, dict[str | None, Status]] = {}
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
                at = keys.STATUS if arrival.key.endswith(keys.STATUS) else keys.PROCESS_ALL
                message = decoders[at].decode(arrival.payload, arrival.encoding)
            except Empty:
                break
            except WireError:
                continue
            name = link.namespace or namespace_of(arrival.key)
            if isinstance(message, Status):
                found.setdefault(name, {})[message.host] = message
            elif arrival.key in live:
                processes.setdefault(name, []).append(message)
    return [
        (replace(link, namespace=name), list(of_host.values()), processes.get(name, []))
        for name, of_host in sorted(found.items())
    ]


def _for_scripts(link: Link, statuses: list[Status], processes: list[Process]):
    """One robot, as JSON."""
    return {
        "namespace": link.namespace,
        "endpoint": link.endpoint,
        "impostor": len({status.host for status in statuses}) > 1,  # more than one host has this name
        "processes": processes,
        "status": statuses[-1],
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


def _in_words(link: Link, status: Status) -> list[str]:
    def counts(numbers: dict[str, int]) -> str:
        return ", ".join(f"{word} {number}" for word, number in sorted(numbers.items())) or "none"

    lines = [
        f"{link.namespace}: {status.lifecycle} - {status.why}",
        f"  robot {status.robot}, backend {status.backend}, {status.pace} at {status.rate_hz:g} Hz, tick {status.tick}"
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
