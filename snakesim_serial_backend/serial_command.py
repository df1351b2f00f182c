"""What `snakesim drive scan dynamixel` does: it lists the servos that answer on a port."""

import argparse
import struct
from collections.abc import Iterator, Sequence

from snakesim_hal.base.errors import BackendError
from snakesim_hal.base.terminal import align_columns, print_json, print_line
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.packets import Packet
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.wire import SerialWire, is_emulated

OK = 0  # exit codes
FAILED = 1
GAP_S = 0.2  # silence that ends an answer: longer than any servo's return delay
COLUMNS = (
    *("port", "baud", "id", "model", "firmware", "mode", "offset", "angle"),
    *("current limit", "voltage", "heat", "errors"),
)


def scan_ports(arguments: argparse.Namespace) -> int:
    """List the servos that answer on some ports. Returns 1 if none answers."""
    rows: list[dict[str, str]] = []
    failures: list[str] = []
    for name in arguments.channel:
        for baud in _choose_bauds(name, arguments.baud or list(at.RATE)):
            try:
                wire = SerialWire(name, baud)
            except BackendError as error:  # an adapter that does not support this rate, or a port in use
                failures.append(str(error))
                continue
            try:
                rows += scan(wire)
            finally:
                wire.close()
    if arguments.json:
        print_json({"drives": rows, "failures": list(dict.fromkeys(failures))})
        return OK if rows else FAILED
    if rows:
        for line in align_columns(COLUMNS, rows):
            print_line(line)
        return OK
    for failure in dict.fromkeys(failures):  # each once
        print_line(failure)
    print_line("no servo answers")
    return FAILED


def _choose_bauds(port: str, bauds: Sequence[int]) -> Sequence[int]:
    """Return the baud rates to try on a port. A pseudo terminal has none: all its servos answer at any."""
    if is_emulated(port):
        return bauds[:1]
    return bauds


def scan(wire: SerialWire) -> Iterator[dict[str, str]]:
    """Yield a row of text, by `COLUMNS`, for each servo that answers on a port at its baud rate."""
    port = Port(wire, GAP_S)
    for ping in port.scan():
        yield _describe_servo(port, ping)


def _describe_servo(port: Port, ping: Packet) -> dict[str, str]:
    """Return the row of a servo. ping: its answer to a ping, with model and firmware."""
    number, firmware = struct.unpack("<HB", ping.data[:3])
    model = at.model_name(number)
    if number in at.MODELS:
        model = f"{model} ({number})"
    row = dict.fromkeys(COLUMNS, "-")
    row |= {
        "port": port.wire.port,
        "baud": str(port.wire.baud),
        "id": str(ping.id),
        "model": model,
        "firmware": str(firmware),
    }
    table = port.read(ping.id, 0, at.SIZE)
    if table is not None:
        row |= _describe_registers(table.data)
    return row


def _describe_registers(data: bytes) -> dict[str, str]:
    """Return the columns that are read from a servo's control table."""
    (position,) = struct.unpack_from("<i", data, at.PRESENT_POSITION)
    (homing_offset,) = struct.unpack_from("<i", data, at.HOMING_OFFSET)
    (current_limit,) = struct.unpack_from("<H", data, at.CURRENT_LIMIT)
    (voltage,) = struct.unpack_from("<H", data, at.VOLTAGE)
    errors = data[at.HARDWARE_ERROR]
    baud_of_value = {value: baud for baud, value in at.RATE.items()}
    baud = baud_of_value.get(data[at.BAUD_RATE])
    return {
        "baud": str(baud) if baud is not None else "-",
        "mode": str(data[at.OPERATING_MODE]),
        "offset": str(homing_offset),
        "angle": f"{position * at.RAD:.3f} rad",
        "current limit": str(current_limit),
        "voltage": f"{voltage * at.VOLTS:.1f} V",
        "heat": f"{data[at.TEMPERATURE]} °C",
        "errors": at.error_names(errors) if errors else "none",
    }
