"""The backend `odrive`, and `snakesim odrives`, which emulates axes as a process."""

from collections.abc import Sequence

from snakesim_can_backend.family.backend import CanDriveBackend, CanDriveSettings
from snakesim_can_backend.family.command import run
from snakesim_can_backend.family.traffic import Traffic
from snakesim_can_backend.odrive.axes import Axes
from snakesim_can_backend.odrive.protocol import LAST_NODE
from snakesim_can_backend.odrive.twin import HEARTBEAT_US, OdriveTwin
from snakesim_hal.drivers.drive_settings import who
from snakesim_hal.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig


class OdriveSettings(CanDriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.odrive]` section. `watchdog_s` is what the axes have in `watchdog_timeout`."""


class OdriveBackend(CanDriveBackend):
    """A `snakesim_hal.backend.Backend` on ODrive axes, real or emulated."""

    Settings, drives, twin = OdriveSettings, Axes, OdriveTwin
    name, a_drive, last_id, says_every_s = "odrive", "axes", LAST_NODE, HEARTBEAT_US * 1e-6
    reserved_ids = "63 is the broadcast address"
    # A tick is two questions, two answers and an input; of one axis four questions more. Then heartbeats.
    traffic = Traffic((0, 0, 8, 8, 8), (0, 0, 0, 0, 8, 8, 8, 8), heartbeats_hz=1e6 / HEARTBEAT_US)

    @classmethod
    def check_joint(cls, config: RunConfig, settings: OdriveSettings, joint: Joint) -> None:
        """Raise ConfigError for joints that no axis can be."""
        where = who(config, joint)
        if joint.motor.damping_nm_s_per_rad <= 0:
            raise ConfigError(f"{where}: `damping_nm_s_per_rad` must be above 0: an ODrive's position loop needs it")
        if joint.motor.torque_constant_nm_per_a is None and cls.real(settings):
            raise ConfigError(
                f"{where}: `torque_constant_nm_per_a` is not given, and ODrives measure and limit amperes: take it "
                f"from the motor's data sheet (8.27 / KV), as `axis0.config.motor.torque_constant` has it"
            )


def main(argv: Sequence[str] | None = None) -> int:
    """`snakesim odrives`."""
    return run(OdriveBackend, "odrives", argv)
