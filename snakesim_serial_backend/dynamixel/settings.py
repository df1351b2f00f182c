"""What the scenario may say about Dynamixel servos."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_drivers.kit.drive_settings import DriveSettings

NAME = "dynamixel"
Baud = Literal[9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000]
Current = Annotated[float, Meta(gt=0, le=1, extra_json_schema={"unit": "A"})]


class DynamixelSettings(DriveSettings, frozen=True, kw_only=True):
    """The scenario's `[backends.dynamixel]` section. `watchdog_s` is written to the servos, in steps of 0.02 s."""

    # Serial ports, such as /dev/ttyUSB0. Empty: emulated servos, here.
    ports: Annotated[list[Annotated[str, Meta(min_length=1, max_length=255)]], Meta(max_length=8)] = []
    baud: Baud = 1_000_000  # that the servos are set to
    model: str = ""  # that all are, such as XM430-W350; empty: any that is known
    current_unit_a: dict[str, Current] = {}  # model number -> A a unit of current, of models that are not known
    write_gains: bool = True  # of the position law, from the robot file; false: they keep their own
    log: str = ""  # text file of all bytes, with times and directions; empty: none
