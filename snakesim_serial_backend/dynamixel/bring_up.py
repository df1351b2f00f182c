"""Checks before a motor moves: every servo is there, of a known model, and set up as the driver needs it.

Nothing is enabled here.
"""

import logging
import struct
import time
from collections.abc import Iterator, Sequence

from snakesim_hal.base.errors import BackendError
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.packets import LAST_ID, DynamixelPacket
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.dynamixel.servo import SLACK_RAD, DynamixelServo
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.request_port import ATTEMPTS
from snakesim_serial_backend.servo_bus import GARBLED, RegisterRange
from snakesim_serial_backend.servo_checks import NO_ANSWER, find_shared_id

# Registers that are written at every start.
STARTUP_REGISTERS = {registers.STATUS_LEVEL: 2, registers.TORQUE_ENABLE: 0, registers.WATCHDOG: 0}
# Registers that are written only where they differ, as each write wears out their memory.
EEPROM_VALUES = {registers.OPERATING_MODE: registers.CURRENT_BASED_POSITION, registers.DELAY: 0}
TORQUE_AT_START = 0x01  # bit of the startup configuration
# Registers in which two servos differ: position, voltage, temperature.
MEASURED = RegisterRange(registers.PRESENT, registers.TEMPERATURE + 1 - registers.PRESENT)

_log = logging.getLogger("snakesim.dynamixel")


def bring_up(
    servos: Sequence[DynamixelServo], port: DynamixelPort, settings: DynamixelSettings
) -> list[tuple[DynamixelPacket, DynamixelPacket]]:
    """Find all servos of a port, check them, and write the registers that the driver needs. Torque is off afterwards.

    Args:
        servos: Servos of the port; the properties that they report are stored in them.
        port: Port to which the servos are connected.
        settings: Settings of the driver type.

    Returns:
        For each servo its status packets with the motion registers and with the health registers, in this order.

    Raises:
        BackendError: A servo is missing or cannot be used; the message lists all such servos.
    """
    with port.extended_timeouts():
        return _bring_up_with_extended_timeouts(servos, port, settings)


def _bring_up_with_extended_timeouts(
    servos: Sequence[DynamixelServo], port: DynamixelPort, settings: DynamixelSettings
) -> list[tuple[DynamixelPacket, DynamixelPacket]]:
    """Bring up the servos, as `bring_up` declares, while the port waits longer for responses."""
    pings, problem_by_name = _find_servos(servos, settings.bring_up_limit_s)
    problems: list[str] = []
    for servo in servos:
        problem = problem_by_name.get(servo.name) or _find_servo_problem(
            servo, pings.get(servo.name), settings
        )
        if problem:
            problems.append(f"  {servo.label} {problem}")
    if problems:
        if len(pings) < len(servos):
            problems += _describe_unknown_servos(servos, port)
        raise BackendError(
            "the robot is not complete; nothing was enabled:", *problems, code="drive/not-complete"
        )
    for servo in servos:
        _write_registers(servo)
    # Try a fast sync read, which older firmware does not support. Use it from now on if every servo has answered.
    ids = [servo.id for servo in servos]
    statuses_by_id = port.read_all(ids, registers.PRESENT, registers.present_form.size)
    port.fast = len(statuses_by_id) == len(ids)
    return [
        (
            _read_measurements(servo),
            _read_registers(servo, registers.TORQUE_ENABLE, registers.HEALTH_SIZE),
        )
        for servo in servos
    ]


def _find_servo_problem(
    servo: DynamixelServo, ping: DynamixelPacket | None, settings: DynamixelSettings
) -> str:
    """Return why a servo cannot be used; empty if it can. ping: its answer to a ping, None without one."""
    if ping is None:
        return NO_ANSWER
    shared_id = find_shared_id(servo, MEASURED)
    if shared_id:
        return shared_id
    eeprom = servo.port.try_to_read(servo.id, 0, registers.EEPROM_SIZE)
    if eeprom is None:
        return NO_ANSWER
    number, firmware = struct.unpack("<HB", ping.data[:3])
    return (
        _find_model_problem(servo, number, settings)
        or _find_firmware_problem(firmware)
        or _find_eeprom_problem(eeprom)
        or _find_current_limit_problem(servo, eeprom)
    )


