"""Checks before a motor moves: every servo is there, of a known model, and set up as the driver needs it.

Nothing is enabled here.
"""

import logging
import struct
import time
from collections.abc import Iterator, Sequence

from snakesim_hal.base.errors import BackendError
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.packets import LAST_ID, Packet
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.dynamixel.servo import SLACK_RAD, Servo
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.request_port import ATTEMPTS
from snakesim_serial_backend.servo_bus import GARBLED, Registers
from snakesim_serial_backend.servo_checks import NO_ANSWER, find_shared_id

# Registers that are written at every start.
STARTUP_REGISTERS = {at.STATUS_LEVEL: 2, at.TORQUE_ENABLE: 0, at.WATCHDOG: 0}
# Registers that are written only where they differ, as each write wears out their memory.
EEPROM_VALUES = {at.OPERATING_MODE: at.CURRENT_BASED_POSITION, at.DELAY: 0}
TORQUE_AT_START = 0x01  # bit of the startup configuration
# Registers in which two servos differ: position, voltage, temperature.
MEASURED = Registers(at.PRESENT, at.TEMPERATURE + 1 - at.PRESENT)

_log = logging.getLogger("snakesim.dynamixel")


def bring_up(servos: Sequence[Servo], port: Port, settings: DynamixelSettings) -> list[tuple[Packet, Packet]]:
    """Find all servos, check them, and write the registers that the driver needs.

    Returns:
        What every servo measures, and its health.

    Raises:
        BackendError: a servo is missing or cannot be used; the message lists all of these.
    """
    with port.wait_patiently():
        return _bring_up(servos, port, settings)


def _bring_up(servos: Sequence[Servo], port: Port, settings: DynamixelSettings) -> list[tuple[Packet, Packet]]:
    """Do what `bring_up` declares."""
    pings, objections = _find_servos(servos, settings.bring_up_limit_s)
    flaws: list[str] = []
    for servo in servos:
        flaw = objections.get(servo.name) or _check_servo(servo, pings.get(servo.name), settings)
        if flaw:
            flaws.append(f"  {servo.label} {flaw}")
    if flaws:
        if len(pings) < len(servos):
            flaws += _describe_unknown_servos(servos, port)
        raise BackendError("the robot is not complete; nothing was enabled:", *flaws, code="drive/not-complete")
    for servo in servos:
        _write_registers(servo)
    ids = [servo.id for servo in servos]
    port.fast = len(port.read_all(ids, at.PRESENT, at.present_form.size)) == len(ids)  # older firmware is not
    return [(_read_present(servo), _read_registers(servo, at.TORQUE_ENABLE, at.HEALTH_SIZE)) for servo in servos]


def _check_servo(servo: Servo, ping: Packet | None, settings: DynamixelSettings) -> str:
    """Return why a servo cannot be used; empty if it can. ping: its answer to a ping, None without one."""
    if ping is None:
        return NO_ANSWER
    shared_id = find_shared_id(servo, MEASURED)
    if shared_id:
        return shared_id
    eeprom = servo.port.try_to_read(servo.id, 0, at.EEPROM_SIZE)
    if eeprom is None:
        return NO_ANSWER
    number, firmware = struct.unpack("<HB", ping.data[:3])
    return (
        _check_model(servo, number, settings)
        or _check_firmware(firmware)
        or _check_eeprom(eeprom)
        or _check_current_limit(servo, eeprom)
    )


def _find_servos(servos: Sequence[Servo], limit_s: float) -> tuple[dict[str, Packet], dict[str, str]]:
    """Ping all servos until all have answered, or the time is over.

    Returns:
        The answer of each servo that answered, and the objection to each that sends garbled bytes; by its name.
    """
    end_s = time.monotonic() + limit_s
    found: dict[str, Packet] = {}
    objections: dict[str, str] = {}
    while True:
        for servo in servos:
            if servo.name in found:
                continue
            answers = servo.port.ping(servo.id)
            objections.pop(servo.name, None)
            if answers.statuses:
                found[servo.name] = answers.statuses[0]
            elif answers.garbled:
                objections[servo.name] = f"sends garbled bytes in answer to a ping: {GARBLED}"
        if len(found) == len(servos) or time.monotonic() > end_s:
            return found, objections


def _check_model(servo: Servo, number: int, settings: DynamixelSettings) -> str:
    """Return why a servo of this model cannot be used; empty if it can, and then its unit of current is known."""
    name = at.model_name(number)
    if settings.model and name != settings.model:
        return (
            f"is of another model: {name}, but `backends.dynamixel.model` = {settings.model}; correct the scenario, or "
            f"replace the servo"
        )
    if number in at.WITHOUT_CURRENT:
        return f"is of another model: {name} neither measures nor limits current, which this driver needs"
    current_a = settings.current_unit_a.get(str(number))
    if current_a is None and number in at.MODELS:
        current_a = at.MODELS[number].current_a
    if current_a is None:
        return (
            f"is of another model: {name}, whose unit of current is not known here; give that of its e-Manual, in A, "
            f"as `backends.dynamixel.current_unit_a.{number}`"
        )
    servo.unit_nm = current_a * servo.constant
    return ""


