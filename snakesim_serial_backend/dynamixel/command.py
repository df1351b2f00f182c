"""What `snakesim drive emulate dynamixel` and `drive load dynamixel` do: servos at the end of pseudo terminals."""

import argparse

from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.emulation import emulate_servos, print_port_load


def emulate(arguments: argparse.Namespace) -> int:
    """Emulate the servos until a stop signal. Returns 0; raises SnakesimError."""
    return emulate_servos(arguments, DynamixelBackend)


def print_load(arguments: argparse.Namespace) -> int:
    """Print bytes, time and rate of a cycle for every baud rate. Returns 0."""
    return print_port_load(arguments, DynamixelBackend.port_load)