def _find_servos(
    servos: Sequence[DynamixelServo], timeout_s: float
) -> tuple[dict[str, DynamixelPacket], dict[str, str]]:
    """Ping all servos until all have responded, or until a timeout.

    Args:
        servos: Servos to find.
        timeout_s: Maximum duration of the search.

    Returns:
        The response of each servo that has responded, and a problem text for each servo that sends garbled bytes; both
        by the name of the servo.
    """
    deadline_s = time.monotonic() + timeout_s
    responses_by_name: dict[str, DynamixelPacket] = {}
    problem_by_name: dict[str, str] = {}
    while True:
        for servo in servos:
            if servo.name in responses_by_name:
                continue
            responses = servo.port.ping(servo.id)
            problem_by_name.pop(servo.name, None)
            if responses.statuses:
                responses_by_name[servo.name] = responses.statuses[0]
            elif responses.garbled:
                problem_by_name[servo.name] = f"sends garbled bytes in answer to a ping: {GARBLED}"
        if len(responses_by_name) == len(servos) or time.monotonic() > deadline_s:
            return responses_by_name, problem_by_name


def _find_model_problem(servo: DynamixelServo, number: int, settings: DynamixelSettings) -> str:
    """Check the model of a servo, and store the torque of its current unit.

    Args:
        servo: Servo whose model is checked; `torque_unit_nm` is set if the model can be used.
        number: Model number that the servo has reported.
        settings: Settings of the driver type, which may name a model and current units.

    Returns:
        The reason why the servo cannot be used, to be put after its name; an empty string if it can be used.
    """
    name = registers.get_model_name(number)
    if settings.model and name != settings.model:
        return (
            f"is of another model: {name}, but `backends.dynamixel.model` = {settings.model}; correct the scenario, or "
            f"replace the servo"
        )
    if number in registers.WITHOUT_CURRENT:
        return f"is of another model: {name} neither measures nor limits current, which this driver needs"
    current_a = settings.current_unit_a.get(str(number))
    if current_a is None and number in registers.MODELS:
        current_a = registers.MODELS[number].current_a
    if current_a is None:
        return (
            f"is of another model: {name}, whose unit of current is not known here; give that of its e-Manual, in A, "
            f"as `backends.dynamixel.current_unit_a.{number}`"
        )
    servo.torque_unit_nm = current_a * servo.torque_constant_nm_per_a
    return ""


def _find_firmware_problem(firmware: int) -> str:
    """Return why this firmware cannot be used; empty if it can."""
    if firmware < registers.FIRST_FIRMWARE:
        return f"has firmware {firmware}, and its bus watchdog needs {registers.FIRST_FIRMWARE}: update it"
    return ""


def _find_eeprom_problem(eeprom: DynamixelPacket) -> str:
    """Return which EEPROM register of a servo has an unsafe value, and what to do; an empty string if none has."""
    drive_mode = eeprom.data[registers.DRIVE_MODE]
    (offset,) = struct.unpack_from("<i", eeprom.data, registers.HOMING_OFFSET)
    if drive_mode or offset:
        return (
            f"has drive mode {drive_mode} and homing offset {offset}; both must be 0, as direction and zero are those "
            f"of the robot file (`sign`, `zero_rad`)"
        )
    secondary_id = eeprom.data[registers.SECONDARY_ID]
    if secondary_id <= LAST_ID:
        return (
            f"has the secondary id {secondary_id} (register {registers.SECONDARY_ID}), and would take the setpoints "
            f"of that id, too: set it to 255, which is off"
        )
    startup = eeprom.data[registers.STARTUP]
    if startup & TORQUE_AT_START:
        return (
            f"has startup configuration {startup} (register {registers.STARTUP}): it switches its torque on "
            f"when it starts, before the driver has found it. Clear bit 0"
        )
    return ""


