"""The backend `odrive`: ODrive axes, real or emulated."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

from msgspec import Meta

from snakesim_can_backend.can_drives.backend import CanDriveBackend, CanDriveSettings
from snakesim_can_backend.can_drives.traffic import CycleTraffic
from snakesim_can_backend.odrive.axes import (
    EMULATED_CONSTANT_NM_PER_A,
    ROUNDING,
    UNKNOWN_MAX_CURRENT_A,
    Axes,
    needed_current_a,
)
from snakesim_can_backend.odrive.emulator import HEARTBEAT_US, EmulatedOdrive
from snakesim_can_backend.odrive.endpoints import read_all_endpoints
from snakesim_can_backend.odrive.protocol import LAST_NODE
from snakesim_drivers.emulation.mounted import Mounted
from snakesim_drivers.kit.drive_settings import joint_label
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig

Amperes = Annotated[float, Meta(gt=0, le=1000, extra_json_schema={"unit": "A"})]
Seconds = Annotated[float, Meta(ge=0, le=60, extra_json_schema={"unit": "s"})]
TurnsPerSecond = Annotated[float, Meta(gt=0, le=1000, extra_json_schema={"unit": "turns/s"})]


class MountedAxis(Mounted, frozen=True, kw_only=True):
    """How an emulated axis is mounted and configured, where that is not what the robot file needs."""

    current_soft_max_a: Amperes | None = None
    watchdog_timeout_s: Seconds | None = None  # 0: its watchdog is off
    vel_limit_turns_s: TurnsPerSecond | None = None


class OdriveSettings(CanDriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.odrive]` section. `watchdog_s` is what the axes have in `watchdog_timeout`."""

    # Files flat_endpoints.json that ODrive publishes with each firmware: one for each firmware and hardware on the bus.
    # With them the driver reads watchdog, current and speed limits of every axis at the start. Empty: they are unknown.
    endpoints: Annotated[list[Annotated[str, Meta(min_length=1, max_length=4096)]], Meta(max_length=8)] = []
    # The driver never sets a higher current limit. Default: what each axis is configured for; 1 A where it is unknown.
    max_current_a: Amperes | None = None
    mounted: Mapping[str, MountedAxis] = {}  # of emulated axes: joint -> how it is mounted and configured in truth


class OdriveBackend(CanDriveBackend):
    """A `snakesim_hal.backend.Backend` on ODrive axes, real or emulated."""

    Settings = OdriveSettings
    drives_class = Axes
    emulator_class = EmulatedOdrive
    name = "odrive"
    plural_noun = "axes"
    last_id = LAST_NODE
    reserved_ids = "63 is the broadcast address"
    report_period_s = HEARTBEAT_US * 1e-6
    traffic = CycleTraffic(
        each_drive=(0, 0, 8, 8, 8),  # two requests, two answers and an input
        one_drive=(0, 0, 0, 0, 8, 8, 8, 8),  # four requests and their answers
        heartbeats_hz=1e6 / HEARTBEAT_US,
    )

    @classmethod
    def check_joint(cls, config: RunConfig, settings: OdriveSettings, joint: Joint) -> None:
        """Check that an axis suits a joint.

        Raises:
            ConfigError: it does not.
        """
        where = joint_label(config, joint)
        if joint.motor.damping_nm_s_per_rad <= 0:
            raise ConfigError(f"{where}: `damping_nm_s_per_rad` must be above 0: an ODrive's position loop needs it")
        if joint.motor.torque_constant_nm_per_a is None and cls.has_real_bus(settings):
            raise ConfigError(
                f"{where}: `torque_constant_nm_per_a` is not given, and ODrives measure and limit amperes: take it "
                f"from the motor's data sheet (8.27 / KV), as `axis0.config.motor.torque_constant` has it"
            )
        cls.check_current(config, settings, joint)

    @classmethod
    def check_current(cls, config: RunConfig, settings: OdriveSettings, joint: Joint) -> None:
        """Check that a joint needs no more current than the driver may set.

        Raises:
            ConfigError: it needs more.
        """
        limits_are_read = bool(settings.endpoints) or not cls.has_real_bus(settings)
        allowed_a = settings.max_current_a
        if allowed_a is None:
            allowed_a = math.inf if limits_are_read else UNKNOWN_MAX_CURRENT_A
        needed_a = needed_current_a(joint)
        if needed_a <= allowed_a * (1 + ROUNDING):
            return
        constant = joint.motor.torque_constant_nm_per_a or EMULATED_CONSTANT_NM_PER_A
        fix = "raise `backends.odrive.max_current_a`, if the axis is configured for more"
        if settings.max_current_a is None:
            fix = (
                "name the flat_endpoints.json of the axes' firmware in `backends.odrive.endpoints`, so that the driver "
                "reads what each axis is configured for; or say it in `backends.odrive.max_current_a`"
            )
        raise ConfigError(
            f"{joint_label(config, joint)}: its `torque_nm` of {joint.limits.torque_nm:g} N·m needs {needed_a:.4g} A "
            f"at {constant:g} N·m/A, and the driver sets no more than {allowed_a:g} A: {fix}; or lower `torque_nm`"
        )

    @classmethod
    def check_drives(cls, config: RunConfig, settings: OdriveSettings, joints: Sequence[Joint]) -> None:
        """Check also the endpoint files that the settings name."""
        read_all_endpoints(settings.endpoints)
        super().check_drives(config, settings, joints)
