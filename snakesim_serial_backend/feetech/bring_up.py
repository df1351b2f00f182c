"""Checks before a motor moves: every servo is there, of a known model, and set up as the driver needs it.

Nothing is enabled here.
"""

import time
from collections.abc import Iterator, Sequence

from snakesim_hal.base.errors import BackendError
from snakesim_serial_backend.feetech import registers as at
from snakesim_serial_backend.feetech.packets import OFFSET_SIGN_BIT, SIGN_BIT, Packet, ServoError, to_signed
from snakesim_serial_backend.feetech.port import Port
from snakesim_serial_backend.feetech.servo import SLACK_RAD, Servo
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.request_port import ATTEMPTS, RequestPort
from snakesim_serial_backend.servo_bus import Registers
from snakesim_serial_backend.servo_checks import NO_ANSWER, find_shared_id

EEPROM_VALUES = {at.DELAY: 0, at.STATUS_LEVEL: 1, at.OPERATING_MODE: at.POSITION_MODE}  # written where they differ
PROTECTIONS = ServoError.OVERHEATING | ServoError.OVERLOAD  # that must switch the torque off
MEASURED = Registers(at.PRESENT, at.present_form.size)  # in which two servos differ
MAX_TEMPERATURE_C = 80  # that a servo may allow itself; the maker delivers 70


def bring_up(
    servos: Sequence[Servo], port: RequestPort[Packet], settings: FeetechSettings
) -> list[tuple[Packet, Packet]]:
    """Find all servos, check them, and write the registers that the driver needs.

    Returns:
        What every servo measures, and its state.

    Raises:
        BackendError: a servo is missing or cannot be used; the message lists all of these.
    """
    with port.wait_patiently():
        found = _find_servos(servos, settings.bring_up_limit_s)
        flaws: list[str] = []
        for servo in servos:
            flaw = _check_servo(servo, settings) if servo.name in found else NO_ANSWER
            if flaw:
                flaws.append(f"  {servo.label} {flaw}")
        if flaws:
            if len(found) < len(servos):
                flaws += _describe_unknown_servos(servos)
            raise BackendError("the robot is not complete; nothing was enabled:", *flaws, code="drive/not-complete")
        for servo in servos:
            _write_registers(servo)
        return [(_read_present(servo), _read_registers(servo, at.TORQUE_ENABLE, at.STATE_SIZE)) for servo in servos]


def _find_servos(servos: Sequence[Servo], limit_s: float) -> set[str]:
    """Ping all servos until all have answered, or the time is over. Returns the names of those that did.

    Garbled bytes are an answer, too: the check of a shared id explains them.
    """
    end_s = time.monotonic() + limit_s
    found: set[str] = set()
    while True:
        for servo in servos:
            if servo.name not in found:
                answers = servo.port.ping(servo.id)
                if answers.statuses or answers.garbled:
                    found.add(servo.name)
        if len(found) == len(servos) or time.monotonic() > end_s:
            return found


def _check_servo(servo: Servo, settings: FeetechSettings) -> str:
    """Return why a servo cannot be used; empty if it can."""
    shared_id = find_shared_id(servo, MEASURED)
    if shared_id:
        return shared_id
    status = servo.port.try_to_read(servo.id, 0, at.EEPROM_SIZE)
    if status is None:
        return NO_ANSWER
    eeprom = status.data
    servo.firmware = f"{eeprom[at.FIRMWARE]}.{eeprom[at.FIRMWARE + 1]}"
    return (
        _check_model(eeprom, settings)
        or _check_travel(servo, eeprom)
        or _check_protections(servo, eeprom)
        or _check_torque_limit(servo, eeprom)
    )


def _check_model(eeprom: bytes, settings: FeetechSettings) -> str:
    """Return why a servo of this model cannot be used; empty if it can."""
    number = _word(eeprom, at.MODEL)
    name = at.model_name(number)
    if settings.model and name != settings.model:
        return f"is of another model: {name}, but `backends.feetech.model` = {settings.model}; correct one of them"
    if not settings.model and number not in at.MODELS:
        known = ", ".join(at.MODELS.values())
        return (
            f"is of another model: {name}; the driver knows {known}. If its control table is that of the STS series, "
            f'set `backends.feetech.model` = "{name}"'
        )
    return ""


def _check_travel(servo: Servo, eeprom: bytes) -> str:
    """Return why a servo's own limits do not suit the travel of its joint; empty if they do."""
    offset = to_signed(_word(eeprom, at.HOMING_OFFSET), OFFSET_SIGN_BIT)
    if servo.homing_offset not in (None, offset):
        return (
            f"has the homing offset {offset} (register {at.HOMING_OFFSET}), and `backends.feetech.homing_offsets` "
            f"expects {servo.homing_offset}: another program has moved its zero. Calibrate the robot again"
        )
    first = _word(eeprom, at.MIN_POSITION)
    last = _word(eeprom, at.MAX_POSITION)
    if first == last == 0:
        return (
            f"has position limits of 0 (registers {at.MIN_POSITION} and {at.MAX_POSITION}): it counts whole turns. "
            f"Set them to 0 and {at.LAST_POSITION}"
        )
    needs_first = at.to_position(servo.lower_rad)
    needs_last = at.to_position(servo.upper_rad)
    if first > needs_first or last < needs_last:
        return (
            f"has position limits of {first} to {last} (registers {at.MIN_POSITION} and {at.MAX_POSITION}), and its "
            f"joint travels from {needs_first} to {needs_last}: widen the ones, or narrow `angle_rad` in [limits]"
        )
    return ""


