"""What `snakesim drive emulate feetech` and `drive load feetech` do: servos at the end of pseudo terminals."""

import argparse

from snakesim_serial_backend.emulation import PortLoad, emulate_servos, print_port_load
from snakesim_serial_backend.feetech.backend import FeetechBackend, emulator_on
from snakesim_serial_backend.feetech.load import MAX_LOAD, cycle_bytes, cycle_s, fits_hz
from snakesim_serial_backend.feetech.registers import RATE

NOTE = (
    f"A cycle on one port: sync read, state of one, sync write; an adapter's latency of 1 ms for each of two "
    f"questions; the fastest rate at which it takes {MAX_LOAD:.0%} of a period"
)


def emulate(arguments: argparse.Namespace) -> int:
    """Emulate the servos until a stop signal. Returns 0; raises SnakesimError."""
    return emulate_servos(arguments, FeetechBackend, emulator_on)


def print_load(arguments: argparse.Namespace) -> int:
    """Print bytes, time and rate of a cycle for every baud rate. Returns 0."""
    return print_port_load(arguments, PortLoad(list(RATE), cycle_bytes, cycle_s, fits_hz, NOTE))
