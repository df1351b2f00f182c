"""Before a motor turns: every servo is there, of a known model, and kept as the driver needs it. Enables nothing."""

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

WANTED = {at.STATUS_LEVEL: 2, at.TORQUE_ENABLE: 0, at.WATCHDOG: 0}
# Two servos with one id: their answers follow each other if their return delays differ, and collide if they do not.
ANSWERS_TWICE = "is duplicated: it answers one question twice; give each servo its own id"
GARBLED = (
    "a second servo has its id, or the line is disturbed; give each servo its own id, one after the other alone on the "
    "bus, and check cables and terminators"
)
TORQUE_AT_START = 0x01
READS = 3  # to tell a second servo from a single disturbance
MEASURED = at.TEMPERATURE + 1 - at.PRESENT  # registers in which two servos differ: position, voltage, temperature
KEPT = {at.OPERATING_MODE: at.CURRENT_BASED_POSITION, at.DELAY: 0}  # written only where it differs: it wears out

_log = logging.getLogger("snakesim.dynamixel")


def bring_up(servos: Sequence[Servo], port: Port, settings: DynamixelSettings) -> list[tuple[Packet, Packet]]:
    """What every servo measures, and its health. Raises BackendError."""
    found, objections = _find(servos, settings.bring_up_limit_s)
    wrong: list[str] = []
    for servo in servos:
        said = found.get(servo.name)
        if why := objections.get(servo.name) or (_shared_id(servo) if said is not None else ""):
            wrong.append(f"  {servo.who} {why}")
            continue
        kept = None if said is None else servo.port.read(servo.id, 0, at.KEPT)
        if why := _unfit(servo, said, kept, settings):
            wrong.append(f"  {servo.who} {why}")
    if wrong:
        strangers = _strangers(servos, port) if len(found) < len(servos) else []
        raise BackendError("the robot is not complete; nothing was enabled:", *wrong, *strangers)
    for servo in servos:
        _set_up(servo)
    ids = [servo.id for servo in servos]
    port.fast = len(port.read_all(ids, at.PRESENT, at.present_form.size)) == len(ids)  # older firmware: it is not
    return [(_present(servo), _answer(servo, at.TORQUE_ENABLE, at.HEALTH_SIZE)) for servo in servos]


def _find(servos: Sequence[Servo], limit_s: float) -> tuple[dict[str, Packet], dict[str, str]]:
    """Return what each servo that was found answers to a ping, and objections to those that share an id. By name."""
    end = time.monotonic() + limit_s
    found: dict[str, Packet] = {}
    objections: dict[str, str] = {}
    while True:
        for servo in servos:
            if servo.name in found:
                continue
            answers = servo.port.ping(servo.id)
            if answers.statuses:
                found[servo.name] = answers.statuses[0]
            if len(answers.statuses) > 1:
                objections[servo.name] = ANSWERS_TWICE
            elif answers.garbled and not answers.statuses:
                objections[servo.name] = f"sends garbled bytes in answer to a ping: {GARBLED}"
            else:
                objections.pop(servo.name, None)
        if len(found) == len(servos) or time.monotonic() > end:
            return found, objections


def _shared_id(servo: Servo) -> str:
    """Return why another servo seems to have the same id; empty if only one answers.

    A ping does not show it: two servos of one model answer it with the same bytes at the same time.
    """
    garbled = 0
    for _ in range(READS):
        answers = servo.port.read_alone(servo.id, at.PRESENT, MEASURED)
        if len(answers.statuses) > 1:
            return ANSWERS_TWICE
        if answers.statuses:
            return ""
        garbled += answers.garbled
    return f"sends garbled bytes, in {garbled} of {READS} answers: {GARBLED}" if garbled else ""


