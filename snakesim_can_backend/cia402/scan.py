"""What `snakesim drive scan cia402` does: it lists the CANopen nodes that answer on a bus."""

import argparse
import struct
import time
from collections.abc import Iterable

from snakesim_can_backend.bus.adapter import check_channel, open_wire
from snakesim_can_backend.bus.bus import Wire, wait
from snakesim_can_backend.cia402.frames import (
    FIRST_NODE,
    LAST_NODE,
    UPLOAD_ANSWER,
    Function,
    decode_sdo,
    encode_read,
    split_id,
)
from snakesim_can_backend.cia402.objects import (
    DEVICE_TYPE,
    DS402,
    ERROR_CODE,
    PRODUCT,
    REVISION,
    SERIAL,
    STATUSWORD,
    SUPPORTED_MODES,
    VENDOR,
    Entry,
)
from snakesim_can_backend.cia402.state_machine import OperationMode, decode_statusword
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.base.terminal import align_columns, print_json, print_line

OK, FAILED = 0, 1
ANSWER_S = 0.1  # for all answers to one round of requests
READ = (DEVICE_TYPE, VENDOR, PRODUCT, REVISION, SERIAL, SUPPORTED_MODES, STATUSWORD, ERROR_CODE)
COLUMNS = ("channel", "node", "profile", "vendor", "product", "revision", "serial", "modes", "state", "error")
UNKNOWN = "-"
MODE_LABELS = {
    OperationMode.CYCLIC_POSITION: "CSP",
    OperationMode.CYCLIC_VELOCITY: "CSV",
    OperationMode.CYCLIC_TORQUE: "CST",
}

Values = dict[Entry, set[int]]  # several values of one entry come from several nodes with one id


def scan_channels(arguments: argparse.Namespace) -> int:
    """List the nodes that answer on some buses. Returns 1 if none answers; raises SnakesimError."""
    for channel in arguments.channel:
        check_channel(channel)
    rows: list[dict[str, str]] = []
    for channel in arguments.channel:
        wire = open_wire(channel, None, arguments.bit_rate)
        try:
            found = read_nodes(wire)
        finally:
            wire.close()
        rows += [describe_node(channel, node, values) for node, values in sorted(found.items())]
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
    """Return what every node on a bus reports of itself. Nothing is written."""
    found: dict[int, Values] = {}
    nodes: Iterable[int] = range(FIRST_NODE, LAST_NODE + 1)
    for entry in READ:
        for node in nodes:
            wire.send(Frame(Function.SDO_REQUEST | node, encode_read(entry)))
        _collect(wire, entry, found)
        nodes = list(found)  # only those that have the first entry are asked for the others
    return found


def describe_node(channel: str, node: int, values: Values) -> dict[str, str]:
    """Return the row of a node, by `COLUMNS`. Several serial numbers are several nodes with one id."""
    row: dict[str, str] = {}
    row |= dict.fromkeys(COLUMNS, UNKNOWN)
    row |= {"channel": channel, "node": str(node)}
    for number in values.get(DEVICE_TYPE, ()):
        row["profile"] = str(number & 0xFFFF)
    for entry, column in ((VENDOR, "vendor"), (PRODUCT, "product"), (SERIAL, "serial")):
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


def _collect(wire: Wire, entry: Entry, found: dict[int, Values]) -> None:
    """Store the answers to requests for an entry."""
    end_s = time.monotonic() + ANSWER_S
    while True:
        left_s = end_s - time.monotonic()
        if left_s <= 0 or not wait([wire], left_s):
            return
        for frame in wire.receive():
            function, node = split_id(frame)
            if function != Function.SDO_ANSWER:
                continue
            try:
                answer = decode_sdo(frame.data)
                if answer.kind == UPLOAD_ANSWER and (answer.index, answer.sub) == (entry.index, entry.sub):
                    found.setdefault(node, {}).setdefault(entry, set()).add(entry.decode(answer.data))
            except (ValueError, struct.error):
                continue
