"""A second program that reads one Dynamixel servo."""

from snakesim_drivers.kit.drive_probe import DriveStatus
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.servo_probe import ServoProbe


class DynamixelProbe(ServoProbe[DynamixelPort]):
    """Reads the control table of a servo."""

    required_registers = {
        "operating mode (11)": (registers.OPERATING_MODE, registers.CURRENT_BASED_POSITION),
        "return delay (9)": (registers.DELAY, 0),
        "status return level (68)": (registers.STATUS_LEVEL, 2),
    }

    def __init__(self, config: RunConfig, settings: DynamixelSettings) -> None:
        """Open the port of the servo."""
        super().__init__(config, settings, DynamixelPort)

    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Read torque enable and the bus watchdog."""
        del timeout_s  # the port has its own
        data = self.read_registers(registers.TORQUE_ENABLE, registers.STATE_SIZE)
        if data is None:
            return None
        is_tripped = data[registers.WATCHDOG - registers.TORQUE_ENABLE] == registers.TRIPPED
        text = f"torque enable {data[0]}"
        if is_tripped:
            text += ", the bus watchdog has tripped"
        return DriveStatus(bool(data[0]) and not is_tripped, text)
