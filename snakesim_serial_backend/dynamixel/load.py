"""Bytes and time of a cycle on one port, at worst. Pure.

A cycle is a sync read of all, its answer, the health of one, and a sync write of all. Switching a robot on takes one
cycle of about a third more. Besides the bytes, each of the two questions waits once for the adapter.
"""

from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.wire import BITS_A_BYTE, USB_LATENCY_S

MAX_LOAD = 0.8  # of a period
QUESTIONS = 2
AROUND = 10  # bytes of a packet around its parameters: header, id, length, instruction, CRC


def cycle_bytes(servos: int) -> int:
    """On the wire, both ways, without stuffing."""
    asked = AROUND + 4 + servos
    each = at.present_form.size
    told = AROUND + servos * (each + 4)
    health = AROUND + 4 + AROUND + 1 + at.HEALTH_SIZE
    goals = AROUND + 4 + servos * (1 + at.goals_form.size)
    return asked + told + health + goals


def cycle_s(servos: int, baud: int) -> float:
    """How long a port is busy, or waits."""
    return cycle_bytes(servos) * BITS_A_BYTE / baud + QUESTIONS * USB_LATENCY_S


def fits_hz(servos: int, baud: int) -> int:
    """The fastest control rate that holds, in whole Hz."""
    return int(MAX_LOAD / cycle_s(servos, baud))
