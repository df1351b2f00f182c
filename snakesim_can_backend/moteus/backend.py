"""The backend `moteus`, and `snakesim moteus`, which emulates controllers as a process."""

from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from snakesim_can_backend.can_drives.backend import CanDriveBackend, CanDriveSettings
from snakesim_can_backend.can_drives.command import run
from snakesim_can_backend.can_drives.traffic import CycleTraffic
from snakesim_can_backend.moteus.controllers import Controllers, configured_gains, needed_gains
from snakesim_can_backend.moteus.emulator import EmulatedMoteus
from snakesim_can_backend.moteus.protocol import BROADCAST_ID, HOST_ID, LAST_ID
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig

ROUNDING = 1.001  # of gains that a person has copied


class MoteusSettings(CanDriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.moteus]` section. `watchdog_s` goes into every command."""

    data_bit_rate: Annotated[int, Meta(ge=10_000, le=8_000_000, extra_json_schema={"unit": "bit/s"})] = 5_000_000
    # What all controllers have in `servo.pid_position.kp` and `.kd`; the robot file's gains are sent as shares of them.
    # Emulated ones have by default what the robot needs.
    kp_nm_per_turn: Annotated[float, Meta(gt=0, le=1e5, extra_json_schema={"unit": "N·m/turn"})] | None = None
    kd_nm_s_per_turn: Annotated[float, Meta(gt=0, le=1e4, extra_json_schema={"unit": "N·m·s/turn"})] | None = None

    @property
    def fd_rate(self) -> int | None:
        """CAN FD."""
        return self.data_bit_rate


class MoteusBackend(CanDriveBackend):
    """A `snakesim_hal.backend.Backend` on moteus controllers, real or emulated."""

    Settings, drives, emulator = MoteusSettings, Controllers, EmulatedMoteus
    name, a_drive, first_id, last_id = "moteus", "controllers", HOST_ID + 1, LAST_ID
    reserved_ids = f"{HOST_ID} is the host's, {BROADCAST_ID} the broadcast address"
    says_every_s = 0.05  # it says so whenever it is asked; but it takes a while to get ready
    # Question, answer and command; of one controller two questions more: its health, and its serial number.
    traffic = CycleTraffic((5, 24, 48), (6, 24, 3, 16))

    @classmethod
    def check_drives(cls, config: RunConfig, settings: MoteusSettings, joints: Sequence[Joint]) -> None:
        """And gains that all controllers have alike."""
        super().check_drives(config, settings, joints)
        most, have = needed_gains(joints), configured_gains(joints, settings)
        named = settings.kp_nm_per_turn is not None and settings.kd_nm_s_per_turn is not None
        if (cls.real(settings) and not named) or any(a > b * ROUNDING for a, b in zip(most, have, strict=True)):
            raise ConfigError(
                f"robot {config.robot.name!r} needs `servo.pid_position.kp` from {most[0]:.4g} N·m/turn on, and `.kd` "
                f"from {most[1]:.4g} N·m·s/turn: configure all controllers alike, and say what they have in "
                f"`backends.moteus.kp_nm_per_turn` and `kd_nm_s_per_turn`"
            )


def main(argv: Sequence[str] | None = None) -> int:
    """`snakesim moteus`."""
    return run(MoteusBackend, "moteus", argv)
