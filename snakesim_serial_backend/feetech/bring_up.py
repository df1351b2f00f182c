"""Checks before a motor moves: every servo is there, of a known model, and set up as the driver needs it.

Nothing is enabled here.
"""

import time
from collections.abc import Iterator, Sequence

from snakesim_hal.base.errors import BackendError
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.packets import (
    OFFSET_SIGN_BIT,
    SIGN_BIT,
    FeetechPacket,
    ServoError,
    decode_sign_magnitude,
)
from snakesim_serial_backend.feetech.port import FeetechPort
from snakesim_serial_backend.feetech.servo import SLACK_RAD, FeetechServo
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.request_port import ATTEMPTS, RequestPort
from snakesim_serial_backend.servo_bus import RegisterRange
from snakesim_serial_backend.servo_checks import NO_ANSWER, find_shared_id

EEPROM_VALUES = {
    registers.DELAY: 0,
    registers.STATUS_LEVEL: 1,
    registers.OPERATING_MODE: registers.POSITION_MODE,
}  # written where they differ
PROTECTIONS = ServoError.OVERHEATING | ServoError.OVERLOAD  # that must switch the torque off
# In which two servos differ.
MEASURED = RegisterRange(registers.PRESENT, registers.present_form.size)
MAX_TEMPERATURE_C = 80  # that a servo may allow itself; the maker delivers 70


def bring_up(
    servos: Sequence[FeetechServo], port: RequestPort[FeetechPacket], settings: FeetechSettings
) -> list[tuple[FeetechPacket, FeetechPacket]]:
    """Find all servos of a port, check them, and write the registers that the driver needs. Torque is off afterwards.

    Args:
        servos: Servos of the port; the properties that they report are stored in them.
        port: Port to which the servos are connected.
        settings: Settings of the driver type.

    Returns:
        For each servo its status packets with the motion registers and with the state registers, in this order.

    Raises:
        BackendError: A servo is missing or cannot be used; the message lists all such servos.
    """
    with port.extended_timeouts():
        found_names = _find_servos(servos, settings.bring_up_limit_s)
        problems: list[str] = []
        for servo in servos:
            problem = (
                _find_servo_problem(servo, settings) if servo.name in found_names else NO_ANSWER
            )
            if problem:
                problems.append(f"  {servo.label} {problem}")
        if problems:
            if len(found_names) < len(servos):
                problems += _describe_unknown_servos(servos)
            raise BackendError(
                "the robot is not complete; nothing was enabled:",
                *problems,
                code="drive/not-complete",
            )
        for servo in servos:
            _write_registers(servo)
        return [
            (
                _read_measurements(servo),
                _read_registers(servo, registers.TORQUE_ENABLE, registers.STATE_SIZE),
            )
            for servo in servos
        ]


def _find_servos(servos: Sequence[FeetechServo], timeout_s: float) -> set[str]:
    """Ping all servos until all have responded, or until a timeout, and return the names of those that responded.

    Garbled bytes count as a response, too: the check for a shared id explains them.
    """
    deadline_s = time.monotonic() + timeout_s
    found_names: set[str] = set()
    while True:
        for servo in servos:
            if servo.name not in found_names:
                responses = servo.port.ping(servo.id)
                if responses.statuses or responses.garbled:
                    found_names.add(servo.name)
        if len(found_names) == len(servos) or time.monotonic() > deadline_s:
            return found_names


def _find_servo_problem(servo: FeetechServo, settings: FeetechSettings) -> str:
    """Return why a servo cannot be used; empty if it can."""
    shared_id = find_shared_id(servo, MEASURED)
    if shared_id:
        return shared_id
    status = servo.port.try_to_read(servo.id, 0, registers.EEPROM_SIZE)
    if status is None:
        return NO_ANSWER
    eeprom = status.data
    servo.firmware = f"{eeprom[registers.FIRMWARE]}.{eeprom[registers.FIRMWARE + 1]}"
    return (
        _find_model_problem(eeprom, settings)
        or _find_travel_problem(servo, eeprom)
        or _find_protection_problem(servo, eeprom)
        or _find_torque_limit_problem(servo, eeprom)
    )


