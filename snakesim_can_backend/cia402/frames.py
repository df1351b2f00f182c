"""Frames of CANopen (CiA 301) as bytes: NMT, SYNC, heartbeats, emergency messages and expedited SDO transfers.

The id of a frame is a function code and a node. Only expedited transfers are supported, which carry up to four bytes:
every object that the driver uses fits.
"""

from dataclasses import dataclass
from enum import IntEnum
from struct import Struct

from snakesim_can_backend.cia402.objects import ObjectEntry
from snakesim_can_backend.protocol.definitions import CanFrame

FIRST_NODE = 1
LAST_NODE = 127
NODE_MASK = 0x7F

SYNC_ID = 0x080


class FunctionCode(IntEnum):
    """Function codes: the id of a frame without its node."""

    NMT = 0x000
    EMERGENCY = 0x080
    TIME = 0x100
    TRANSMIT_PDO_1 = 0x180  # transmit PDOs are sent by drives
    RECEIVE_PDO_1 = 0x200
    TRANSMIT_PDO_2 = 0x280
    RECEIVE_PDO_2 = 0x300
    TRANSMIT_PDO_3 = 0x380
    RECEIVE_PDO_3 = 0x400
    TRANSMIT_PDO_4 = 0x480
    RECEIVE_PDO_4 = 0x500
    SDO_RESPONSE = 0x580
    SDO_REQUEST = 0x600
    HEARTBEAT = 0x700


TRANSMIT_PDOS = (
    FunctionCode.TRANSMIT_PDO_1,
    FunctionCode.TRANSMIT_PDO_2,
    FunctionCode.TRANSMIT_PDO_3,
    FunctionCode.TRANSMIT_PDO_4,
)
RECEIVE_PDOS = (
    FunctionCode.RECEIVE_PDO_1,
    FunctionCode.RECEIVE_PDO_2,
    FunctionCode.RECEIVE_PDO_3,
    FunctionCode.RECEIVE_PDO_4,
)


