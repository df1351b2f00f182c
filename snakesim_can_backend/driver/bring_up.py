"""Find every module, check it, and write its parameters. Enables nothing: when it is done all motors are off.

All errors are reported at once, so that a person can fix them in one go.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from snakesim_can_backend.bus.bus import Wire, receive_frames
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    PARAMETERS,
    PROTOCOL_VERSION,
    CommandAction,
    Frame,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    ParameterResult,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.errors import BackendError

ASK_EVERY_S = 0.1
LISTEN_ON_S = 0.06  # after the last module is found: a second one with its id may answer later


@dataclass(frozen=True)
class ModuleIdentity:
    """A module's answer to `identify`."""

    node: int
    channel: str
    serial: int
    firmware: str
    protocol: int
    emulated: bool
    stepped: bool


@dataclass(frozen=True)
class ModuleBus:
    """One wire, and the nodes that belong on it."""

    wire: Wire
    nodes: range


def find_modules(
    buses: Sequence[ModuleBus], limit_s: float, on_frame: Callable[[Frame], None] | None = None
) -> list[ModuleIdentity]:
    """Send `identify` until all expected nodes have answered, or the timeout. Two modules may share an id."""
    read = load_layouts()[Opcode.IDENTITY].decode
    found: dict[tuple[str, int, int], ModuleIdentity] = {}
    wanted = {(bus.wire.channel, node) for bus in buses for node in bus.nodes}
    wires = [bus.wire for bus in buses]
    end = time.monotonic() + limit_s
    ask_at = 0.0
    complete = False
    while (now := time.monotonic()) < end:
        if now >= ask_at:
            for wire in wires:
                wire.send(commands.make_command(CommandAction.IDENTIFY))
            ask_at = now + ASK_EVERY_S
        for wire, frame in receive_frames(wires, end - now):
            if parse_opcode(frame.id) == Opcode.IDENTITY and len(frame.data) == load_layouts()[Opcode.IDENTITY].length:
                identity = _identity(wire.channel, parse_node(frame.id), read(frame.data))
                found[identity.channel, identity.node, identity.serial] = identity
            elif on_frame is not None:
                on_frame(frame)
        if not complete and wanted <= {(i.channel, i.node) for i in found.values()}:
            complete, end = True, min(end, time.monotonic() + LISTEN_ON_S)
    return sorted(found.values(), key=lambda i: (i.node, i.channel, i.serial))


def discovery_errors(
    buses: Sequence[ModuleBus], found: Sequence[ModuleIdentity], joints: Sequence[str], *, lockstep: bool
) -> list[str]:
    """Errors of the discovered nodes; empty when the robot is complete."""
    wrong: list[str] = []
    home = {node: bus.wire.channel for bus in buses for node in bus.nodes}
    by_node: dict[int, list[ModuleIdentity]] = defaultdict(list)
    for identity in found:
        by_node[identity.node].append(identity)
    for node, channel in home.items():
        who = f"{joints[node - 1]} (node {node} on {channel})"
        here = [i for i in by_node[node] if i.channel == channel]
        if not here:
            elsewhere = f"; a node {node} answers on {by_node[node][0].channel}" if by_node[node] else ""
            wrong.append(f"{who} does not answer{elsewhere}")
        if len(here) > 1:
            serials = " and ".join(f"{i.serial:08X}" for i in here)
            wrong.append(f"{who} answers {len(here)} times, serials {serials}: give each module its own node id")
        strays = [i for i in by_node[node] if here and i.channel != channel]
        wrong += [
            f"{who} is duplicated on {i.channel}, serial {i.serial:08X}: give that one another node id" for i in strays
        ]
        for identity in here:
            if identity.protocol != PROTOCOL_VERSION:
                wrong.append(
                    f"{who} has protocol version {identity.protocol}, this driver {PROTOCOL_VERSION}: update one"
                )
            if lockstep and not identity.stepped:
                wrong.append(f"{who} does not support lockstep: use --clock-mode realtime")
            if identity.stepped and not lockstep:
                wrong.append(f"{who} is an emulator whose time stands still between Syncs: start it without --stepped")
    wrong += [
        f"node {i.node} with serial {i.serial:08X} on {i.channel} is not a joint of this robot"
        for i in found
        if i.node not in home
    ]
    return wrong


def configure_modules(
    buses: Sequence[ModuleBus],
    wanted: Mapping[int, Mapping[ModuleParameter, float]],
    limit_s: float,
    on_frame: Callable[[Frame], None] | None = None,
) -> dict[int, dict[ModuleParameter, float]]:
    """Write each node's parameters, read the others, and return the present values. Raises BackendError."""
    wire_of = {node: bus.wire for bus in buses for node in bus.nodes}
    due = {node: list(ModuleParameter) for node in wanted}
    in_force: dict[int, dict[ModuleParameter, float]] = {node: {} for node in wanted}
    asked_at: dict[int, float] = {}
    wires = [bus.wire for bus in buses]
    end = time.monotonic() + limit_s
    request, answers = load_layouts()[Opcode.PARAMETER_REQUEST], load_layouts()[Opcode.PARAMETER_ANSWER]
    read, answer_length = answers.decode, answers.length
    while due:
        now = time.monotonic()
        if now > end:
            raise BackendError(f"no answer about parameters from node {', '.join(map(str, due))} within {limit_s:g} s")
        for node, left in due.items():
            if now - asked_at.get(node, -1.0) > ASK_EVERY_S:
                value = wanted[node].get(left[0])
                operation = ParameterOperation.READ if value is None else ParameterOperation.WRITE
                frame = request.encode(node, index=left[0], operation=operation, value=value or 0.0)
                if wire_of[node].send(frame):
                    asked_at[node] = now
        for _, frame in receive_frames(wires):
            node = parse_node(frame.id)
            known = parse_opcode(frame.id) == Opcode.PARAMETER_ANSWER and len(frame.data) == answer_length
            if not known or not due.get(node):
                if on_frame is not None:
                    on_frame(frame)
                continue
            answer = read(frame.data)
            if answer["index"] != due[node][0]:
                continue
            parameter = due[node].pop(0)
            asked_at.pop(node, None)
            _check(node, parameter, wanted[node].get(parameter), int(answer["result"]))
            in_force[node][parameter] = answer["value"]
        due = {node: left for node, left in due.items() if left}
    return in_force


def _check(node: int, parameter: ModuleParameter, asked: float | None, result: int) -> None:
    if result == ParameterResult.DONE:
        return
    allowed = PARAMETERS[parameter]
    why = (
        ParameterResult(result).name.lower().replace("_", " ") if result < len(ParameterResult) else f"result {result}"
    )
    raise BackendError(
        f"node {node} refuses parameter {parameter.name.lower()} = {asked} {allowed.unit}: "
        f"{why} (allowed: {allowed.low:g} to {allowed.high:g})"
    )


def _identity(channel: str, node: int, values: Mapping[str, float]) -> ModuleIdentity:
    return ModuleIdentity(
        node=node,
        channel=channel,
        serial=int(values["serial"]),
        firmware=f"{values['firmware_major']:.0f}.{values['firmware_minor']:.0f}",
        protocol=int(values["protocol"]),
        emulated=bool(values["emulated"]),
        stepped=bool(values["stepped"]),
    )
