"""Finds every module, checks it, and writes its parameters. It enables nothing: afterwards all motors are off.

All errors of the robot are reported together, so that a person can fix them in one go.
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

ASK_EVERY_S = 0.1  # until a request is repeated
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


# --- finding modules ----------------------------------------------------------------------------------------------


def find_modules(
    buses: Sequence[ModuleBus], limit_s: float, on_frame: Callable[[Frame], None] | None = None
) -> list[ModuleIdentity]:
    """Request the identity of all modules until the expected ones have answered, or the time is over.

    Args:
        buses: the buses, with the nodes that are expected there.
        limit_s: how long to wait at most.
        on_frame: gets all frames that are not answers to the request.

    Returns:
        Every identity that was received, sorted by node. Two modules may have the same id.
    """
    identities: dict[tuple[str, int, int], ModuleIdentity] = {}  # by channel, node and serial number
    missing = {(bus.wire.channel, node) for bus in buses for node in bus.nodes}
    wires = [bus.wire for bus in buses]
    end_s = time.monotonic() + limit_s
    next_request_s = 0.0
    is_complete = False
    now_s = time.monotonic()
    while now_s < end_s:
        if now_s >= next_request_s:
            for wire in wires:
                wire.send(commands.make_command(CommandAction.IDENTIFY))
            next_request_s = now_s + ASK_EVERY_S
        for wire, frame in receive_frames(wires, end_s - now_s):
            identity = _parse_identity(wire.channel, frame)
            if identity is not None:
                identities[identity.channel, identity.node, identity.serial] = identity
                missing.discard((identity.channel, identity.node))
            elif on_frame is not None:
                on_frame(frame)
        if not is_complete and not missing:
            is_complete = True
            end_s = min(end_s, time.monotonic() + LISTEN_ON_S)  # a second module with the same id may still answer
        now_s = time.monotonic()
    return sorted(identities.values(), key=lambda identity: (identity.node, identity.channel, identity.serial))


def _parse_identity(channel: str, frame: Frame) -> ModuleIdentity | None:
    """Return the identity in a frame from a channel; None if the frame is another message."""
    layout = load_layouts()[Opcode.IDENTITY]
    if parse_opcode(frame.id) != Opcode.IDENTITY or len(frame.data) != layout.length:
        return None
    return _make_identity(channel, parse_node(frame.id), layout.decode(frame.data))


def _make_identity(channel: str, node: int, values: Mapping[str, float]) -> ModuleIdentity:
    return ModuleIdentity(
        node=node,
        channel=channel,
        serial=int(values["serial"]),
        firmware=f"{values['firmware_major']:.0f}.{values['firmware_minor']:.0f}",
        protocol=int(values["protocol"]),
        emulated=bool(values["emulated"]),
        stepped=bool(values["stepped"]),
    )


def discovery_errors(
    buses: Sequence[ModuleBus], identities: Sequence[ModuleIdentity], joints: Sequence[str], *, lockstep: bool
) -> list[str]:
    """Compare the modules that answered with the joints of the robot.

    Args:
        buses: the buses, with the nodes that are expected there.
        identities: the modules that answered.
        joints: names of the joints, tail to head.
        lockstep: whether the run is in lockstep, which only stepped emulators support.

    Returns:
        The errors as text; none if the robot is complete.
    """
    errors: list[str] = []
    channel_of_node = {node: bus.wire.channel for bus in buses for node in bus.nodes}
    identities_of_node: dict[int, list[ModuleIdentity]] = defaultdict(list)
    for identity in identities:
        identities_of_node[identity.node].append(identity)
    for node, channel in channel_of_node.items():
        subject = f"{joints[node - 1]} (node {node} on {channel})"
        on_its_channel: list[ModuleIdentity] = []
        on_other_channels: list[ModuleIdentity] = []
        for identity in identities_of_node[node]:
            if identity.channel == channel:
                on_its_channel.append(identity)
            else:
                on_other_channels.append(identity)
        errors += _node_errors(subject, on_its_channel, on_other_channels)
        for identity in on_its_channel:
            errors += _identity_errors(subject, identity, lockstep=lockstep)
    for identity in identities:
        if identity.node not in channel_of_node:
            errors.append(
                f"node {identity.node} with serial {identity.serial:08X} on {identity.channel} is not a joint of this "
                f"robot"
            )
    return errors


def _node_errors(subject: str, here: Sequence[ModuleIdentity], elsewhere: Sequence[ModuleIdentity]) -> list[str]:
    """Return errors of a joint whose module is missing, or is there more than once."""
    if not here:
        hint = ""
        if elsewhere:
            hint = f"; a node {elsewhere[0].node} answers on {elsewhere[0].channel}"
        return [f"{subject} does not answer{hint}"]
    errors: list[str] = []
    if len(here) > 1:
        serials = " and ".join(f"{identity.serial:08X}" for identity in here)
        errors.append(f"{subject} answers {len(here)} times, serials {serials}: give each module its own node id")
    for identity in elsewhere:
        errors.append(
            f"{subject} is duplicated on {identity.channel}, serial {identity.serial:08X}: give that one another node "
            f"id"
        )
    return errors


def _identity_errors(subject: str, identity: ModuleIdentity, *, lockstep: bool) -> list[str]:
    """Return errors of a module whose protocol or clock does not match this driver's."""
    errors: list[str] = []
    if identity.protocol != PROTOCOL_VERSION:
        errors.append(f"{subject} has protocol version {identity.protocol}, this driver {PROTOCOL_VERSION}: update one")
    if lockstep and not identity.stepped:
        errors.append(f"{subject} does not support lockstep: use --clock-mode realtime")
    if identity.stepped and not lockstep:
        errors.append(f"{subject} is an emulator whose time is paused between Syncs: start it without --stepped")
    return errors


