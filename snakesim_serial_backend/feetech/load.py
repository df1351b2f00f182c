"""Bytes of a cycle on one port, at worst. Pure.

A cycle is a sync read of all servos, their answers, the state of one, and a sync write to all.
"""

from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.packets import OVERHEAD
from snakesim_serial_backend.feetech.registers import RATE
from snakesim_serial_backend.port_load import PortLoad

REGISTERS = 2  # bytes of the address and the size in a request


def count_cycle_bytes(servo_count: int) -> int:
    """Return the number of bytes on the wire, in both directions."""
    read_request = OVERHEAD + REGISTERS + servo_count
    read_answers = servo_count * (OVERHEAD + registers.present_form.size)
    state = OVERHEAD + REGISTERS + OVERHEAD + registers.STATE_SIZE
    goals = OVERHEAD + REGISTERS + servo_count * (1 + registers.goals_form.size)  # each with id
    return read_request + read_answers + state + goals


PORT_LOAD = PortLoad(list(RATE), count_cycle_bytes, "sync read, state of one, sync write")