def _find_model_problem(eeprom: bytes, settings: FeetechSettings) -> str:
    """Return why a servo of this model cannot be used; empty if it can."""
    number = _word(eeprom, registers.MODEL)
    name = registers.get_model_name(number)
    if settings.model and name != settings.model:
        return f"is of another model: {name}, but `backends.feetech.model` = {settings.model}; correct one of them"
    if not settings.model and number not in registers.MODELS:
        known = ", ".join(registers.MODELS.values())
        return (
            f"is of another model: {name}; the driver knows {known}. If its control table is that of the STS series, "
            f'set `backends.feetech.model` = "{name}"'
        )
    return ""


def _find_travel_problem(servo: FeetechServo, eeprom: bytes) -> str:
    """Check homing offset and position limits in the EEPROM of a servo against the travel of its joint.

    Args:
        servo: Servo, with the travel that its joint needs.
        eeprom: EEPROM registers, from address 0 on.

    Returns:
        The reason why the servo cannot be used, to be put after its name; an empty string if it can be used.
    """
    offset = decode_sign_magnitude(_word(eeprom, registers.HOMING_OFFSET), OFFSET_SIGN_BIT)
    if servo.homing_offset not in (None, offset):
        return (
            f"has the homing offset {offset} (register {registers.HOMING_OFFSET}), and "
            f"`backends.feetech.homing_offsets` expects {servo.homing_offset}: another program has moved its zero. "
            "Calibrate the robot again"
        )
    min_position = _word(eeprom, registers.MIN_POSITION)
    max_position = _word(eeprom, registers.MAX_POSITION)
    if min_position == max_position == 0:
        return (
            f"has position limits of 0 (registers {registers.MIN_POSITION} and {registers.MAX_POSITION}): it counts "
            f"whole turns. Set them to 0 and {registers.LAST_POSITION}"
        )
    required_min_position = registers.to_position(servo.lower_rad)
    required_max_position = registers.to_position(servo.upper_rad)
    if min_position > required_min_position or max_position < required_max_position:
        return (
            f"has position limits of {min_position} to {max_position} (registers {registers.MIN_POSITION} and "
            f"{registers.MAX_POSITION}), and its joint travels from {required_min_position} to "
            f"{required_max_position}: widen the ones, or narrow `angle_rad` in [limits]"
        )
    return ""


def _find_protection_problem(servo: FeetechServo, eeprom: bytes) -> str:
    """Check that the protections in the EEPROM of a servo switch its torque off: heat, overload, and voltage range.

    Args:
        servo: Servo, with the minimum voltage of its joint.
        eeprom: EEPROM registers, from address 0 on.

    Returns:
        The first protection that is missing, as a text to be put after the servo's name; an empty string if none is.
    """
    unloading = eeprom[registers.UNLOADING]
    missing = PROTECTIONS & ~unloading
    if missing:
        return (
            f"keeps its torque on in spite of {registers.describe_errors(missing)} (register {registers.UNLOADING} "
            f"is {unloading}): set it to {unloading | PROTECTIONS}"
        )
    max_temperature_c = eeprom[registers.MAX_TEMPERATURE]
    if not 0 < max_temperature_c <= MAX_TEMPERATURE_C:
        return (
            f"allows itself {max_temperature_c} °C (register {registers.MAX_TEMPERATURE}): at most "
            f"{MAX_TEMPERATURE_C} °C; the maker delivers 70"
        )
    for address, what in (
        (registers.PROTECTION_TIME, "protection time"),
        (registers.OVERLOAD_TORQUE, "overload torque"),
    ):
        if eeprom[address] == 0:
            return f"has the {what} 0 (register {address}), so that no overload ends: set the maker's value"
    if eeprom[registers.PROTECTIVE_TORQUE] > eeprom[registers.OVERLOAD_TORQUE]:
        return (
            f"keeps a protective torque of {eeprom[registers.PROTECTIVE_TORQUE]} % (register "
            f"{registers.PROTECTIVE_TORQUE}), which exceeds its overload torque, {eeprom[registers.OVERLOAD_TORQUE]} "
            f"% (register {registers.OVERLOAD_TORQUE}): lower it"
        )
    min_voltage_v = eeprom[registers.MIN_VOLTAGE] * registers.VOLTS
    max_voltage_v = eeprom[registers.MAX_VOLTAGE] * registers.VOLTS
    if not min_voltage_v <= servo.min_voltage_v < max_voltage_v:
        return (
            f"allows {min_voltage_v:.1f} to {max_voltage_v:.1f} V (registers {registers.MIN_VOLTAGE} and "
            f"{registers.MAX_VOLTAGE}), and `min_voltage_v` of its joint is {servo.min_voltage_v:.1f} V, which must "
            "be in that range"
        )
    return ""


