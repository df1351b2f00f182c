"""A second program that reads one Feetech servo."""

from snakesim_drivers.kit.drive_probe import DriveStatus
from snakesim_hal.model.scenario import RunConfig
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.port import FeetechPort
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.servo_probe import ServoProbe


class FeetechProbe(ServoProbe[FeetechPort]):
    """Reads the control table of a servo."""

    required_registers = {
        "operating mode (33)": (registers.OPERATING_MODE, registers.POSITION_MODE),
        "return delay (7)": (registers.DELAY, 0),
        "status return level (8)": (registers.STATUS_LEVEL, 1),
    }

    def __init__(self, config: RunConfig, settings: FeetechSettings) -> None:
        """Open the port of the servo."""
        super().__init__(config, settings, FeetechPort)

    def read_status(self, timeout_s: float) -> DriveStatus | None:
        """Read torque enable."""
        del timeout_s  # the port has its own
        data = self.read_registers(registers.TORQUE_ENABLE, 1)
        if data is None:
            return None
        return DriveStatus(bool(data[0]), f"torque enable {data[0]}")