def _check_firmware(firmware: int) -> str:
    """Return why this firmware cannot be used; empty if it can."""
    if firmware < at.FIRST_FIRMWARE:
        return f"has firmware {firmware}, and its bus watchdog needs {at.FIRST_FIRMWARE}: update it"
    return ""


def _check_eeprom(eeprom: Packet) -> str:
    """Return which of the registers that a servo keeps without power is unsafe; empty if none is."""
    drive_mode = eeprom.data[at.DRIVE_MODE]
    (offset,) = struct.unpack_from("<i", eeprom.data, at.HOMING_OFFSET)
    if drive_mode or offset:
        return (
            f"has drive mode {drive_mode} and homing offset {offset}; both must be 0, as direction and zero are those "
            f"of the robot file (`sign`, `zero_rad`)"
        )
    secondary_id = eeprom.data[at.SECONDARY_ID]
    if secondary_id <= LAST_ID:
        return (
            f"has the secondary id {secondary_id} (register {at.SECONDARY_ID}), and would take the setpoints of that "
            f"id, too: set it to 255, which is off"
        )
    startup = eeprom.data[at.STARTUP]
    if startup & TORQUE_AT_START:
        return (
            f"has startup configuration {startup} (register {at.STARTUP}): it switches its torque on "
            f"when it starts, before the driver has found it. Clear bit 0"
        )
    return ""


def _check_current_limit(servo: Servo, eeprom: Packet) -> str:
    """Return why a servo's own limit does not suit its joint; empty if it does."""
    (servo.max_current,) = struct.unpack_from("<H", eeprom.data, at.CURRENT_LIMIT)
    limit_nm = servo.max_current * servo.unit_nm
    if servo.torque_nm > limit_nm:
        return (
            f"has a current limit of {limit_nm / servo.constant:.2f} A, which is "
            f"{limit_nm:.2f} N·m, and its joint may command {servo.torque_nm:.2f} N·m: "
            f"raise the one, or lower `torque_nm`"
        )
    return ""


def _describe_unknown_servos(servos: Sequence[Servo], port: Port) -> Iterator[str]:
    """Yield a line for each servo that answers and is no joint's: perhaps it is one that is missing."""
    ids = {servo.id for servo in servos}
    for ping in port.scan():
        if ping.id not in ids:
            (number,) = struct.unpack("<H", ping.data[:2])
            yield f"  id {ping.id} on {port.wire.port} is no joint's: {at.model_name(number)}"


def _write_registers(servo: Servo) -> None:
    """Write the registers that the driver needs; torque is off afterwards. Raises BackendError."""
    state = _read_registers(servo, at.TORQUE_ENABLE, at.STATE_SIZE).data
    if state[at.WATCHDOG - at.TORQUE_ENABLE] == at.TRIPPED:
        _log.warning("%s: clearing an expired bus watchdog of an earlier run", servo.label)
    eeprom = _read_registers(servo, 0, at.EEPROM_SIZE).data
    differing = {address: value for address, value in EEPROM_VALUES.items() if eeprom[address] != value}
    for address, value in {**STARTUP_REGISTERS, **differing}.items():
        status = _try_to_write(servo, address, value)
        if status is None:
            reason = "does not answer"
        elif status.error:
            reason = f"reports error {status.error}"
        else:
            continue
        raise BackendError(
            f"{servo.label}: register {address} cannot be set to {value}: it {reason}; nothing enabled",
            code="drive/parameter-refused",
        )


def _read_present(servo: Servo) -> Packet:
    """Read what a servo measures. Raises BackendError for an angle that does not tell where its joint is."""
    status = _read_registers(servo, at.PRESENT, at.present_form.size)
    _, _, position = at.present_form.unpack(status.data)
    angle_rad = position * at.RAD
    if at.whole_turns(angle_rad, servo.lower_rad, servo.upper_rad, SLACK_RAD) is None:
        raise BackendError(
            f"{servo.label}: woke up at {angle_rad:.2f} rad, which no number of whole turns, or more than one, brings "
            f"into its travel of {servo.lower_rad:.2f} to {servo.upper_rad:.2f} rad; nothing was enabled. Turn it "
            f"there by hand, or correct `zero_rad`",
            code="drive/unsupported-setting",
        )
    return status


def _read_registers(servo: Servo, address: int, size: int) -> Packet:
    """Read registers of a servo. Raises BackendError without an answer."""
    status = servo.port.try_to_read(servo.id, address, size)
    if status is None:
        raise BackendError(f"{servo.label}: has stopped answering; nothing was enabled", code="drive/silent")
    return status


def _try_to_write(servo: Servo, address: int, value: int) -> Packet | None:
    """Write a register of a servo, several times if need be, and return its answer; None without one."""
    for _ in range(ATTEMPTS):
        status = servo.port.write(servo.id, address, bytes([value]))
        if status is not None:
            return status
    return None
