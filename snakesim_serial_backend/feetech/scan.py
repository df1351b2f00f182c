"""What `snakesim drive scan feetech` finds: the servos that answer on a port, and what their registers contain."""

from collections.abc import Iterator

from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.packets import (
    OFFSET_SIGN_BIT,
    SIGN_BIT,
    FeetechPacket,
    decode_sign_magnitude,
)
from snakesim_serial_backend.feetech.port import FeetechPort
from snakesim_serial_backend.wire import SerialWire

GAP_S = 0.2  # silence that ends an answer: longer than any servo's return delay
COLUMNS = (
    *("port", "baud", "id", "model", "firmware", "mode", "offset", "angle"),
    *("torque", "voltage", "heat", "errors"),
)


def scan(wire: SerialWire) -> Iterator[dict[str, str]]:
    """Yield a row of text, by `COLUMNS`, for each servo that answers on a port at its baud rate."""
    port = FeetechPort(wire, GAP_S)
    for ping in port.scan():
        yield _describe_servo(port, ping)


def _describe_servo(port: FeetechPort, ping: FeetechPacket) -> dict[str, str]:
    """Return the row of a servo. ping: its answer to a ping."""
    row = dict.fromkeys(COLUMNS, "-")
    row |= {"port": port.wire.port, "baud": str(port.wire.baud), "id": str(ping.id)}
    table = port.read(ping.id, 0, registers.CURRENT + 2)
    if table is not None:
        row |= _describe_registers(table.data)
        row["errors"] = registers.describe_errors(table.error) if table.error else "none"
    return row


def _describe_registers(data: bytes) -> dict[str, str]:
    """Return the columns that are read from a servo's control table."""
    number = _word(data, registers.MODEL)
    model = registers.get_model_name(number)
    if number in registers.MODELS:
        model = f"{model} ({number})"
    angle_rad = registers.to_angle_rad(
        decode_sign_magnitude(_word(data, registers.PRESENT), SIGN_BIT)
    )
    return {
        "model": model,
        "firmware": f"{data[registers.FIRMWARE]}.{data[registers.FIRMWARE + 1]}",
        "mode": str(data[registers.OPERATING_MODE]),
        "offset": str(decode_sign_magnitude(_word(data, registers.HOMING_OFFSET), OFFSET_SIGN_BIT)),
        "angle": f"{angle_rad:.3f} rad",
        "torque": "on" if data[registers.TORQUE_ENABLE] else "off",
        "voltage": f"{data[registers.VOLTAGE] * registers.VOLTS:.1f} V",
        "heat": f"{data[registers.TEMPERATURE]} °C",
    }


def _word(data: bytes, address: int) -> int:
    return int.from_bytes(data[address : address + 2], "little")
