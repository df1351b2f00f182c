"""The backend `moteus`: moteus controllers, real or emulated."""

from collections.abc import Sequence

from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_can_backend.can_drives.traffic import CycleTraffic
from snakesim_can_backend.moteus.controllers import (
    MoteusControllers,
    compute_required_gains,
    get_configured_gains,
)
from snakesim_can_backend.moteus.emulator import EmulatedMoteus
from snakesim_can_backend.moteus.probe import ControllerProbe
from snakesim_can_backend.moteus.protocol import BROADCAST_ID, HOST_ID, LAST_ID
from snakesim_can_backend.moteus.settings import MoteusSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig

GAIN_TOLERANCE_FACTOR = 1.001  # factor: people round the gains that they copy


class MoteusBackend(CanDriveBackend):
    """The backend on moteus controllers, real or emulated."""

    Settings = MoteusSettings
    drives_class = MoteusControllers
    emulator_class = EmulatedMoteus
    name = "moteus"
    plural_noun = "controllers"
    first_id = HOST_ID + 1
    last_id = LAST_ID
    reserved_ids = f"{HOST_ID} is the host's, {BROADCAST_ID} the broadcast address"
    # A controller reports whenever it is requested, but takes a while to get ready.
    report_period_s = 0.05
    traffic = CycleTraffic(
        bytes_per_drive=(5, 24, 48),  # request, answer and command
        bytes_per_cycle=(6, 24, 3, 16),  # requests and answers of health and serial number
    )

    @classmethod
    def open_probe(cls, config: RunConfig, settings: MoteusSettings) -> ControllerProbe:
        return ControllerProbe(config, settings)

    @classmethod
    def check_drives(
        cls, config: RunConfig, settings: MoteusSettings, joints: Sequence[Joint]
    ) -> None:
        """Check channels, ids and bus load, and the gains, which must be equal on all controllers.

        Args:
            config: Configuration of the run.
            settings: Settings of the driver type, which state the gains that the controllers are configured with.
            joints: Joints with moteus controllers.

        Raises:
            ConfigError: The joints need higher gains than configured, or the gains of real controllers are not known.
        """
        super().check_drives(config, settings, joints)
        required_kp, required_kd = compute_required_gains(joints)
        kp, kd = get_configured_gains(joints, settings)
        has_gain_settings = (
            settings.kp_nm_per_turn is not None and settings.kd_nm_s_per_turn is not None
        )
        are_gains_unknown = cls.has_real_bus(settings) and not has_gain_settings
        are_gains_too_low = (
            required_kp > kp * GAIN_TOLERANCE_FACTOR or required_kd > kd * GAIN_TOLERANCE_FACTOR
        )
        if are_gains_unknown or are_gains_too_low:
            raise ConfigError(
                f"robot {config.robot.name!r} needs `servo.pid_position.kp` from {required_kp:.4g} N·m/turn on, and "
                f"`.kd` from {required_kd:.4g} N·m·s/turn: configure all controllers alike, and state their values in "
                f"`backends.moteus.kp_nm_per_turn` and `kd_nm_s_per_turn`",
                code="drive/unsupported-setting",
            )
