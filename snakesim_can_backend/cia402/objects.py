"""The objects of CiA 301 and CiA 402 that the driver uses, and the PDOs that carry some of them.

Indices, types and units are those that CANopen's public libraries and the EDS files of several vendors agree on.
Temperatures are no objects of the profile: the settings name them.
"""

import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Literal


@dataclass(frozen=True)
class ObjectEntry:
    """One entry of an object dictionary."""

    index: int
    sub: int
    format: str  # of the value, as in the module `struct`, little-endian
    name: str

    @property
    def address(self) -> str:
        """The index and the subindex as CiA writes them, such as 607Dh:1."""
        if self.sub:
            return f"{self.index:04X}h:{self.sub}"
        return f"{self.index:04X}h"

    @property
    def size(self) -> int:
        """Bytes of the value."""
        return struct.calcsize("<" + self.format)

    def encode(self, value: int) -> bytes:
        """Return a value as bytes. Raises struct.error if it does not fit."""
        return struct.pack("<" + self.format, value)

    def decode(self, data: bytes) -> int:
        """Return the value of some bytes. Raises struct.error if there are too few or too many."""
        (value,) = struct.unpack("<" + self.format, data)
        return value


# Communication, CiA 301.
# Its low 16 bits are the number of the profile.
DEVICE_TYPE = ObjectEntry(0x1000, 0, "I", "device type")
VENDOR_ID = ObjectEntry(0x1018, 1, "I", "vendor")
PRODUCT_CODE = ObjectEntry(0x1018, 2, "I", "product code")
REVISION = ObjectEntry(0x1018, 3, "I", "revision")  # major and minor number, 16 bits each
SERIAL = ObjectEntry(0x1018, 4, "I", "serial number")
CONSUMER_HEARTBEAT = ObjectEntry(0x1016, 1, "I", "consumer heartbeat time")  # node << 16 | ms
PRODUCER_HEARTBEAT = ObjectEntry(0x1017, 0, "H", "producer heartbeat time")  # ms
ERROR_BEHAVIOR = ObjectEntry(0x1029, 1, "B", "error behavior")  # 1: no change of the NMT state
ERROR_REGISTER = ObjectEntry(0x1001, 0, "B", "error register")

# The state machine, CiA 402.
# 1: fault.
ABORT_CONNECTION_OPTION_CODE = ObjectEntry(0x6007, 0, "h", "abort connection option code")
ERROR_CODE = ObjectEntry(0x603F, 0, "H", "error code")
CONTROLWORD = ObjectEntry(0x6040, 0, "H", "controlword")
STATUSWORD = ObjectEntry(0x6041, 0, "H", "statusword")
# 0: off, 2: quick stop ramp, then off.
QUICK_STOP_OPTION = ObjectEntry(0x605A, 0, "h", "quick stop option code")
FAULT_REACTION = ObjectEntry(0x605E, 0, "h", "fault reaction option code")  # 0: off
MODE = ObjectEntry(0x6060, 0, "b", "modes of operation")
MODE_DISPLAY = ObjectEntry(0x6061, 0, "b", "modes of operation display")
SUPPORTED_MODES = ObjectEntry(0x6502, 0, "I", "supported drive modes")

# Motion.
POSITION = ObjectEntry(0x6064, 0, "i", "position actual value")  # position units
VELOCITY = ObjectEntry(0x606C, 0, "i", "velocity actual value")  # velocity units
TARGET_TORQUE = ObjectEntry(0x6071, 0, "h", "target torque")  # 0.1 % of the rated torque
MAX_TORQUE = ObjectEntry(0x6072, 0, "H", "max torque")  # 0.1 % of the rated torque
RATED_CURRENT = ObjectEntry(0x6075, 0, "I", "motor rated current")  # mA
RATED_TORQUE = ObjectEntry(0x6076, 0, "I", "motor rated torque")  # mN·m
TORQUE = ObjectEntry(0x6077, 0, "h", "torque actual value")  # 0.1 % of the rated torque
CURRENT = ObjectEntry(0x6078, 0, "h", "current actual value")  # 0.1 % of the rated current
VOLTAGE = ObjectEntry(0x6079, 0, "I", "DC link circuit voltage")  # mV
TARGET_POSITION = ObjectEntry(0x607A, 0, "i", "target position")  # position units
MIN_POSITION = ObjectEntry(0x607D, 1, "i", "min software position limit")  # position units
MAX_POSITION = ObjectEntry(0x607D, 2, "i", "max software position limit")  # position units
MAX_SPEED = ObjectEntry(0x6080, 0, "I", "max motor speed")  # rpm, where the vendor does not differ
ENCODER_INCREMENTS = ObjectEntry(0x608F, 1, "I", "encoder increments")
ENCODER_REVOLUTIONS = ObjectEntry(0x608F, 2, "I", "motor revolutions")
CYCLE_VALUE = ObjectEntry(0x60C2, 1, "B", "interpolation time period value")
CYCLE_INDEX = ObjectEntry(0x60C2, 2, "b", "interpolation time index")  # exponent of 10, in seconds
TARGET_VELOCITY = ObjectEntry(0x60FF, 0, "i", "target velocity")  # velocity units

