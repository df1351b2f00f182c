"""`snakesim serial`: which servos answer on a port."""

import argparse
import struct
from collections.abc import Iterator, Sequence

from snakesim_hal.base.errors import BackendError
from snakesim_hal.base.terminal import aligned, say
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.packets import Packet
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.wire import SerialWire

OK, FAILED = 0, 1
GAP_S = 0.2
COLUMNS = (
    *("port", "baud", "id", "model", "firmware", "mode", "offset", "angle"),
    *("current limit", "voltage", "heat", "errors"),
)


def main(argv: Sequence[str]) -> int:
    """Exit code: 0 done, 1 nobody answers. Raises SnakesimError."""
    arguments = parser().parse_args(list(argv))
    return arguments.act(arguments)


def parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(prog="snakesim serial", description="Servos on serial ports.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    scan = commands.add_parser("scan", help="list every Dynamixel that answers; reads only, and moves nothing")
    scan.add_argument("port", nargs="+", help="serial port, such as /dev/ttyUSB0")
    scan.add_argument(
        "--baud", type=int, action="append", choices=list(at.RATE), help="repeat to try several (default: all)"
    )
    scan.set_defaults(act=_scan)
    return parser


def _scan(arguments: argparse.Namespace) -> int:
    rows: list[dict[str, str]] = []
    failed: list[str] = []
    for name in arguments.port:
        for baud in arguments.baud or list(at.RATE):
            try:
                wire = SerialWire(name, baud)
            except BackendError as error:  # an adapter that cannot do this rate, or a port in use
                failed.append(str(error))
                continue
            try:
                rows += scan(wire)
            finally:
                wire.close()
    for line in aligned(COLUMNS, rows) if rows else [*dict.fromkeys(failed), "nobody answers"]:
        say(line)
    return OK if rows else FAILED


def scan(wire: SerialWire) -> Iterator[dict[str, str]]:
    """Everybody on a port at its baud rate; one row each, as text by `COLUMNS`."""
    port = Port(wire, GAP_S)
    for said in port.scan():
        yield _row(port, said)


def _row(port: Port, said: Packet) -> dict[str, str]:
    number, firmware = struct.unpack("<HB", said.data[:3])
    row = dict.fromkeys(COLUMNS, "-")
    row |= {
        "port": port.wire.port,
        "baud": str(port.wire.baud),
        "id": str(said.id),
        "model": f"{at.model_name(number)} ({number})" if number in at.MODELS else at.model_name(number),
        "firmware": str(firmware),
    }
    if (table := port.read(said.id, 0, at.SIZE)) is None:
        return row
    data = table.data
    angle = struct.unpack_from("<i", data, at.PRESENT + 6)[0] * at.RAD
    return row | {
        "mode": str(data[at.OPERATING_MODE]),
        "offset": str(struct.unpack_from("<i", data, at.HOMING_OFFSET)[0]),
        "angle": f"{angle:.3f} rad",
        "current limit": str(struct.unpack_from("<H", data, at.CURRENT_LIMIT)[0]),
        "voltage": f"{struct.unpack_from('<H', data, at.VOLTAGE)[0] * at.VOLTS:.1f} V",
        "heat": f"{data[at.TEMPERATURE]} °C",
        "errors": at.error_names(data[at.HARDWARE_ERROR]) if data[at.HARDWARE_ERROR] else "none",
    }
