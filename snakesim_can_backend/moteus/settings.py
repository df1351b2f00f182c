"""Settings of the backend `moteus`."""

from typing import Annotated

from msgspec import Meta

from snakesim_can_backend.can_drives.backend import CanDriveSettings


class MoteusSettings(CanDriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.moteus]` section. Every command has `watchdog_s`."""

    data_bit_rate: Annotated[
        int, Meta(ge=10_000, le=8_000_000, extra_json_schema={"unit": "bit/s"})
    ] = 5_000_000
    """Bit rate of the data of a CAN FD frame."""

    kp_nm_per_turn: (
        Annotated[float, Meta(gt=0, le=1e5, extra_json_schema={"unit": "N·m/turn"})] | None
    ) = None
    """Gain `servo.pid_position.kp` of all controllers, as fractions of which the robot file's gains are sent. None:
    emulated controllers have the gain that the robot file needs.
    """

    kd_nm_s_per_turn: (
        Annotated[float, Meta(gt=0, le=1e4, extra_json_schema={"unit": "N·m·s/turn"})] | None
    ) = None
    """Gain `servo.pid_position.kd` of all controllers, as fractions of which the robot file's gains are sent. None:
    emulated controllers have the gain that the robot file needs.
    """

    @property
    def fd_rate(self) -> int | None:
        """Bit rate of the data on CAN FD."""
        return self.data_bit_rate
