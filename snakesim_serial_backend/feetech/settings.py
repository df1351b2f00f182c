"""The settings of a scenario for Feetech servos."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_drivers.kit.drive_settings import DriveSettings

NAME = "feetech"
Baud = Literal[115_200, 128_000, 250_000, 500_000, 1_000_000]
Offset = Annotated[int, Meta(ge=-2047, le=2047)]


class FeetechSettings(DriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.feetech]` section. The servos have no watchdog."""

    watchdog_s: Annotated[float, Meta(ge=0.02, le=1, extra_json_schema={"unit": "s"})] = 0.1
    """Pause of the driver after which it switches its servos off once it runs again. The servos have no watchdog."""

    accept_no_watchdog: bool = False
    """True: real servos are driven, although each holds its last angle with torque on if the host dies."""

    ports: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=255)]], Meta(max_length=8)
    ] = []
    """Serial ports, such as /dev/ttyACM0; empty: emulated servos in this process."""

    baud: Baud = 1_000_000
    """Baud rate that the servos are set to."""

    model: str = ""
    """Model of all servos, such as STS3215 or `model 1234`; empty: any model that the driver knows."""

    stall_torque_nm: (
        Annotated[float, Meta(gt=0, le=100, extra_json_schema={"unit": "N·m"})] | None
    ) = None
    """Stall torque of a servo at its supply voltage, which scales its torque limit; none: only for emulated servos."""

    speed_unit_counts_s: Annotated[float, Meta(gt=0, le=100)] = 1.0
    """Counts (1/4096 revolution) per second in a unit of the present speed: 1 or 50, depending on the firmware."""

    homing_offsets: dict[str, Offset] = {}
    """Homing offset (register 31) that the servo of a joint must have, by the joint's name; others are not checked."""

    log: str = ""
    """Text file of all bytes, with times and directions; empty: no file is written."""
