"""What `snakesim drive scan cia402` does: it lists the CANopen nodes that answer on a bus."""

import argparse
import struct
import time
from collections.abc import Iterable

from snakesim_can_backend.bus.adapter import open_wire, validate_channel
from snakesim_can_backend.bus.bus import Wire, wait
from snakesim_can_backend.cia402.frames import (
    FIRST_NODE,
    LAST_NODE,
    UPLOAD_RESPONSE,
    FunctionCode,
    decode_sdo,
    encode_read,
    split_id,
)
from snakesim_can_backend.cia402.objects import (
    DEVICE_TYPE,
    DS402,
    ERROR_CODE,
    PRODUCT_CODE,
    REVISION,
    SERIAL,
    STATUSWORD,
    SUPPORTED_MODES,
    VENDOR_ID,
    ObjectEntry,
)
from snakesim_can_backend.cia402.state_machine import OperationMode, decode_statusword
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.terminal import align_columns, print_json, print_line

OK, FAILED = 0, 1
RESPONSE_TIMEOUT_S = 0.1  # for all answers to one round of requests
SCANNED_ENTRIES = (
    DEVICE_TYPE,
    VENDOR_ID,
    PRODUCT_CODE,
    REVISION,
    SERIAL,
    SUPPORTED_MODES,
    STATUSWORD,
    ERROR_CODE,
)
COLUMNS = (
    "channel",
    "node",
    "profile",
    "vendor",
    "product",
    "revision",
    "serial",
    "modes",
    "state",
    "error",
)
UNKNOWN = "-"
MODE_LABELS = {
    OperationMode.CYCLIC_POSITION: "CSP",
    OperationMode.CYCLIC_VELOCITY: "CSV",
    OperationMode.CYCLIC_TORQUE: "CST",
}

# Several values of one entry come from several nodes with one id.
Values = dict[ObjectEntry, set[int]]


def scan_channels(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive scan cia402`: list the CANopen nodes that respond on some buses.

    Args:
        arguments: Parsed command line.

    Returns:
        Exit code 0; 1 if no node responds.

    Raises:
        SnakesimError: A channel does not exist, is down, or cannot be opened.
    """
    for channel in arguments.channel:
        validate_channel(channel)
    rows: list[dict[str, str]] = []
    for channel in arguments.channel:
        wire = open_wire(channel, None, arguments.bit_rate)
        try:
            values_by_node = read_nodes(wire)
        finally:
            wire.close()
        rows += [
            make_scan_row(channel, node, values) for node, values in sorted(values_by_node.items())
        ]
    if arguments.json:
        print_json({"drives": rows})
        return OK if rows else FAILED
    if not rows:
        print_line("no node answers")
        return FAILED
    for line in align_columns(COLUMNS, rows):
        print_line(line)
    return OK


def read_nodes(wire: Wire) -> dict[int, Values]:
    """Read identity and state of all nodes on a bus, without writing anything.

    Returns:
        The values that each node has reported, by node id; nodes that do not respond are missing.
    """
    values_by_node: dict[int, Values] = {}
    nodes: Iterable[int] = range(FIRST_NODE, LAST_NODE + 1)
    for entry in SCANNED_ENTRIES:
        for node in nodes:
            wire.send(CanFrame(FunctionCode.SDO_REQUEST | node, encode_read(entry)))
        _receive_values(wire, entry, values_by_node)
        # Only those that have the first entry are asked for the others.
        nodes = list(values_by_node)
    return values_by_node


def make_scan_row(channel: str, node_id: int, values: Values) -> dict[str, str]:
    """Return the row of the scan for one node, by the names in `COLUMNS`.

    Args:
        channel: Bus of the node.
        node_id: Node id.
        values: Values of each entry that responses with this id had. Several values of one entry come from several
            nodes with the same id.
    """
    row: dict[str, str] = {}
    row |= dict.fromkeys(COLUMNS, UNKNOWN)
    row |= {"channel": channel, "node": str(node_id)}
    for number in values.get(DEVICE_TYPE, ()):
        row["profile"] = str(number & 0xFFFF)
    for entry, column in ((VENDOR_ID, "vendor"), (PRODUCT_CODE, "product"), (SERIAL, "serial")):
        if entry in values:
            row[column] = " and ".join(f"{number:08X}" for number in sorted(values[entry]))
    for number in values.get(REVISION, ()):
        row["revision"] = f"{number >> 16}.{number & 0xFFFF}"
    if row["profile"] != str(DS402):
        return row
    for number in values.get(SUPPORTED_MODES, ()):
        names = [label for mode, label in MODE_LABELS.items() if number >> (mode - 1) & 1]
        row["modes"] = " ".join(names) or "none"
    for number in values.get(STATUSWORD, ()):
        row["state"] = decode_statusword(number).value
    for number in values.get(ERROR_CODE, ()):
        row["error"] = f"0x{number:04X}" if number else "none"
    return row


def _receive_values(wire: Wire, entry: ObjectEntry, values_by_node: dict[int, Values]) -> None:
    """Receive the responses to requests for an entry until a timeout, and store their values by node."""
    deadline_s = time.monotonic() + RESPONSE_TIMEOUT_S
    while True:
        remaining_s = deadline_s - time.monotonic()
        if remaining_s <= 0 or not wait([wire], remaining_s):
            return
        for frame in wire.receive():
            function, node = split_id(frame)
            if function != FunctionCode.SDO_RESPONSE:
                continue
            try:
                response = decode_sdo(frame.data)
                if response.kind == UPLOAD_RESPONSE and (response.index, response.sub) == (
                    entry.index,
                    entry.sub,
                ):
                    values_by_node.setdefault(node, {}).setdefault(entry, set()).add(
                        entry.decode(response.data)
                    )
            except (ValueError, struct.error):
                continue
