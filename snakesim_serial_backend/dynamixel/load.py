"""Bytes and time of a cycle on one port, at worst. Pure.

A cycle is a sync read of all servos, their answer, the health of one, and a sync write to all. Enabling a robot takes
one cycle with about a third more bytes. Besides the bytes, each of the two requests waits once for the adapter.
"""

from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.wire import BITS_A_BYTE, USB_LATENCY_S

MAX_LOAD = 0.8  # of a period
REQUESTS = 2  # in a cycle that are answered
PACKET_OVERHEAD = 10  # bytes around the parameters: header, id, length, instruction, CRC
REGISTERS = 4  # bytes of the address and the size in a request


def cycle_bytes(servos: int) -> int:
    """Return the number of bytes on the wire, in both directions, without stuffing."""
    read_request = PACKET_OVERHEAD + REGISTERS + servos
    read_answer = PACKET_OVERHEAD + servos * (at.present_form.size + 4)  # each with error, id and CRC
    health = PACKET_OVERHEAD + REGISTERS + PACKET_OVERHEAD + 1 + at.HEALTH_SIZE  # request, and answer with error
    goals = PACKET_OVERHEAD + REGISTERS + servos * (1 + at.goals_form.size)  # each with id
    return read_request + read_answer + health + goals


def cycle_s(servos: int, baud: int) -> float:
    """Return how long a port is busy, or waits, in a cycle."""
    return cycle_bytes(servos) * BITS_A_BYTE / baud + REQUESTS * USB_LATENCY_S


def fits_hz(servos: int, baud: int) -> int:
    """Return the fastest possible control rate, in whole Hz."""
    return int(MAX_LOAD / cycle_s(servos, baud))