def _find_current_limit_problem(servo: DynamixelServo, eeprom: DynamixelPacket) -> str:
    """Return why a servo's own limit does not suit its joint; empty if it does."""
    (servo.max_current,) = struct.unpack_from("<H", eeprom.data, registers.CURRENT_LIMIT)
    limit_nm = servo.max_current * servo.torque_unit_nm
    if servo.torque_nm > limit_nm:
        return (
            f"has a current limit of {limit_nm / servo.torque_constant_nm_per_a:.2f} A, which is "
            f"{limit_nm:.2f} N·m, and its joint may command {servo.torque_nm:.2f} N·m: "
            f"raise the one, or lower `torque_nm`"
        )
    return ""


def _describe_unknown_servos(
    servos: Sequence[DynamixelServo], port: DynamixelPort
) -> Iterator[str]:
    """Yield a line for each servo that answers and is no joint's: perhaps it is one that is missing."""
    ids = {servo.id for servo in servos}
    for ping in port.scan():
        if ping.id not in ids:
            (number,) = struct.unpack("<H", ping.data[:2])
            yield f"  id {ping.id} on {port.wire.port} is no joint's: {registers.get_model_name(number)}"


def _write_registers(servo: DynamixelServo) -> None:
    """Write the registers that the driver needs; torque is off afterwards.

    EEPROM registers are written only where they differ, because each write wears out their memory.

    Raises:
        BackendError: The servo does not respond, or rejects a value.
    """
    state = _read_registers(servo, registers.TORQUE_ENABLE, registers.STATE_SIZE).data
    if state[registers.WATCHDOG - registers.TORQUE_ENABLE] == registers.TRIPPED:
        _log.warning("%s: clearing an expired bus watchdog of an earlier run", servo.label)
    eeprom = _read_registers(servo, 0, registers.EEPROM_SIZE).data
    differing = {
        address: value for address, value in EEPROM_VALUES.items() if eeprom[address] != value
    }
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


def _read_measurements(servo: DynamixelServo) -> DynamixelPacket:
    """Read the motion registers of a servo, and check that its angle is unambiguous within its travel.

    Raises:
        BackendError: The servo does not respond, or no number or several numbers of whole turns fit its travel.
    """
    status = _read_registers(servo, registers.PRESENT, registers.present_form.size)
    _, _, position = registers.present_form.unpack(status.data)
    angle_rad = position * registers.RAD
    if registers.find_whole_turns(angle_rad, servo.lower_rad, servo.upper_rad, SLACK_RAD) is None:
        raise BackendError(
            f"{servo.label}: woke up at {angle_rad:.2f} rad, which no number of whole turns, or more than one, brings "
            f"into its travel of {servo.lower_rad:.2f} to {servo.upper_rad:.2f} rad; nothing was enabled. Turn it "
            f"there by hand, or correct `zero_rad`",
            code="drive/unsupported-setting",
        )
    return status


def _read_registers(servo: DynamixelServo, address: int, size: int) -> DynamixelPacket:
    """Read registers of a servo. Raises BackendError without an answer."""
    status = servo.port.try_to_read(servo.id, address, size)
    if status is None:
        raise BackendError(
            f"{servo.label}: has stopped answering; nothing was enabled", code="drive/silent"
        )
    return status


def _try_to_write(servo: DynamixelServo, address: int, value: int) -> DynamixelPacket | None:
    """Write a register of a servo, several times if need be, and return its answer; None without one."""
    for _ in range(ATTEMPTS):
        status = servo.port.write(servo.id, address, bytes([value]))
        if status is not None:
            return status
    return None