def _unfit(servo: Servo, said: Packet | None, kept: Packet | None, settings: DynamixelSettings) -> str:
    """Why a servo cannot be used; empty if it can, and then its units are known."""
    if said is None or kept is None:
        return "does not answer: it is off, or has another id or baud rate"
    number, firmware = struct.unpack("<HB", said.data[:3])
    model, name = at.MODELS.get(number), at.model_name(number)
    if settings.model and name != settings.model:
        return f"is of another model: {name}; `backends.dynamixel.model` says {settings.model}"
    if number in at.WITHOUT_CURRENT:
        return f"is of another model: {name} neither measures nor limits current, which this driver needs"
    current_a = settings.current_unit_a.get(str(number), model.current_a if model else None)
    if current_a is None:
        return (
            f"is of another model: {name}, whose unit of current is not known here; give that of its e-Manual, in A, "
            f"as `backends.dynamixel.current_unit_a.{number}`"
        )
    if firmware < at.FIRST_FIRMWARE:
        return f"has firmware {firmware}, and its bus watchdog needs {at.FIRST_FIRMWARE}: update it"
    drive_mode, (offset,) = kept.data[at.DRIVE_MODE], _unpacked("<i", kept, at.HOMING_OFFSET)
    if drive_mode or offset:
        return (
            f"has drive mode {drive_mode} and homing offset {offset}; both must be 0, as direction and zero are those "
            f"of the robot file (`sign`, `zero_rad`)"
        )
    if (secondary_id := kept.data[at.SECONDARY_ID]) <= LAST_ID:
        return (
            f"has the secondary id {secondary_id} (register {at.SECONDARY_ID}), and would take the setpoints of that "
            f"id, too: set it to 255, which is off"
        )
    if kept.data[at.STARTUP] & TORQUE_AT_START:
        return (
            f"has startup configuration {kept.data[at.STARTUP]} (register {at.STARTUP}): it switches its torque on "
            f"when it starts, before the driver has found it. Clear bit 0"
        )
    servo.unit_nm = current_a * servo.constant
    (servo.most_current,) = _unpacked("<H", kept, at.CURRENT_LIMIT)
    if servo.torque_nm > servo.most_current * servo.unit_nm:
        return (
            f"has a current limit of {servo.most_current * current_a:.2f} A, which is "
            f"{servo.most_current * servo.unit_nm:.2f} N·m, and its joint may ask for {servo.torque_nm:.2f} N·m: "
            f"raise the one, or lower `torque_nm`"
        )
    return ""


def _strangers(servos: Sequence[Servo], port: Port) -> Iterator[str]:
    """Who else answers: perhaps whoever is missing."""
    ours = {servo.id for servo in servos}
    for said in port.scan():
        if said.id not in ours:
            (number,) = struct.unpack("<H", said.data[:2])
            yield f"  id {said.id} on {port.wire.port} is no joint's: {at.model_name(number)}"


def _set_up(servo: Servo) -> None:
    state = _answer(servo, at.TORQUE_ENABLE, at.STATE_SIZE).data
    if state[at.WATCHDOG - at.TORQUE_ENABLE] == at.TRIPPED:
        _log.warning("%s: clearing an expired bus watchdog of an earlier run", servo.who)
    kept = _answer(servo, 0, at.KEPT).data
    differs = {address: value for address, value in KEPT.items() if kept[address] != value}
    for address, value in {**WANTED, **differs}.items():
        said = servo.port.write(servo.id, address, bytes([value]))
        if said is None or said.error:
            why = "does not answer" if said is None else f"says error {said.error}"
            raise BackendError(f"{servo.who}: register {address} cannot be set to {value}: it {why}; nothing enabled")


def _present(servo: Servo) -> Packet:
    said = _answer(servo, at.PRESENT, at.present_form.size)
    angle_rad = at.present_form.unpack(said.data)[2] * at.RAD
    if at.whole_turns(angle_rad, servo.lower_rad, servo.upper_rad, SLACK_RAD) is None:
        raise BackendError(
            f"{servo.who}: woke up at {angle_rad:.2f} rad, which no number of whole turns, or more than one, brings "
            f"into its travel of {servo.lower_rad:.2f} to {servo.upper_rad:.2f} rad; "
            "nothing was enabled. Turn it there "
            f"by hand, or correct `zero_rad`"
        )
    return said


def _answer(servo: Servo, address: int, size: int) -> Packet:
    if (said := servo.port.read(servo.id, address, size)) is None:
        raise BackendError(f"{servo.who}: has stopped answering; nothing was enabled")
    return said


def _unpacked(form: str, said: Packet, address: int) -> tuple[int, ...]:
    return struct.unpack_from(form, said.data, address)
