"""What `snakesim drive emulate feetech` and `drive load feetech` do: servos at the end of pseudo terminals."""

import argparse

from snakesim_serial_backend.emulation import emulate_servos, print_port_load
from snakesim_serial_backend.feetech.backend import FeetechBackend


def emulate(arguments: argparse.Namespace) -> int:
    """Emulate the servos until a stop signal. Returns 0; raises SnakesimError."""
    return emulate_servos(arguments, FeetechBackend)


def print_load(arguments: argparse.Namespace) -> int:
    """Print bytes, time and rate of a cycle for every baud rate. Returns 0."""
    return print_port_load(arguments, FeetechBackend.port_load)
