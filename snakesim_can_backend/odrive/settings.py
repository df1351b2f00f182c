"""Settings of the backend `odrive`."""

from collections.abc import Mapping
from typing import Annotated

from msgspec import Meta

from snakesim_can_backend.can_drives.backend import CanDriveSettings
from snakesim_drivers.emulation.mounted import MountedDrive

Amperes = Annotated[float, Meta(gt=0, le=1000, extra_json_schema={"unit": "A"})]
Seconds = Annotated[float, Meta(ge=0, le=60, extra_json_schema={"unit": "s"})]
TurnsPerSecond = Annotated[float, Meta(gt=0, le=1000, extra_json_schema={"unit": "turns/s"})]


class MountedAxis(MountedDrive, frozen=True, kw_only=True):
    """How an emulated axis is mounted and configured, where that is not what the robot file needs."""

    current_soft_max_a: Amperes | None = None
    """Current limit that the emulated axis is configured with. None: what the robot file needs."""

    watchdog_timeout_s: Seconds | None = None
    """Time of the axis's watchdog. 0: it is off. None: `watchdog_s` of the backend."""

    vel_limit_turns_s: TurnsPerSecond | None = None
    """Speed limit that the emulated axis is configured with. None: what the robot file needs."""


class OdriveSettings(CanDriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.odrive]` section. `watchdog_s` is what the axes have in `watchdog_timeout`."""

    endpoints: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=4096)]], Meta(max_length=8)
    ] = []
    """Files flat_endpoints.json, which ODrive publishes with each firmware: one for each firmware on the bus.

    With them the driver reads watchdog, current and speed limits of every axis at the start. Empty: they are unknown.
    """

    max_current_a: Amperes | None = None
    """Current limit above which the driver never sets an axis. None: what each axis is configured for, or 1 A where
    that is unknown.
    """

    mounted: Mapping[str, MountedAxis] = {}
    """For joints of emulated axes, how each is really mounted and configured."""