def _find_torque_limit_problem(servo: FeetechServo, eeprom: bytes) -> str:
    """Return why a servo's own torque limit does not suit its joint; empty if it does."""
    servo.max_per_mille = min(_word(eeprom, registers.MAX_TORQUE), registers.PER_MILLE)
    limit_nm = servo.max_per_mille / registers.PER_MILLE * servo.stall_torque_nm
    if servo.torque_nm > limit_nm * (1 + 1e-9):
        return (
            f"has a torque limit of {servo.max_per_mille} per mille (register {registers.MAX_TORQUE}), which is "
            f"{limit_nm:.2f} N·m, and its joint may command {servo.torque_nm:.2f} N·m: raise the one, or lower "
            f"`torque_nm`"
        )
    return ""


def _describe_unknown_servos(servos: Sequence[FeetechServo]) -> Iterator[str]:
    """Yield a line for each servo that answers and is no joint's: perhaps it is one that is missing."""
    port: FeetechPort = servos[0].port
    ids = {servo.id for servo in servos}
    for ping in port.scan():
        if ping.id not in ids:
            yield f"  id {ping.id} on {port.wire.port} is no joint's"


def _write_registers(servo: FeetechServo) -> None:
    """Switch the torque off, and write the registers that the driver needs. Raises BackendError."""
    _write_and_verify(servo, registers.TORQUE_ENABLE, 0)
    eeprom = _read_registers(servo, 0, registers.EEPROM_SIZE).data
    values = {
        address: value for address, value in EEPROM_VALUES.items() if eeprom[address] != value
    }
    if eeprom[registers.PHASE] & registers.MULTI_TURN_FEEDBACK:
        values[registers.PHASE] = eeprom[registers.PHASE] & ~registers.MULTI_TURN_FEEDBACK
    if not values:
        return
    _write_and_verify(servo, registers.LOCK, registers.OPEN)
    for address, value in values.items():
        _write_and_verify(servo, address, value)
    _write_and_verify(servo, registers.LOCK, registers.LOCKED)


def _write_and_verify(servo: FeetechServo, address: int, value: int) -> None:
    """Write a register, and read it back: an answer does not tell whether a servo accepted it. Raises BackendError."""
    for _ in range(ATTEMPTS):
        servo.port.write(servo.id, address, bytes([value]))
        status = servo.port.read(servo.id, address, 1)
        if status is not None and status.data[0] == value:
            return
    raise BackendError(
        f"{servo.label}: register {address} cannot be set to {value}; nothing was enabled",
        code="drive/parameter-refused",
    )


def _read_measurements(servo: FeetechServo) -> FeetechPacket:
    """Read what a servo measures. Raises BackendError for an angle outside the travel of its joint."""
    status = _read_registers(servo, registers.PRESENT, registers.present_form.size)
    position = decode_sign_magnitude(_word(status.data, 0), SIGN_BIT)
    angle_rad = registers.to_angle_rad(position)
    if not servo.lower_rad - SLACK_RAD <= angle_rad <= servo.upper_rad + SLACK_RAD:
        raise BackendError(
            f"{servo.label}: woke up at {angle_rad:.2f} rad (position {position}), outside its travel of "
            f"{servo.lower_rad:.2f} to {servo.upper_rad:.2f} rad; nothing was enabled. Turn it there by hand, or "
            "correct `zero_rad`",
            code="drive/unsupported-setting",
        )
    return status


def _read_registers(servo: FeetechServo, address: int, size: int) -> FeetechPacket:
    """Read registers of a servo. Raises BackendError without an answer."""
    status = servo.port.try_to_read(servo.id, address, size)
    if status is None:
        raise BackendError(
            f"{servo.label}: has stopped answering; nothing was enabled", code="drive/silent"
        )
    return status


def _word(data: bytes, address: int) -> int:
    return int.from_bytes(data[address : address + 2], "little")
