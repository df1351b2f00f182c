"""Bytes of a cycle on one port, at worst. Pure.

A cycle is a sync read of all servos, their answer, the health of one, and a sync write to all. Enabling a robot takes
one cycle with about a third more bytes.
"""

from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.registers import RATE
from snakesim_serial_backend.port_load import PortLoad

PACKET_OVERHEAD = 10  # bytes around the parameters: header, id, length, instruction, CRC
REGISTERS = 4  # bytes of the address and the size in a request


def count_cycle_bytes(servo_count: int) -> int:
    """Return the number of bytes on the wire, in both directions, without stuffing."""
    read_request = PACKET_OVERHEAD + REGISTERS + servo_count
    # Each with error, id and CRC.
    read_answer = PACKET_OVERHEAD + servo_count * (registers.present_form.size + 4)
    # Request, and answer with error.
    health = PACKET_OVERHEAD + REGISTERS + PACKET_OVERHEAD + 1 + registers.HEALTH_SIZE
    # Each with id.
    goals = PACKET_OVERHEAD + REGISTERS + servo_count * (1 + registers.goals_form.size)
    return read_request + read_answer + health + goals


PORT_LOAD = PortLoad(list(RATE), count_cycle_bytes, "fast sync read, health of one, sync write")