# --- parameters ---------------------------------------------------------------------------------------------------


def configure_modules(
    buses: Sequence[ModuleBus],
    new_values: Mapping[int, Mapping[ModuleParameter, float]],
    limit_s: float,
    on_frame: Callable[[Frame], None] | None = None,
) -> dict[int, dict[ModuleParameter, float]]:
    """Write parameters to modules, and read all others.

    Every module gets one request at a time, so that each answer is known to be that of the newest request.

    Args:
        buses: the buses, with the nodes on them.
        new_values: parameters to write, by node.
        limit_s: how long to wait at most.
        on_frame: gets all frames that are no expected answers.

    Returns:
        The present value of every parameter, by node.

    Raises:
        BackendError: a module did not answer in time, or refused a value.
    """
    wire_of = {node: bus.wire for bus in buses for node in bus.nodes}
    wires = [bus.wire for bus in buses]
    answer_layout = load_layouts()[Opcode.PARAMETER_ANSWER]
    due = {node: list(ModuleParameter) for node in new_values}  # not answered yet
    requested_at_s: dict[int, float] = {}  # when the request that a node has not answered was sent
    in_force: dict[int, dict[ModuleParameter, float]] = {node: {} for node in new_values}
    end_s = time.monotonic() + limit_s
    while due:
        now_s = time.monotonic()
        if now_s > end_s:
            raise BackendError(
                f"no answer about parameters from node {', '.join(map(str, due))} within {limit_s:g} s",
                code="drive/silent",
            )
        for node, parameters in due.items():
            if now_s - requested_at_s.get(node, -1.0) > ASK_EVERY_S:
                parameter = parameters[0]
                request = _make_request(node, parameter, new_values[node].get(parameter))
                if wire_of[node].send(request):
                    requested_at_s[node] = now_s
        for _, frame in receive_frames(wires):
            node = parse_node(frame.id)
            is_answer = parse_opcode(frame.id) == Opcode.PARAMETER_ANSWER and len(frame.data) == answer_layout.length
            if not is_answer or not due.get(node):
                if on_frame is not None:
                    on_frame(frame)
                continue
            answer = answer_layout.decode(frame.data)
            parameter = due[node][0]
            if answer["index"] != parameter:
                continue
            due[node].pop(0)
            requested_at_s.pop(node, None)
            _check_result(node, parameter, new_values[node].get(parameter), int(answer["result"]))
            in_force[node][parameter] = answer["value"]
        due = {node: parameters for node, parameters in due.items() if parameters}
    return in_force


def _make_request(node: int, parameter: ModuleParameter, value: float | None) -> Frame:
    """Return a request to write a parameter, or to read it if there is no value."""
    layout = load_layouts()[Opcode.PARAMETER_REQUEST]
    if value is None:
        return layout.encode(node, index=parameter, operation=ParameterOperation.READ, value=0.0)
    return layout.encode(node, index=parameter, operation=ParameterOperation.WRITE, value=value)


def _check_result(node: int, parameter: ModuleParameter, value: float | None, result: int) -> None:
    """Raise BackendError if a module refused a request."""
    if result == ParameterResult.DONE:
        return
    allowed = PARAMETERS[parameter]
    reason = f"result {result}"
    if result < len(ParameterResult):
        reason = ParameterResult(result).name.lower().replace("_", " ")
    raise BackendError(
        f"node {node} refuses parameter {parameter.name.lower()} = {value} {allowed.unit}: "
        f"{reason} (allowed: {allowed.low:g} to {allowed.high:g})",
        code="drive/parameter-refused",
    )
