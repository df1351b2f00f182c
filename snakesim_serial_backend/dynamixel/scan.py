"""What `snakesim drive scan dynamixel` finds: the servos that answer on a port, and what their registers contain."""

import struct
from collections.abc import Iterator

from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.packets import DynamixelPacket
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.wire import SerialWire

GAP_S = 0.2  # silence that ends an answer: longer than any servo's return delay
COLUMNS = (
    *("port", "baud", "id", "model", "firmware", "mode", "offset", "angle"),
    *("current limit", "voltage", "heat", "errors"),
)


def scan(wire: SerialWire) -> Iterator[dict[str, str]]:
    """Yield a row of text, by `COLUMNS`, for each servo that answers on a port at its baud rate."""
    port = DynamixelPort(wire, GAP_S)
    for ping in port.scan():
        yield _describe_servo(port, ping)


def _describe_servo(port: DynamixelPort, ping: DynamixelPacket) -> dict[str, str]:
    """Return the row of the scan for one servo, by the names in `COLUMNS`.

    Args:
        port: Port of the servo.
        ping: Response of the servo to a ping, with model and firmware.
    """
    number, firmware = struct.unpack("<HB", ping.data[:3])
    model = registers.get_model_name(number)
    if number in registers.MODELS:
        model = f"{model} ({number})"
    row = dict.fromkeys(COLUMNS, "-")
    row |= {
        "port": port.wire.port,
        "baud": str(port.wire.baud),
        "id": str(ping.id),
        "model": model,
        "firmware": str(firmware),
    }
    table = port.read(ping.id, 0, registers.SIZE)
    if table is not None:
        row |= _describe_registers(table.data)
    return row


def _describe_registers(data: bytes) -> dict[str, str]:
    """Return the columns of a scan that are read from a servo's control table.

    Args:
        data: Control table, from address 0 on.
    """
    (position,) = struct.unpack_from("<i", data, registers.PRESENT_POSITION)
    (homing_offset,) = struct.unpack_from("<i", data, registers.HOMING_OFFSET)
    (current_limit,) = struct.unpack_from("<H", data, registers.CURRENT_LIMIT)
    (voltage,) = struct.unpack_from("<H", data, registers.VOLTAGE)
    errors = data[registers.HARDWARE_ERROR]
    baud_of_value = {value: baud for baud, value in registers.RATE.items()}
    baud = baud_of_value.get(data[registers.BAUD_RATE])
    return {
        "baud": str(baud) if baud is not None else "-",
        "mode": str(data[registers.OPERATING_MODE]),
        "offset": str(homing_offset),
        "angle": f"{position * registers.RAD:.3f} rad",
        "current limit": str(current_limit),
        "voltage": f"{voltage * registers.VOLTS:.1f} V",
        "heat": f"{data[registers.TEMPERATURE]} °C",
        "errors": registers.describe_errors(errors) if errors else "none",
    }
