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
    CanFrame,
    CommandAction,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    ParameterResult,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.errors import BackendError

REQUEST_PERIOD_S = 0.1  # until a request is repeated
DUPLICATE_WAIT_S = 0.06  # after the last module is found: a second one with its id may answer later


@dataclass(frozen=True)
class ModuleIdentity:
    """A module's answer to `identify`."""

    node_id: int
    channel: str
    serial: int
    firmware: str
    protocol: int
    is_emulated: bool
    is_stepped: bool


@dataclass(frozen=True)
class ModuleBus:
    """One wire, and the nodes that belong on it."""

    wire: Wire
    node_ids: range


# --- finding modules ----------------------------------------------------------------------------------------------


def find_modules(
    buses: Sequence[ModuleBus], timeout_s: float, on_frame: Callable[[CanFrame], None] | None = None
) -> list[ModuleIdentity]:
    """Request the identity of all modules until the expected ones have responded, or until a timeout.

    Args:
        buses: The buses, with the nodes that are expected there.
        timeout_s: Maximum duration to wait.
        on_frame: Function that is called with all frames that are not responses to the request; None to ignore them.

    Returns:
        Every identity that was received, sorted by node id. Two modules may have the same node id.
    """
    # By channel, node id and serial number.
    identities: dict[tuple[str, int, int], ModuleIdentity] = {}
    # Channel and node id of each expected module that has not responded.
    missing = {(bus.wire.channel, node_id) for bus in buses for node_id in bus.node_ids}
    wires = [bus.wire for bus in buses]
    deadline_s = time.monotonic() + timeout_s
    next_request_s = 0.0  # the first request is sent at once
    has_shortened_deadline = False
    now_s = time.monotonic()
    while now_s < deadline_s:
        if now_s >= next_request_s:
            for wire in wires:
                wire.send(commands.make_command(CommandAction.IDENTIFY))
            next_request_s = now_s + REQUEST_PERIOD_S
        for wire, frame in receive_frames(wires, deadline_s - now_s):
            identity = _parse_identity(wire.channel, frame)
            if identity is not None:
                identities[identity.channel, identity.node_id, identity.serial] = identity
                missing.discard((identity.channel, identity.node_id))
            elif on_frame is not None:
                on_frame(frame)
        if not missing and not has_shortened_deadline:
            has_shortened_deadline = True
            # All have responded. Wait a little longer: a second module with the same node id may still respond.
            deadline_s = min(deadline_s, time.monotonic() + DUPLICATE_WAIT_S)
        now_s = time.monotonic()
    return sorted(
        identities.values(),
        key=lambda identity: (identity.node_id, identity.channel, identity.serial),
    )


def _parse_identity(channel: str, frame: CanFrame) -> ModuleIdentity | None:
    """Return the identity in a frame from a channel; None if the frame is another message."""
    layout = load_layouts()[Opcode.IDENTITY]
    if parse_opcode(frame.id) != Opcode.IDENTITY or len(frame.data) != layout.length:
        return None
    return _make_identity(channel, parse_node(frame.id), layout.decode(frame.data))


def _make_identity(channel: str, node_id: int, values: Mapping[str, float]) -> ModuleIdentity:
    return ModuleIdentity(
        node_id=node_id,
        channel=channel,
        serial=int(values["serial"]),
        firmware=f"{values['firmware_major']:.0f}.{values['firmware_minor']:.0f}",
        protocol=int(values["protocol"]),
        is_emulated=bool(values["emulated"]),
        is_stepped=bool(values["stepped"]),
    )


def find_discovery_errors(
    buses: Sequence[ModuleBus],
    identities: Sequence[ModuleIdentity],
    joint_names: Sequence[str],
    *,
    is_lockstep: bool,
) -> list[str]:
    """Compare the modules that responded with the joints of the robot.

    Args:
        buses: The buses, with the nodes that are expected there.
        identities: Identities of the modules that responded.
        joint_names: Names of the joints, from tail to head.
        is_lockstep: Whether the run is in lockstep, which only stepped emulators support.

    Returns:
        The errors as text; empty if the robot is complete.
    """
    errors: list[str] = []
    channel_by_node = {node: bus.wire.channel for bus in buses for node in bus.node_ids}
    identities_by_node: dict[int, list[ModuleIdentity]] = defaultdict(list)
    for identity in identities:
        identities_by_node[identity.node_id].append(identity)
    for node, channel in channel_by_node.items():
        subject = f"{joint_names[node - 1]} (node {node} on {channel})"
        identities_on_channel: list[ModuleIdentity] = []
        identities_on_other_channels: list[ModuleIdentity] = []
        for identity in identities_by_node[node]:
            if identity.channel == channel:
                identities_on_channel.append(identity)
            else:
                identities_on_other_channels.append(identity)
        errors += _find_node_errors(subject, identities_on_channel, identities_on_other_channels)
        for identity in identities_on_channel:
            errors += _find_identity_errors(subject, identity, is_lockstep=is_lockstep)
    for identity in identities:
        if identity.node_id not in channel_by_node:
            errors.append(
                f"node {identity.node_id} with serial {identity.serial:08X} on {identity.channel} "
                f"is not a joint of this robot"
            )
    return errors