class NmtCommand(IntEnum):
    """Commands of network management."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States of network management, as heartbeats report them."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


# SDO: kinds of frames, the upper three bits of the first byte.
DOWNLOAD_REQUEST = 1  # write
UPLOAD_REQUEST = 2  # read
UPLOAD_RESPONSE = 2
DOWNLOAD_RESPONSE = 3
ABORT = 4
EXPEDITED_WITH_SIZE = 0x03  # flags of a transfer in one frame
SDO_HEADER = Struct("<BHB")  # kind and flags, index, subindex
ABORT_CODE = Struct("<I")
EMERGENCY_LAYOUT = Struct("<HB5s")  # error code, error register, vendor's data

ABORTS = {
    0x0504_0001: "unknown SDO command",
    0x0601_0000: "the access is not supported",
    0x0601_0001: "the object cannot be read",
    0x0601_0002: "the object cannot be written",
    0x0602_0000: "the object does not exist",
    0x0604_0041: "the object cannot be mapped",
    0x0604_0042: "the mapped objects are longer than a PDO",
    0x0607_0010: "the length is wrong",
    0x0609_0011: "the subindex does not exist",
    0x0609_0030: "the value is out of range",
    0x0609_0031: "the value is too high",
    0x0609_0032: "the value is too low",
    0x0800_0000: "general error",
    0x0800_0020: "the value cannot be stored",
    0x0800_0021: "local control does not allow it",
    0x0800_0022: "the state of the device does not allow it",
}
# Codes of objects that a device does not have.
MISSING_OBJECT_ABORT_CODES = 0x0602_0000, 0x0609_0011
ERROR_CLASSES = (  # by the high byte of an error code; the first one that fits
    (0xFF, 0x81, "communication"),
    (0xFF, 0x82, "protocol"),
    (0xF0, 0x10, "generic error"),
    (0xF0, 0x20, "current"),
    (0xF0, 0x30, "voltage"),
    (0xF0, 0x40, "temperature"),
    (0xF0, 0x50, "hardware"),
    (0xF0, 0x60, "software"),
    (0xF0, 0x70, "additional modules"),
    (0xF0, 0x80, "monitoring"),
    (0xF0, 0x90, "external error"),
    (0xFF, 0xF0, "additional functions"),
    (0xFF, 0xFF, "device specific"),
)
HEARTBEAT_LOST = 0x8130
ERROR_NAMES = {
    0x8110: "CAN overrun",
    0x8120: "CAN error passive",
    HEARTBEAT_LOST: "no heartbeat of the host: its watchdog expired",
    0x8140: "recovered from bus-off",
    0x8210: "PDO not processed: wrong length",
    0x8220: "PDO too long",
}
REGISTER_BITS = (
    *(
        "generic",
        "current",
        "voltage",
        "temperature",
        "communication",
        "device profile",
        "reserved",
        "manufacturer",
    ),
)


@dataclass(frozen=True)
class SdoFrame:
    """A request or an answer of a transfer."""

    kind: int
    index: int
    sub: int
    data: bytes = b""  # of a value; empty in a request to read and in the answer to a write
    abort: int = 0  # code; 0: it is no abort


@dataclass(frozen=True)
class EmergencyMessage:
    """An emergency message (EMCY)."""

    code: int  # 0: the error is gone
    register: int


def split_id(frame: CanFrame) -> tuple[int, int]:
    """Return the function code and the node of a frame."""
    return frame.id & ~NODE_MASK, frame.id & NODE_MASK


def encode_nmt(command: NmtCommand, node_id: int) -> CanFrame:
    """Return an NMT command to a node; node 0 means all."""
    return CanFrame(FunctionCode.NMT, bytes([command, node_id]))


def encode_heartbeat(node_id: int, state: NmtState) -> CanFrame:
    """Return a heartbeat; with the state `BOOT_UP` it is the boot-up message."""
    return CanFrame(FunctionCode.HEARTBEAT | node_id, bytes([state]))


def encode_emergency(node_id: int, emergency: EmergencyMessage) -> CanFrame:
    """Return an emergency message."""
    return CanFrame(
        FunctionCode.EMERGENCY | node_id,
        EMERGENCY_LAYOUT.pack(emergency.code, emergency.register, b""),
    )


def decode_emergency(data: bytes) -> EmergencyMessage:
    """Return an emergency message. Raises struct.error if its length is wrong."""
    code, register, _ = EMERGENCY_LAYOUT.unpack(data)
    return EmergencyMessage(code, register)


def encode_read(entry: ObjectEntry) -> bytes:
    """Return the request to read an entry."""
    return SDO_HEADER.pack(UPLOAD_REQUEST << 5, entry.index, entry.sub).ljust(8, b"\0")


def encode_write(entry: ObjectEntry, value: int) -> bytes:
    """Return the request to write an entry. Raises struct.error if the value does not fit."""
    return _encode_expedited(DOWNLOAD_REQUEST, entry.index, entry.sub, entry.encode(value))


def encode_read_response(index: int, sub: int, data: bytes) -> bytes:
    """Return the answer with a value of one to four bytes."""
    return _encode_expedited(UPLOAD_RESPONSE, index, sub, data)


def encode_write_response(index: int, sub: int) -> bytes:
    """Return the answer that confirms a write."""
    return SDO_HEADER.pack(DOWNLOAD_RESPONSE << 5, index, sub).ljust(8, b"\0")


def encode_abort(index: int, sub: int, code: int) -> bytes:
    """Return the answer that refuses a transfer."""
    return SDO_HEADER.pack(ABORT << 5, index, sub) + ABORT_CODE.pack(code)


def decode_sdo(data: bytes) -> SdoFrame:
    """Decode the data of an SDO request or response.

    Raises:
        ValueError, struct.error: The frame is malformed, or starts a transfer of more than four bytes with its size
            unknown.
    """
    if len(data) != 8:
        raise ValueError(f"an SDO frame of {len(data)} bytes")
    header, index, sub = SDO_HEADER.unpack_from(data)
    kind = header >> 5
    if kind == ABORT:
        (code,) = ABORT_CODE.unpack_from(data, SDO_HEADER.size)
        return SdoFrame(kind, index, sub, abort=code)
    if not header & EXPEDITED_WITH_SIZE:  # no value, or a transfer of several frames
        return SdoFrame(kind, index, sub)
    if header & EXPEDITED_WITH_SIZE != EXPEDITED_WITH_SIZE:
        raise ValueError(f"an SDO frame 0x{header:02X} without a size in one frame")
    length = 4 - (header >> 2 & 0x03)
    return SdoFrame(kind, index, sub, data[SDO_HEADER.size : SDO_HEADER.size + length])


def describe_abort(code: int) -> str:
    """Return an abort code in words."""
    return f"abort 0x{code:08X}, {ABORTS.get(code, 'see its manual')}"


def describe_error(code: int) -> str:
    """Return an error code, of 603Fh or of an emergency message, in words."""
    high = code >> 8
    for mask, value, name in ERROR_CLASSES:
        if high & mask == value:
            detail = ERROR_NAMES.get(code, "see its manual")
            return f"error 0x{code:04X}, {name}: {detail}"
    return f"error 0x{code:04X}: see its manual"


def describe_register(register: int) -> str:
    """Return the error register 1001h in words."""
    names = [name for bit, name in enumerate(REGISTER_BITS) if register >> bit & 1]
    return f"error register 0x{register:02X}: {', '.join(names) or 'no error'}"


def _encode_expedited(kind: int, index: int, sub: int, data: bytes) -> bytes:
    unused = 4 - len(data)
    header = kind << 5 | unused << 2 | EXPEDITED_WITH_SIZE
    return SDO_HEADER.pack(header, index, sub) + data.ljust(4, b"\0")
