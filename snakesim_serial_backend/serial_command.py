"""What `snakesim drive scan` does for every protocol of this package: it lists the servos that answer on a port."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.base.terminal import align_columns, print_json, print_line
from snakesim_serial_backend.wire import SerialWire, is_emulated

OK = 0  # exit codes
FAILED = 1


@dataclass(frozen=True)
class PortScan:
    """How to scan a port for the servos of one protocol."""

    columns: tuple[str, ...]  # of the table
    rates: Sequence[int]  # baud rates in bit/s
    find_servos: Callable[[SerialWire], Iterable[dict[str, str]]]  # rows of text, by `columns`


def scan_ports(arguments: argparse.Namespace, scan: PortScan) -> int:
    """Run `snakesim drive scan` for a protocol: list the servos that respond on some ports at any of its baud rates.

    Args:
        arguments: Parsed command line.
        scan: How to scan a port for servos of the protocol.

    Returns:
        Exit code 0; 1 if no servo responds.

    Raises:
        ConfigError: The servos do not have a baud rate of the command line, or a port does not exist.
    """
    missing = [baud for baud in arguments.baud or () if baud not in scan.rates]
    if missing:
        possible = ", ".join(map(str, scan.rates))
        raise ConfigError(
            f"--baud {missing[0]}: these servos do not have this rate; they have {possible} bit/s",
            code="drive/unsupported-setting",
        )
    rows: list[dict[str, str]] = []
    failures: list[str] = []
    for name in arguments.channel:
        for baud in _choose_bauds(name, arguments.baud or scan.rates):
            try:
                wire = SerialWire(name, baud)
            except (
                BackendError
            ) as error:  # an adapter that does not support this rate, or a port in use
                failures.append(str(error))
                continue
            try:
                rows += scan.find_servos(wire)
            finally:
                wire.close()
    if arguments.json:
        print_json({"drives": rows, "failures": list(dict.fromkeys(failures))})
        return OK if rows else FAILED
    if rows:
        for line in align_columns(scan.columns, rows):
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
