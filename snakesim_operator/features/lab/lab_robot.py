"""A robot in the lab file: where it is, what drives it, and through which buses."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.model.files import FileStruct

# A common name of a certificate holds three names, and X.509 allows it 64 characters; hence the limit.
MAX_NAME_LENGTH = 24

Name = Annotated[str, Meta(pattern=f"^[a-z][a-z0-9_]{{0,{MAX_NAME_LENGTH - 1}}}$")]
# An interface of the kernel, or INTERFACE:CHANNEL of python-can.
CanBus = Annotated[str, Meta(pattern=r"^(v?can[0-9]{1,3}|[a-z][a-z0-9_]*:[A-Za-z0-9_./@+-]+)$", max_length=127)]
DeviceFile = Annotated[str, Meta(pattern=r"^/dev/[A-Za-z0-9_./+-]+$", max_length=200)]
# A unit of systemd has the setting in double quotes, so some characters are not allowed.
Setting = Annotated[str, Meta(pattern=r"^[^=\s\"\\$%]+=[^\r\n%\"\\$]+$")]
BitRate = Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})]
DataBitRate = Annotated[int, Meta(ge=10_000, le=8_000_000, extra_json_schema={"unit": "bit/s"})]


class LabRobot(FileStruct, frozen=True, kw_only=True):
    """A robot. Its name in the file is its namespace on the network."""

    machine: Name
    scenario: Annotated[str, Meta(min_length=1, max_length=200, pattern=r"^[A-Za-z0-9_./-]+$")]
    backend: Name = "can"
    set: list[Setting] = []  # further settings, as with `snakesim run --set`
    can: list[CanBus] = []  # buses of its drives; interfaces of the kernel are brought up at every start
    serial: list[DeviceFile] = []  # serial ports of its drives
    buses: dict[Name, list[str]] = {}  # of backend `mixed`: which of the buses above each drive type is on
    bitrate: BitRate = 1_000_000
    data_bitrate: DataBitRate = 5_000_000  # of CAN FD, for moteus
    devices: list[DeviceFile] = []  # further device files that its host opens, such as those of a CAN adapter
    emulated: bool = False  # the host emulates the drives, and nothing real moves
    faults: bool = False  # whether an administrator may inject faults
