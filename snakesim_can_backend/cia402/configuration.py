"""What the driver reads from a drive before it writes anything, and what it then writes and reads back. Pure."""

import math
from collections.abc import Iterator

from snakesim_can_backend.cia402.frames import NmtCommand
from snakesim_can_backend.cia402.objects import (
    ABORT_CONNECTION_OPTION_CODE,
    COB_ID_MASK,
    CONSUMER_HEARTBEAT,
    CONTROLWORD,
    CYCLE_INDEX,
    CYCLE_VALUE,
    DEVICE_TYPE,
    ENCODER_INCREMENTS,
    ENCODER_REVOLUTIONS,
    ERROR_BEHAVIOR,
    ERROR_CODE,
    FAULT_REACTION,
    MAX_POSITION,
    MAX_SPEED,
    MAX_TORQUE,
    MIN_POSITION,
    PDO_OFF,
    PDOS,
    PRODUCER_HEARTBEAT,
    PRODUCT_CODE,
    QUICK_STOP_OPTION,
    RATED_CURRENT,
    RATED_TORQUE,
    REVISION,
    SERIAL,
    STATUSWORD,
    SUPPORTED_MODES,
    UNUSED_PDOS,
    VENDOR_ID,
    ObjectEntry,
    Pdo,
    encode_mapping,
)
from snakesim_can_backend.cia402.sdo import NmtStep, ReadStep, Step, WriteStep
from snakesim_can_backend.cia402.settings import Cia402Settings
from snakesim_can_backend.cia402.state_machine import ControlwordCommand

FAULT_ON_ABORT = 1  # 6007h
TORQUE_OFF_ON_FAULT = 0  # 605Eh
NO_NMT_STATE_CHANGE = 1  # 1029h: the drive still reports its state
QUICK_STOP_OPTION_CODES = {"torque_off": 0, "ramp": 2}  # 605Ah
CYCLE_EXPONENTS = (-3, -4, -5, -6, -2, -1)  # of 10, in seconds
MAX_CYCLE_VALUE = 255

REQUIRED_ENTRIES = (DEVICE_TYPE, VENDOR_ID, STATUSWORD, SUPPORTED_MODES, MAX_TORQUE)
OPTIONAL_ENTRIES = (
    *(
        PRODUCT_CODE,
        REVISION,
        SERIAL,
        ERROR_CODE,
        ABORT_CONNECTION_OPTION_CODE,
        RATED_CURRENT,
        RATED_TORQUE,
        MAX_SPEED,
    ),
    *(MIN_POSITION, MAX_POSITION, ENCODER_INCREMENTS, ENCODER_REVOLUTIONS),
)


def list_identification_steps() -> list[ReadStep]:
    """Return the steps that read identity, limits and units of a drive, and change nothing."""
    required = [ReadStep(entry) for entry in REQUIRED_ENTRIES]
    optional = [ReadStep(entry, optional=True) for entry in OPTIONAL_ENTRIES]
    return required + optional


def list_switch_off_steps() -> list[Step]:
    """Return the steps that switch a drive off which has no PDOs yet."""
    return [WriteStep(CONTROLWORD, ControlwordCommand.DISABLE_VOLTAGE)]


def list_fault_reset_steps() -> list[Step]:
    """Return the steps of a fault reset: it works when its bit changes from 0 to 1."""
    return [
        WriteStep(CONTROLWORD, ControlwordCommand.DISABLE_VOLTAGE),
        WriteStep(CONTROLWORD, ControlwordCommand.FAULT_RESET),
        WriteStep(CONTROLWORD, ControlwordCommand.DISABLE_VOLTAGE),
    ]


