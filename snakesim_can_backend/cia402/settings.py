"""Settings of the backend `cia402`."""

from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

from snakesim_can_backend.can_drives.backend import CanDriveSettings
from snakesim_drivers.emulation.mounted import MountedDrive

Units = Annotated[float, Meta(gt=0, le=1e9, extra_json_schema={"unit": "1/turn"})]
SpeedUnits = Annotated[float, Meta(gt=0, le=1e9, extra_json_schema={"unit": "1/(turn/s)"})]
RatedTorque = Annotated[float, Meta(gt=0, le=1e4, extra_json_schema={"unit": "N·m"})]
Temperature = Annotated[str, Meta(pattern="^[0-9A-Fa-f]{4}:[0-9]{1,3}$")]
Counts = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]


class MountedCia402(MountedDrive, frozen=True, kw_only=True):
    """How an emulated drive is mounted and configured, where that is not what the robot file needs."""

    max_torque_nm: RatedTorque | None = None
    """Torque limit (6072h) of the emulated drive at its shaft; none: what the robot file needs."""

    max_speed_rad_s: (
        Annotated[float, Meta(gt=0, le=1e5, extra_json_schema={"unit": "rad/s"})] | None
    ) = None
    """Speed limit (6080h) of the emulated drive at its shaft; none: what the robot file needs."""

    min_position: Counts | None = None
    """Lower position limit (607Dh:1) of the emulated drive in position units; none: a little beyond the joint's."""

    max_position: Counts | None = None
    """Upper position limit (607Dh:2) of the emulated drive in position units; none: a little beyond the joint's."""


class Cia402Settings(CanDriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.cia402]` section. `watchdog_s` is written to the drives (1016h)."""

    host_id: Annotated[int, Meta(ge=1, le=127)] = 127
    """Node id of the host, with which it sends heartbeats. No drive may have it."""

    eds: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=4096)]], Meta(max_length=8)
    ] = []
    """EDS files of the drives, one for each type on the bus, by which objects are checked before anything is written.

    Emulated drives have the objects of the first file. Empty: real drives are not checked, and emulated drives have the
    objects of the EDS file that is part of this package.
    """

    counts_per_turn: Units | None = None
    """Position units (of 6064h and 607Ah) for one turn of the drive's shaft; none: each drive's own encoder resolution
    (608Fh).
    """

    velocity_units_per_turn_s: SpeedUnits | None = None
    """Velocity units (of 606Ch and 60FFh) for one turn/s of the drive's shaft, such as 60 for rpm; none: position units
    per second.
    """

    max_speed_units_per_turn_s: SpeedUnits = 60.0
    """Units of the maximum speed (6080h) for one turn/s. The profile has rpm, which is 60."""

    rated_torque_nm: RatedTorque | None = None
    """Torque of which torques of the drive are thousandths; none: the drive's own rated torque (6076h), or else its
    rated current (6075h) times the torque constant in the robot file.
    """

    heartbeat_s: Annotated[float, Meta(ge=0.01, le=5, extra_json_schema={"unit": "s"})] = 0.1
    """Period of the drives' heartbeats, which is written to them (1017h)."""

    quick_stop: Literal["torque_off", "ramp"] = "torque_off"
    """What a drive does in an emergency stop (605Ah): `torque_off` at once, or brake on its quick stop `ramp` first."""

    allow_unverified_watchdog: bool = False
    """Whether to use drives without an abort connection option code (6007h): the driver then does not know whether a
    drive stops when the host is silent.
    """

    motor_temperature: Temperature | None = None
    """Vendor's object with the temperature of the motor, as INDEX:SUBINDEX, such as "2031:1"; none: it is unknown.
    The profile has no such object.
    """

    board_temperature: Temperature | None = None
    """Vendor's object with the temperature of the electronics, as INDEX:SUBINDEX; none: that of `motor_temperature`."""

    temperature_unit_c: Annotated[float, Meta(gt=0, le=1000, extra_json_schema={"unit": "°C"})] = (
        0.1
    )
    """Unit of both temperatures, which are whole numbers of 16 bits with a sign."""

    mounted: Mapping[str, MountedCia402] = {}
    """For joints of emulated drives, how each is really mounted and configured."""
