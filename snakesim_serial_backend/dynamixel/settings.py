"""The settings of a scenario for Dynamixel servos."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_drivers.kit.drive_settings import DriveSettings

NAME = "dynamixel"
Baud = Literal[9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000]
Current = Annotated[float, Meta(gt=0, le=1, extra_json_schema={"unit": "A"})]


class DynamixelSettings(DriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.dynamixel]` section. `watchdog_s` is written to the servos, in steps of 0.02 s."""

    ports: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=255)]], Meta(max_length=8)
    ] = []
    """Serial ports, such as /dev/ttyUSB0. Empty: emulated servos in this process."""

    baud: Baud = 1_000_000
    """Baud rate that the servos are set to."""

    model: str = ""
    """Model of all servos, such as XM430-W350. Empty: any model that the driver knows."""

    current_unit_a: dict[str, Current] = {}
    """For models that the driver does not know, by model number: current of one unit of the servo's current register.
    """

    write_gains: bool = True
    """True: the gains of position mode are written from the robot file. False: the servos keep theirs."""

    log: str = ""
    """Text file of all bytes, with times and directions. Empty: no file is written."""