DS402 = 402  # the number of the profile in `DEVICE_TYPE`
SYNCHRONOUS = 1  # transmission type: with every SYNC
EVENT_DRIVEN = 255  # transmission type: a receive PDO takes effect at once
PDO_OFF = 0x8000_0000  # bit of a COB-ID: the PDO is not used
# Bits of a COB-ID that are compared: bit 30 forbids remote requests only.
COB_ID_MASK = PDO_OFF | 0x7FF
PDO_BASES = {"receive": (0x200, 0x300, 0x400, 0x500), "transmit": (0x180, 0x280, 0x380, 0x480)}


@dataclass(frozen=True)
class Pdo:
    """A process data object: which entries one frame carries."""

    direction: Literal["receive", "transmit"]  # as the drive sees it
    number: int  # 1 to 4
    entries: tuple[ObjectEntry, ...]

    @property
    def base(self) -> int:
        """The id of its frames without the node."""
        return PDO_BASES[self.direction][self.number - 1]

    @property
    def transmission_type(self) -> int:
        """When a drive sends it, or when its values take effect.

        Receive PDOs take effect at once: a stop must not wait for a SYNC that may not come.
        """
        return SYNCHRONOUS if self.direction == "transmit" else EVENT_DRIVEN

    @cached_property
    def layout(self) -> struct.Struct:
        """The values as bytes."""
        return struct.Struct("<" + "".join(entry.format for entry in self.entries))

    def cob_id_entry(self) -> ObjectEntry:
        """Return the entry with the id of its frames."""
        return ObjectEntry(
            self._communication_index, 1, "I", f"COB-ID of the {self.direction} PDO {self.number}"
        )

    def transmission_entry(self) -> ObjectEntry:
        """Return the entry with its transmission type."""
        return ObjectEntry(
            self._communication_index,
            2,
            "B",
            f"transmission type of the {self.direction} PDO {self.number}",
        )

    def mapping_entry(self, sub: int) -> ObjectEntry:
        """Return an entry of its mapping. sub: 0 for the number of entries, and from 1 on the entries."""
        format_ = "I" if sub else "B"
        return ObjectEntry(
            self._mapping_index, sub, format_, f"mapping of the {self.direction} PDO {self.number}"
        )

    @property
    def _communication_index(self) -> int:
        first = 0x1400 if self.direction == "receive" else 0x1800
        return first + self.number - 1

    @property
    def _mapping_index(self) -> int:
        first = 0x1600 if self.direction == "receive" else 0x1A00
        return first + self.number - 1


def encode_mapping(entry: ObjectEntry) -> int:
    """Return an entry as a PDO mapping names it: index, subindex, length in bits."""
    return entry.index << 16 | entry.sub << 8 | 8 * entry.size


# One receive PDO for each mode: a setpoint is one frame.
POSITION_PDO = Pdo("receive", 1, (CONTROLWORD, TARGET_POSITION, MAX_TORQUE))
VELOCITY_PDO = Pdo("receive", 2, (CONTROLWORD, TARGET_VELOCITY, MAX_TORQUE))
TORQUE_PDO = Pdo("receive", 3, (CONTROLWORD, TARGET_TORQUE, MAX_TORQUE))
MODE_PDO = Pdo("receive", 4, (MODE,))
STATE_PDO = Pdo("transmit", 1, (STATUSWORD, POSITION, TORQUE))
MOTION_PDO = Pdo("transmit", 2, (VELOCITY, MODE_DISPLAY, ERROR_CODE))
PDOS = (POSITION_PDO, VELOCITY_PDO, TORQUE_PDO, MODE_PDO, STATE_PDO, MOTION_PDO)
UNUSED_PDOS = (Pdo("transmit", 3, ()), Pdo("transmit", 4, ()))  # they would only load the bus
