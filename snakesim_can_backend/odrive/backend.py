"""The backend `odrive`: ODrive axes, real or emulated."""

import math
from collections.abc import Sequence

from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_can_backend.can_drives.traffic import CycleTraffic
from snakesim_can_backend.odrive.axes import (
    EMULATED_CONSTANT_NM_PER_A,
    RELATIVE_TOLERANCE,
    UNKNOWN_MAX_CURRENT_A,
    OdriveAxes,
    compute_required_current_a,
)
from snakesim_can_backend.odrive.emulator import HEARTBEAT_US, EmulatedOdrive
from snakesim_can_backend.odrive.endpoints import read_all_endpoints
from snakesim_can_backend.odrive.probe import AxisProbe
from snakesim_can_backend.odrive.protocol import LAST_NODE
from snakesim_can_backend.odrive.settings import OdriveSettings
from snakesim_drivers.kit.drive_settings import make_joint_label
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig


class OdriveBackend(CanDriveBackend):
    """The backend on ODrive axes, real or emulated."""

    Settings = OdriveSettings
    drives_class = OdriveAxes
    emulator_class = EmulatedOdrive
    name = "odrive"
    plural_noun = "axes"
    last_id = LAST_NODE
    reserved_ids = "63 is the broadcast address"
    uses_torque_constant = True
    report_period_s = HEARTBEAT_US * 1e-6
    traffic = CycleTraffic(
        bytes_per_drive=(0, 0, 8, 8, 8),  # two requests, two answers and an input
        bytes_per_cycle=(0, 0, 0, 0, 8, 8, 8, 8),  # four requests and their answers
        heartbeats_hz=1e6 / HEARTBEAT_US,
    )

    @classmethod
    def open_probe(cls, config: RunConfig, settings: OdriveSettings) -> AxisProbe:
        return AxisProbe(config, settings)

    @classmethod
    def validate_joint(cls, config: RunConfig, settings: OdriveSettings, joint: Joint) -> None:
        """Check that an ODrive axis can drive a joint as the robot file describes it.

        Args:
            config: Configuration of the run, used in error messages.
            settings: Settings of the driver type.
            joint: Joint of the robot file.

        Raises:
            ConfigError: The joint has no damping or torque constant, or its torque limit needs too much current.
        """
        context = make_joint_label(config, joint)
        if joint.motor.damping_nm_s_per_rad <= 0:
            raise ConfigError(
                f"{context}: `damping_nm_s_per_rad` must be above 0: an ODrive's position loop needs it",
                code="drive/unsupported-setting",
            )
        if joint.motor.torque_constant_nm_per_a is None and cls.has_real_bus(settings):
            raise ConfigError(
                f"{context}: `torque_constant_nm_per_a` is missing, and ODrives measure and limit amperes: take it "
                f"from the motor's data sheet (8.27 / KV), as `axis0.config.motor.torque_constant` has it",
                code="drive/unsupported-setting",
            )
        cls.validate_current_limit(config, settings, joint)

    @classmethod
    def validate_current_limit(
        cls, config: RunConfig, settings: OdriveSettings, joint: Joint
    ) -> None:
        """Check that the torque limit of a joint needs no more current than the driver may set.

        Args:
            config: Configuration of the run, used in error messages.
            settings: Settings of the driver type, with the maximum current and the endpoint files.
            joint: Joint with its torque limit and torque constant.

        Raises:
            ConfigError: The torque limit needs a higher current than the driver may set.
        """
        are_limits_known = bool(settings.endpoints) or not cls.has_real_bus(settings)
        max_current_a = settings.max_current_a
        if max_current_a is None:
            max_current_a = math.inf if are_limits_known else UNKNOWN_MAX_CURRENT_A
        required_current_a = compute_required_current_a(joint)
        if required_current_a <= max_current_a * (1 + RELATIVE_TOLERANCE):
            return
        torque_constant_nm_per_a = (
            joint.motor.torque_constant_nm_per_a or EMULATED_CONSTANT_NM_PER_A
        )
        suggestion = "raise `backends.odrive.max_current_a`, if the axis is configured for more"
        if settings.max_current_a is None:
            suggestion = (
                "name the flat_endpoints.json of the axes' firmware in `backends.odrive.endpoints`, so that the driver "
                "reads what each axis is configured for; or set it in `backends.odrive.max_current_a`"
            )
        raise ConfigError(
            f"{make_joint_label(config, joint)}: its `torque_nm` of {joint.limits.torque_nm:g} N·m needs "
            f"{required_current_a:.4g} A at {torque_constant_nm_per_a:g} N·m/A, and the driver sets no more than "
            f"{max_current_a:g} A: {suggestion}; or lower `torque_nm`",
            code="drive/unsupported-setting",
        )

    @classmethod
    def check_drives(
        cls, config: RunConfig, settings: OdriveSettings, joints: Sequence[Joint]
    ) -> None:
        """Check also the endpoint files that the settings name."""
        read_all_endpoints(settings.endpoints)
        super().check_drives(config, settings, joints)
