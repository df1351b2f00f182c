"""Looking at a running robot from another terminal: `snakesim echo`, `snakesim status`, `snakesim router`."""

import itertools
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty

import msgspec

from snakesim_hal import keys
from snakesim_hal.codec import Decoder
from snakesim_hal.errors import ConfigError, NotConnectedError, WireError
from snakesim_hal.files import SHIPPED
from snakesim_hal.mailbox import Mailbox
from snakesim_hal.messages import Message, Status
from snakesim_hal.session import DEFAULT_ENDPOINT, Arrival, Link, open_session
from snakesim_operator import lastrun

STATUS_WAIT_S = 1.0
RATE_PERIOD_S = 1.0
CONNECT_S = 1.0


def echo(key: str, link: Link, *, rate_only: bool, count: int | None, say: Callable[[str], None] = print) -> int:
    """Print what arrives on a key, from every robot or from the one whose namespace is given."""
    relative = key.strip("/")
    message = keys.message_at(relative)
    if message is None:
        known = "\n  ".join(f"{row.key:<24}{row.about}" for row in keys.SPACE if row.kind in ("stream", "latched"))
        raise ConfigError(f"there is no key {key!r}; what can be echoed:\n  {known}")
    everywhere = relative if link.namespace is not None else f"**/{relative}"
    arrivals: Mailbox[Arrival] = Mailbox()
    with open_session(link, CONNECT_S) as session:
        if relative in (keys.STATUS, keys.DESCRIPTION):
            session.on_latched_arrival(everywhere, arrivals.put)
        else:
            session.on_arrival(everywhere, arrivals.put)
        if rate_only:
            _print_rates(arrivals, count, say)
        else:
            _print_messages(arrivals, message, count, say)
    return 0


def _print_messages(
    arrivals: Mailbox[Arrival], message: type[Message], count: int | None, say: Callable[[str], None]
) -> None:
    decoder, printed = Decoder(message), 0
    while count is None or printed < count:
        arrival = arrivals.get()
        try:
            text = msgspec.json.encode(decoder.decode(arrival.payload, arrival.encoding)).decode()
        except WireError as error:
            text = f"cannot be read: {error}"
        say(f"{arrival.key} {text}")
        printed += 1


def _print_rates(arrivals: Mailbox[Arrival], count: int | None, say: Callable[[str], None]) -> None:
    printed = 0
    while count is None or printed < count:
        stamps: dict[str, list[int]] = {}
        until = time.monotonic() + RATE_PERIOD_S
        while (left := until - time.monotonic()) > 0:
            try:
                arrival = arrivals.get(timeout=left)
            except Empty:
                break
            stamps.setdefault(arrival.key, []).append(arrival.monotonic_ns)
        for key, times in sorted(stamps.items()):
            gaps_ms = [(b - a) / 1e6 for a, b in itertools.pairwise(times)]
            if gaps_ms:
                spread = statistics.pstdev(gaps_ms)
                say(
                    f"{key}: {1000 / statistics.fmean(gaps_ms):.1f} Hz  gap {min(gaps_ms):.2f} to {max(gaps_ms):.2f} ms"
                    f"  deviation {spread:.2f} ms  over {len(times)}"
                )
        if not stamps:
            say("nothing arrives")
        printed += 1


def show_status(link: Link, say: Callable[[str], None] = print) -> int:
    """Print the state of every robot on the network. Returns 0 when all are well, 1 otherwise."""
    try:
        found = _statuses(link)
    except NotConnectedError as error:
        found = {}
        say(str(error))
    if not found:
        noted = lastrun.recall()
        if noted is not None:
            say(f"no robot answers; the last run on this computer ended so: {noted[1]} ({noted[0]})")
        else:
            say("no robot answers")
        return 1
    for namespace, status in sorted(found.items()):
        say(_in_words(namespace, status))
        for line in _what_to_type(namespace, status, link):
            say(line)
    return 0 if all(status.lifecycle in ("armed", "disarmed") for status in found.values()) else 1


def _statuses(link: Link) -> dict[str, Status]:
    """The newest status of each robot, by namespace."""
    arrivals: Mailbox[Arrival] = Mailbox()
    decoder = Decoder(Status)
    found: dict[str, Status] = {}
    with open_session(link, CONNECT_S) as session:
        key = keys.STATUS if link.namespace is not None else f"**/{keys.STATUS}"
        session.on_latched_arrival(key, arrivals.put)
        until = time.monotonic() + STATUS_WAIT_S
        while (left := until - time.monotonic()) > 0:
            try:
                arrival = arrivals.get(timeout=left)
                status = decoder.decode(arrival.payload, arrival.encoding)
            except Empty:
                break
            except WireError:
                continue
            split = keys.split_namespace(arrival.key)
            found[split[0] if split else link.namespace or status.robot] = status
            if link.namespace is not None:
                break
    return found


def _in_words(namespace: str, status: Status) -> str:
    def counts(numbers: dict[str, int]) -> str:
        return ", ".join(f"{word} {number}" for word, number in sorted(numbers.items())) or "none"

    lines = [
        f"{namespace}: {status.lifecycle} - {status.why}",
        f"  robot {status.robot}, backend {status.backend}, {status.pace} at {status.rate_hz:g} Hz, tick {status.tick}",
        f"  lease: {status.lease_holder or 'free'} (epoch {status.lease_epoch})",
        f"  alive: {', '.join(status.alive) or 'nobody'}",
        f"  commands: {status.commands_accepted} accepted, {status.commands_standby} in standby, rejected: "
        f"{counts(status.commands_rejected)}; joint targets limited: {counts(status.commands_limited)}",
    ]
    for joint, share in sorted(status.derated.items()):
        lines.append(f"  derated: {joint} has {100 * share:.0f} % of its torque left")
    if status.isolated:
        lines.append(f"  isolated: {', '.join(status.isolated)}; passive until a clear")
    for what in status.hygiene:
        lines.append(f"  real time: {what}")
    for what in status.injected:
        lines.append(f"  fault on request: {what}")
    if status.waiting_for:
        lines.append(f"  waiting for: {', '.join(status.waiting_for)}")
    for fault in status.faults:
        where = f" at {fault.joint}" if fault.joint else ""
        lines.append(f"  fault {fault.what}{where} at tick {fault.tick}: {fault.cause}")
    return "\n".join(lines)


def _what_to_type(namespace: str, status: Status, link: Link) -> list[str]:
    """What a person does next; nothing while the robot moves, or cannot be armed yet."""
    where = f" --endpoint {link.endpoint}" if link.endpoint != DEFAULT_ENDPOINT else ""
    where += f" --namespace {namespace}" if namespace != status.robot else ""
    arm = f"`snakesim arm {status.robot} {status.backend}{where}`"
    if status.lifecycle in ("fault", "estop"):
        return [f"  next: `snakesim clear{where}`, then {arm}"]
    if status.isolated and status.lifecycle == "disarmed":
        back = f"`snakesim clear{where}`, to take back {', '.join(status.isolated)}"
        return [f"  next: {back}", *([f"  or, without: {arm}"] if status.ready_to_arm else [])]
    return [f"  next: {arm}"] if status.ready_to_arm else []


def run_router(config: Path | None) -> int:
    """Run a router until Ctrl-C."""
    from snakesim_hal.session import open_router

    path = config or SHIPPED / "router.json5"
    with open_router(path):
        print(f"router running from {path}; Ctrl-C ends it", flush=True)
        threading.Event().wait()
    return 0