def list_configuration_steps(node_id: int, settings: Cia402Settings, period_s: float) -> list[Step]:
    """Return the steps that make a drive ready for control cycles; required values are read back and compared.

    The drive is pre-operational while it is configured, and operational after the last step.

    Args:
        node_id: Node id of the drive.
        settings: Settings of the driver type.
        period_s: Duration from one setpoint to the next.
    """
    steps: list[Step] = [NmtStep(NmtCommand.ENTER_PRE_OPERATIONAL)]
    steps += _write_and_check(CONSUMER_HEARTBEAT, encode_consumer_heartbeat(settings))
    steps += _write_and_check(PRODUCER_HEARTBEAT, round(settings.heartbeat_s * 1000))
    steps += _write_and_check(ERROR_BEHAVIOR, NO_NMT_STATE_CHANGE, optional=True)
    steps += _write_and_check(
        ABORT_CONNECTION_OPTION_CODE, FAULT_ON_ABORT, optional=settings.allow_unverified_watchdog
    )
    # Many drives have one reaction only, so a refusal is no failure.
    steps.append(WriteStep(FAULT_REACTION, TORQUE_OFF_ON_FAULT, optional=True))
    steps.append(
        WriteStep(QUICK_STOP_OPTION, QUICK_STOP_OPTION_CODES[settings.quick_stop], optional=True)
    )
    value, exponent = encode_cycle_period(period_s)
    steps.append(WriteStep(CYCLE_VALUE, value, optional=True))
    steps.append(WriteStep(CYCLE_INDEX, exponent, optional=True))
    for pdo in PDOS:
        steps += _list_pdo_steps(pdo, node_id)
    for pdo in UNUSED_PDOS:
        steps.append(WriteStep(pdo.cob_id_entry(), PDO_OFF | pdo.base | node_id, optional=True))
    steps.append(NmtStep(NmtCommand.START))
    return steps


def encode_consumer_heartbeat(settings: Cia402Settings) -> int:
    """Return the value of 1016h: the node of the host, and the time in ms after which its silence is an error."""
    return settings.host_id << 16 | round(settings.watchdog_s * 1000)


def encode_cycle_period(period_s: float) -> tuple[int, int]:
    """Encode a period for object 60C2h as an 8-bit value and an exponent of 10, in seconds.

    The first exponent with which the period is exact to 0.1 % is taken, or else the most exact one.
    """
    best = (MAX_CYCLE_VALUE, CYCLE_EXPONENTS[0])
    best_error = math.inf
    for exponent in CYCLE_EXPONENTS:
        value = round(period_s / 10**exponent)
        if not 1 <= value <= MAX_CYCLE_VALUE:
            continue
        error = abs(value * 10**exponent - period_s) / period_s
        if error < best_error - 1e-3:
            best = (value, exponent)
            best_error = error
    return best


def _write_and_check(entry: ObjectEntry, value: int, *, optional: bool = False) -> Iterator[Step]:
    yield WriteStep(entry, value, optional=optional)
    yield ReadStep(entry, expected=value, optional=optional)


def _list_pdo_steps(pdo: Pdo, node_id: int) -> Iterator[Step]:
    """Yield the steps that map a PDO: a drive allows it only while the PDO is off and its number of entries is 0."""
    cob_id = pdo.base | node_id
    yield WriteStep(pdo.cob_id_entry(), PDO_OFF | cob_id)
    yield WriteStep(pdo.mapping_entry(0), 0)
    for sub, entry in enumerate(pdo.entries, start=1):
        yield WriteStep(pdo.mapping_entry(sub), encode_mapping(entry))
    yield WriteStep(pdo.mapping_entry(0), len(pdo.entries))
    yield WriteStep(pdo.transmission_entry(), pdo.transmission_type)
    yield WriteStep(pdo.cob_id_entry(), cob_id)
    for sub, entry in enumerate(pdo.entries, start=1):
        yield ReadStep(pdo.mapping_entry(sub), expected=encode_mapping(entry))
    yield ReadStep(pdo.mapping_entry(0), expected=len(pdo.entries))
    yield ReadStep(pdo.transmission_entry(), expected=pdo.transmission_type)
    yield ReadStep(pdo.cob_id_entry(), expected=cob_id, mask=COB_ID_MASK)