def _find_node_errors(
    subject: str,
    identities_on_channel: Sequence[ModuleIdentity],
    identities_on_other_channels: Sequence[ModuleIdentity],
) -> list[str]:
    """Return errors of a joint whose module is missing, or is there more than once."""
    if not identities_on_channel:
        hint = ""
        if identities_on_other_channels:
            hint = (
                f"; a node {identities_on_other_channels[0].node_id} answers on "
                f"{identities_on_other_channels[0].channel}"
            )
        return [f"{subject} does not answer{hint}"]
    errors: list[str] = []
    if len(identities_on_channel) > 1:
        serials = " and ".join(f"{identity.serial:08X}" for identity in identities_on_channel)
        errors.append(
            f"{subject} answers {len(identities_on_channel)} times, serials {serials}: give each module its own node id"
        )
    for identity in identities_on_other_channels:
        errors.append(
            f"{subject} is duplicated on {identity.channel}, serial {identity.serial:08X}: give that one another node "
            f"id"
        )
    return errors


def _find_identity_errors(
    subject: str, identity: ModuleIdentity, *, is_lockstep: bool
) -> list[str]:
    """Return errors of a module whose protocol or clock does not match this driver's."""
    errors: list[str] = []
    if identity.protocol != PROTOCOL_VERSION:
        errors.append(
            f"{subject} has protocol version {identity.protocol}, this driver {PROTOCOL_VERSION}: update one"
        )
    if is_lockstep and not identity.is_stepped:
        errors.append(f"{subject} does not support lockstep: use --clock-mode realtime")
    if identity.is_stepped and not is_lockstep:
        errors.append(
            f"{subject} is an emulator whose time is paused between Syncs: start it without --stepped"
        )
    return errors


# --- parameters ---------------------------------------------------------------------------------------------------


def configure_modules(
    buses: Sequence[ModuleBus],
    new_values: Mapping[int, Mapping[ModuleParameter, float]],
    timeout_s: float,
    on_frame: Callable[[CanFrame], None] | None = None,
) -> dict[int, dict[ModuleParameter, float]]:
    """Write parameters to modules, and read all others.

    Every module gets one request at a time, so that each answer is known to be that of the newest request.

    Args:
        buses: The buses, with the nodes on them.
        new_values: Parameters to write, by node.
        timeout_s: Maximum duration to wait.
        on_frame: Function that is called with all frames that are not expected responses; None to ignore them.

    Returns:
        The current value of every parameter, by node.

    Raises:
        BackendError: A module did not respond in time, or refused a value.
    """
    wire_by_node = {node: bus.wire for bus in buses for node in bus.node_ids}
    wires = [bus.wire for bus in buses]
    response_layout = load_layouts()[Opcode.PARAMETER_ANSWER]
    # Not answered yet.
    remaining_parameters_by_node = {node: list(ModuleParameter) for node in new_values}
    # When the request that a node has not answered was sent.
    request_time_by_node_s: dict[int, float] = {}
    current_values: dict[int, dict[ModuleParameter, float]] = {node: {} for node in new_values}
    deadline_s = time.monotonic() + timeout_s
    while remaining_parameters_by_node:
        now_s = time.monotonic()
        if now_s > deadline_s:
            raise BackendError(
                f"no answer about parameters from node {', '.join(map(str, remaining_parameters_by_node))} within "
                f"{timeout_s:g} s",
                code="drive/silent",
            )
        for node, parameters in remaining_parameters_by_node.items():
            if now_s - request_time_by_node_s.get(node, -1.0) > REQUEST_PERIOD_S:
                parameter = parameters[0]
                request = _make_request(node, parameter, new_values[node].get(parameter))
                if wire_by_node[node].send(request):
                    request_time_by_node_s[node] = now_s
        for _, frame in receive_frames(wires):
            node = parse_node(frame.id)
            is_response = (
                parse_opcode(frame.id) == Opcode.PARAMETER_ANSWER
                and len(frame.data) == response_layout.length
            )
            if not is_response or not remaining_parameters_by_node.get(node):
                if on_frame is not None:
                    on_frame(frame)
                continue
            response = response_layout.decode(frame.data)
            parameter = remaining_parameters_by_node[node][0]
            if response["index"] != parameter:
                continue
            remaining_parameters_by_node[node].pop(0)
            request_time_by_node_s.pop(node, None)
            _raise_if_refused(
                node, parameter, new_values[node].get(parameter), int(response["result"])
            )
            current_values[node][parameter] = response["value"]
        remaining_parameters_by_node = {
            node: parameters
            for node, parameters in remaining_parameters_by_node.items()
            if parameters
        }
    return current_values


def _make_request(node_id: int, parameter: ModuleParameter, value: float | None) -> CanFrame:
    """Return a request to write a parameter, or to read it if there is no value."""
    layout = load_layouts()[Opcode.PARAMETER_REQUEST]
    if value is None:
        return layout.encode(node_id, index=parameter, operation=ParameterOperation.READ, value=0.0)
    return layout.encode(node_id, index=parameter, operation=ParameterOperation.WRITE, value=value)


def _raise_if_refused(
    node_id: int, parameter: ModuleParameter, value: float | None, result: int
) -> None:
    """Raise BackendError if a module refused a request."""
    if result == ParameterResult.DONE:
        return
    allowed = PARAMETERS[parameter]
    reason = f"result {result}"
    if result < len(ParameterResult):
        reason = ParameterResult(result).name.lower().replace("_", " ")
    raise BackendError(
        f"node {node_id} refuses parameter {parameter.name.lower()} = {value} {allowed.unit}: "
        f"{reason} (allowed: {allowed.low:g} to {allowed.high:g})",
        code="drive/parameter-refused",
    )