def _check_protections(servo: Servo, eeprom: bytes) -> str:
    """Return which protection of a servo is missing; empty if none is."""
    unloading = eeprom[at.UNLOADING]
    missing = PROTECTIONS & ~unloading
    if missing:
        return (
            f"keeps its torque on in spite of {at.error_names(missing)} (register {at.UNLOADING} is {unloading}): "
            f"set it to {unloading | PROTECTIONS}"
        )
    max_temperature_c = eeprom[at.MAX_TEMPERATURE]
    if not 0 < max_temperature_c <= MAX_TEMPERATURE_C:
        return (
            f"allows itself {max_temperature_c} °C (register {at.MAX_TEMPERATURE}): at most {MAX_TEMPERATURE_C} °C; "
            "the maker delivers 70"
        )
    for address, what in ((at.PROTECTION_TIME, "protection time"), (at.OVERLOAD_TORQUE, "overload torque")):
        if eeprom[address] == 0:
            return f"has the {what} 0 (register {address}), so that no overload ends: set the maker's value"
    if eeprom[at.PROTECTIVE_TORQUE] > eeprom[at.OVERLOAD_TORQUE]:
        return (
            f"keeps a protective torque of {eeprom[at.PROTECTIVE_TORQUE]} % (register {at.PROTECTIVE_TORQUE}), which "
            f"exceeds its overload torque, {eeprom[at.OVERLOAD_TORQUE]} % (register {at.OVERLOAD_TORQUE}): lower it"
        )
    min_voltage_v = eeprom[at.MIN_VOLTAGE] * at.VOLTS
    max_voltage_v = eeprom[at.MAX_VOLTAGE] * at.VOLTS
    if not min_voltage_v <= servo.min_voltage_v < max_voltage_v:
        return (
            f"allows {min_voltage_v:.1f} to {max_voltage_v:.1f} V (registers {at.MIN_VOLTAGE} and {at.MAX_VOLTAGE}), "
            f"and `min_voltage_v` of its joint is {servo.min_voltage_v:.1f} V, which must be in that range"
        )
    return ""


def _check_torque_limit(servo: Servo, eeprom: bytes) -> str:
    """Return why a servo's own torque limit does not suit its joint; empty if it does."""
    servo.max_per_mille = min(_word(eeprom, at.MAX_TORQUE), at.PER_MILLE)
    limit_nm = servo.max_per_mille / at.PER_MILLE * servo.stall_torque_nm
    if servo.torque_nm > limit_nm * (1 + 1e-9):
        return (
            f"has a torque limit of {servo.max_per_mille} per mille (register {at.MAX_TORQUE}), which is "
            f"{limit_nm:.2f} N·m, and its joint may command {servo.torque_nm:.2f} N·m: raise the one, or lower "
            f"`torque_nm`"
        )
    return ""


def _describe_unknown_servos(servos: Sequence[Servo]) -> Iterator[str]:
    """Yield a line for each servo that answers and is no joint's: perhaps it is one that is missing."""
    port: Port = servos[0].port
    ids = {servo.id for servo in servos}
    for ping in port.scan():
        if ping.id not in ids:
            yield f"  id {ping.id} on {port.wire.port} is no joint's"


def _write_registers(servo: Servo) -> None:
    """Switch the torque off, and write the registers that the driver needs. Raises BackendError."""
    _write(servo, at.TORQUE_ENABLE, 0)
    eeprom = _read_registers(servo, 0, at.EEPROM_SIZE).data
    values = {address: value for address, value in EEPROM_VALUES.items() if eeprom[address] != value}
    if eeprom[at.PHASE] & at.MULTI_TURN_FEEDBACK:
        values[at.PHASE] = eeprom[at.PHASE] & ~at.MULTI_TURN_FEEDBACK
    if not values:
        return
    _write(servo, at.LOCK, at.OPEN)
    for address, value in values.items():
        _write(servo, address, value)
    _write(servo, at.LOCK, at.LOCKED)


def _write(servo: Servo, address: int, value: int) -> None:
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


def _read_present(servo: Servo) -> Packet:
    """Read what a servo measures. Raises BackendError for an angle outside the travel of its joint."""
    status = _read_registers(servo, at.PRESENT, at.present_form.size)
    position = to_signed(_word(status.data, 0), SIGN_BIT)
    angle_rad = at.to_angle_rad(position)
    if not servo.lower_rad - SLACK_RAD <= angle_rad <= servo.upper_rad + SLACK_RAD:
        raise BackendError(
            f"{servo.label}: woke up at {angle_rad:.2f} rad (position {position}), outside its travel of "
            f"{servo.lower_rad:.2f} to {servo.upper_rad:.2f} rad; nothing was enabled. Turn it there by hand, or "
            "correct `zero_rad`",
            code="drive/unsupported-setting",
        )
    return status


def _read_registers(servo: Servo, address: int, size: int) -> Packet:
    """Read registers of a servo. Raises BackendError without an answer."""
    status = servo.port.try_to_read(servo.id, address, size)
    if status is None:
        raise BackendError(f"{servo.label}: has stopped answering; nothing was enabled", code="drive/silent")
    return status


def _word(data: bytes, address: int) -> int:
    return int.from_bytes(data[address : address + 2], "little")
