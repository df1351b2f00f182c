"""A robot in the lab file: where it is, what drives it, and through which buses."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.model.files import FileStruct

# A common name of a certificate holds three names, and X.509 allows it 64 characters; hence the limit.
MAX_NAME_LENGTH = 24

Name = Annotated[str, Meta(pattern=f"^[a-z][a-z0-9_]{{0,{MAX_NAME_LENGTH - 1}}}$")]
# An interface of the kernel, INTERFACE:CHANNEL of python-can, or local:FOLDER.
CanBus = Annotated[
    str, Meta(pattern=r"^(v?can[0-9]{1,3}|[a-z][a-z0-9_]*:[A-Za-z0-9_./@+-]+)$", max_length=127)
]
DeviceFile = Annotated[str, Meta(pattern=r"^/dev/[A-Za-z0-9_./+-]+$", max_length=200)]
# A unit of systemd has the setting in double quotes, so some characters are not allowed.
Setting = Annotated[str, Meta(pattern=r"^[^=\s\"\\$%]+=[^\r\n%\"\\$]+$")]
BitRate = Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})]
DataBitRate = Annotated[int, Meta(ge=10_000, le=8_000_000, extra_json_schema={"unit": "bit/s"})]


class LabRobot(FileStruct, frozen=True, kw_only=True):
    """A robot. Its name in the file is its namespace on the network."""

    machine: Name
    """Machine that the robot's host runs on."""

    scenario: Annotated[str, Meta(min_length=1, max_length=200, pattern=r"^[A-Za-z0-9_./-]+$")]
    """Scenario of its runs: the name of a shipped one, or a path on the machine."""

    backend: Name = "can"
    """Backend that drives the robot."""

    set: list[Setting] = []
    """Further values as KEY=VALUE, as with `snakesim run --set`."""

    can: list[CanBus] = []
    """CAN buses of its drives: interfaces of the kernel, which are brought up at every start, or INTERFACE:CHANNEL of
    python-can.
    """

    serial: list[DeviceFile] = []
    """Serial ports of its drives."""

    buses: dict[Name, list[str]] = {}
    """For the backend `mixed`: for each driver type, those of the buses in `can` and `serial` that it is on."""

    bitrate: BitRate = 1_000_000
    """Bit rate of its CAN buses."""

    data_bitrate: DataBitRate = 5_000_000
    """Bit rate of the data on CAN FD, for moteus."""

    devices: list[DeviceFile] = []
    """Further device files that its host opens, such as those of a CAN adapter."""

    emulated: bool = False
    """True: the host emulates the drives, and no real motor moves."""

    faults: bool = False
    """True: an administrator may inject faults."""
