"""What the driver knows of one CiA 402 drive, and the decisions that need nothing else. Pure."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from snakesim_can_backend.cia402.frames import EmergencyMessage, describe_error, describe_register
from snakesim_can_backend.cia402.limits import UnitScaling
from snakesim_can_backend.cia402.objects import CURRENT, RATED_CURRENT, VOLTAGE, ObjectEntry
from snakesim_can_backend.cia402.sdo import SdoQueue
from snakesim_can_backend.cia402.settings import Cia402Settings
from snakesim_can_backend.cia402.state_machine import (
    FAULT_STATES,
    ControlwordCommand,
    OperationMode,
    PowerState,
    choose_next_controlword,
)

# unknown: bring-up has not written anything yet. booting: the driver has restarted its communication.
# configuring: its settings and PDOs are being written. ready: it was started, and answers SYNC.
Phase = Literal["unknown", "booting", "configuring", "ready"]

# Objects of emulated drives alone, in the range of vendors.
EMULATED_MOTOR_TEMPERATURE = ObjectEntry(0x2031, 1, "h", "temperature of the motor")
EMULATED_BOARD_TEMPERATURE = ObjectEntry(0x2031, 2, "h", "temperature of the electronics")


@dataclass
class Cia402Drive:
    """One drive."""

    queue: SdoQueue
    phase: Phase = "unknown"
    phase_start_ns: int = 0  # when the phase began
    failure: str = ""  # why it cannot be identified or configured
    # What the drive reports in bring-up.
    values: dict[ObjectEntry, int] = field(default_factory=dict[ObjectEntry, int])
    # Entries that bring-up still waits for.
    unread_entries: set[ObjectEntry] = field(default_factory=set[ObjectEntry])
    scaling: UnitScaling | None = None
    # What it reports later.
    state: PowerState = PowerState.UNKNOWN
    mode: int = 0  # of operation
    error_code: int = 0
    # The last one, until the drive reports that the error is gone.
    emergency: EmergencyMessage | None = None
    last_heartbeat_ns: int = 0  # when the last one arrived
    pre_operational_heartbeats: int = 0  # in a row
    position: int | None = None  # since the last SYNC
    velocity: int | None = None  # since the last SYNC
    health: dict[ObjectEntry, int] = field(default_factory=dict[ObjectEntry, int])
    # What the driver does with it.
    is_enabling: bool = False  # towards Operation enabled
    # There, since it was switched off last: from then on it gets no further steps.
    was_enabled: bool = False
    should_reset_fault: bool = False  # with the next configuration
    quick_stop_start_ns: int | None = None  # when it first reported the present quick stop

    def describe_errors(self) -> str:
        """Return the errors of a drive in words; empty if it has none. Emergency messages without a fault are none."""
        if self.failure:
            return f"that it cannot be configured: {self.failure}"
        if self.state not in FAULT_STATES:
            return ""
        if self.emergency is not None:
            return f"{describe_error(self.emergency.code)} ({describe_register(self.emergency.register)})"
        if self.error_code:
            return describe_error(self.error_code)
        return "a fault without an error code"

    def choose_controlword(self, target_mode: OperationMode) -> ControlwordCommand:
        """Return the controlword for a drive that should be enabled.

        A drive that has left Operation enabled by itself stays off.

        Args:
            target_mode: Operation mode of the setpoint. The drive is enabled only once it reports this mode.
        """
        if self.state == PowerState.ENABLED:
            return ControlwordCommand.ENABLE_OPERATION
        if not self.is_enabling:
            return ControlwordCommand.DISABLE_VOLTAGE
        if self.state == PowerState.SWITCHED_ON and self.mode != target_mode:
            return ControlwordCommand.SWITCH_ON
        return choose_next_controlword(self.state)


class DriveHealth(NamedTuple):
    """Supply and temperatures of a drive."""

    voltage_v: float
    current_a: float
    motor_c: float
    board_c: float


@dataclass(frozen=True)
class HealthObjects:
    """The objects with supply and temperatures; the latter are a vendor's own."""

    motor: ObjectEntry | None  # temperature; None: it is unknown
    board: ObjectEntry | None  # temperature; None: that of the motor is used
    unit_c: float  # of both temperatures

    @property
    def entries(self) -> list[ObjectEntry]:
        """The entries to read, each once."""
        temperatures = [entry for entry in (self.motor, self.board) if entry is not None]
        return list(dict.fromkeys([VOLTAGE, CURRENT, *temperatures]))

    def convert(self, servo: Cia402Drive) -> DriveHealth | None:
        """Return the health that a drive has reported; None if something of it is unknown."""
        health = servo.health
        if (
            self.motor is None
            or self.motor not in health
            or VOLTAGE not in health
            or CURRENT not in health
        ):
            return None
        rated_current_a = servo.values.get(RATED_CURRENT, 0) / 1000
        motor_c = health[self.motor] * self.unit_c
        board_c = motor_c
        if self.board is not None and self.board in health:
            board_c = health[self.board] * self.unit_c
        return DriveHealth(
            health[VOLTAGE] / 1000, health[CURRENT] / 1000 * rated_current_a, motor_c, board_c
        )


def make_health_objects(settings: Cia402Settings, *, uses_bundled_eds: bool) -> HealthObjects:
    """Return the health objects of a driver type.

    Args:
        settings: The settings, which name the objects of real drives.
        uses_bundled_eds: Whether the drives are emulated ones with the EDS of this package.
    """
    motor = _parse_temperature(settings.motor_temperature)
    board = _parse_temperature(settings.board_temperature)
    if motor is None and uses_bundled_eds:
        motor = EMULATED_MOTOR_TEMPERATURE
        board = EMULATED_BOARD_TEMPERATURE
    return HealthObjects(motor, board, settings.temperature_unit_c)


def _parse_temperature(text: str | None) -> ObjectEntry | None:
    """Return the entry of INDEX:SUBINDEX, in which the index is hexadecimal."""
    if text is None:
        return None
    index, _, sub = text.partition(":")
    return ObjectEntry(int(index, 16), int(sub), "h", "temperature")
