"""Bytes and time of a cycle on one port, at worst. Pure.

A cycle is a sync read of all servos, their answers, the state of one, and a sync write to all. Besides the bytes, each
of the two requests waits once for the adapter.
"""

from snakesim_serial_backend.feetech import registers as at
from snakesim_serial_backend.feetech.packets import OVERHEAD
from snakesim_serial_backend.wire import BITS_A_BYTE, USB_LATENCY_S

MAX_LOAD = 0.8  # of a period
REQUESTS = 2  # in a cycle that are answered
REGISTERS = 2  # bytes of the address and the size in a request


def cycle_bytes(servos: int) -> int:
    """Return the number of bytes on the wire, in both directions."""
    read_request = OVERHEAD + REGISTERS + servos
    read_answers = servos * (OVERHEAD + at.present_form.size)
    state = OVERHEAD + REGISTERS + OVERHEAD + at.STATE_SIZE
    goals = OVERHEAD + REGISTERS + servos * (1 + at.goals_form.size)  # each with id
    return read_request + read_answers + state + goals


def cycle_s(servos: int, baud: int) -> float:
    """Return how long a port is busy, or waits, in a cycle."""
    return cycle_bytes(servos) * BITS_A_BYTE / baud + REQUESTS * USB_LATENCY_S


def fits_hz(servos: int, baud: int) -> int:
    """Return the fastest possible control rate, in whole Hz."""
    return int(MAX_LOAD / cycle_s(servos, baud))
