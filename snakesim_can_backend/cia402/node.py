"""An emulated CANopen node: its object dictionary from an EDS, its SDO server, its PDOs and its NMT state. Pure.

It supports expedited transfers only. What its objects do is in `emulator`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from snakesim_can_backend.cia402.eds import READABLE, WRITABLE, EdsFile, EdsObject
from snakesim_can_backend.cia402.frames import (
    DOWNLOAD_REQUEST,
    UPLOAD_REQUEST,
    NmtCommand,
    NmtState,
    SdoFrame,
    encode_abort,
    encode_read_response,
    encode_write_response,
)
from snakesim_can_backend.cia402.objects import PDO_OFF

UNKNOWN_COMMAND = 0x0504_0001  # abort codes
NOT_READABLE = 0x0601_0001
NOT_WRITABLE = 0x0601_0002
NO_OBJECT = 0x0602_0000
NOT_MAPPABLE = 0x0604_0041
TOO_LONG_TO_MAP = 0x0604_0042
WRONG_LENGTH = 0x0607_0010
NO_SUBINDEX = 0x0609_0011
NOT_EXPEDITED = 0x0800_0000
WRONG_STATE = 0x0800_0022
MAX_PDO_BYTES = 8
LAST_SYNCHRONOUS_TYPE = 240  # transmission types from 1 to this one: the PDO is sent after a SYNC
CAN_ID_MASK = 0x7FF  # the bits of a COB-ID that are the id of the frame

# Subindices of the communication parameters of a PDO.
COB_ID_SUB = 1
TRANSMISSION_TYPE_SUB = 2

# Indices in the object dictionary.
# That a reset of the communication sets to their defaults.
COMMUNICATION_OBJECTS = range(0x1000, 0x2000)
RECEIVE_COMMUNICATION = range(0x1400, 0x1600)
RECEIVE_MAPPING = range(0x1600, 0x1800)
TRANSMIT_COMMUNICATION = range(0x1800, 0x1A00)
TRANSMIT_MAPPING = range(0x1A00, 0x1C00)
MAPPING_OFFSET = 0x200  # from the communication parameters of a PDO to its mapping

Address = tuple[int, int]  # index and subindex


class SdoAbortError(Exception):
    """A transfer that a node refuses."""

    def __init__(self, code: int) -> None:
        super().__init__(f"0x{code:08X}")
        self.code = code


@dataclass
class Cia402Node:
    """One node. Values are whole numbers without a sign, as they are sent."""

    eds: EdsFile
    node_id: int
    on_write: Callable[[Address, int], None]  # gets every value that a host has written
    # Returns a value that changes by itself; None: the stored one counts.
    compute_live_value: Callable[[Address], int | None]
    nmt_state: NmtState = NmtState.PRE_OPERATIONAL
    values: dict[Address, int] = field(default_factory=dict[Address, int])

    def __post_init__(self) -> None:
        """Set every object to its default."""
        for address, description in self.eds.objects.items():
            self.values[address] = description.default_value(self.node_id)

    # --- values -----------------------------------------------------------------------------------------------

    def get(self, address: Address) -> int:
        """Return the current value of an object, without a sign; 0 if the object does not exist."""
        live = self.compute_live_value(address)
        if live is None:
            return self.values.get(address, 0)
        description = self.eds.objects.get(address)
        bits = 8 * (description.size or 4) if description is not None else 32
        return live & ((1 << bits) - 1)

    def reset_communication(self) -> None:
        """Set the communication objects to their defaults."""
        for address, description in self.eds.objects.items():
            if address[0] in COMMUNICATION_OBJECTS:
                self.values[address] = description.default_value(self.node_id)

    # --- NMT --------------------------------------------------------------------------------------------------

    def apply_nmt(self, command: int) -> bool:
        """Change the NMT state; return whether the command restarts the node or its communication."""
        match command:
            case NmtCommand.START:
                self.nmt_state = NmtState.OPERATIONAL
            case NmtCommand.STOP:
                self.nmt_state = NmtState.STOPPED
            case NmtCommand.ENTER_PRE_OPERATIONAL:
                self.nmt_state = NmtState.PRE_OPERATIONAL
            case NmtCommand.RESET_NODE | NmtCommand.RESET_COMMUNICATION:
                return True
            case _:
                pass
        return False

    # --- SDO --------------------------------------------------------------------------------------------------

    def handle_sdo_request(self, request: SdoFrame) -> bytes:
        """Read or write an object, as an SDO request asks for, and return the data of the response."""
        address = (request.index, request.sub)
        try:
            if request.kind == UPLOAD_REQUEST:
                return encode_read_response(*address, self._read(address))
            if request.kind == DOWNLOAD_REQUEST:
                self._write(address, request.data)
                return encode_write_response(*address)
            return encode_abort(*address, UNKNOWN_COMMAND)
        except SdoAbortError as error:
            return encode_abort(*address, error.code)

    def _find(self, address: Address) -> EdsObject:
        description = self.eds.objects.get(address)
        if description is not None:
            return description
        has_index = any(index == address[0] for index, _ in self.eds.objects)
        raise SdoAbortError(NO_SUBINDEX if has_index else NO_OBJECT)

    def _read(self, address: Address) -> bytes:
        description = self._find(address)
        if description.access not in READABLE:
            raise SdoAbortError(NOT_READABLE)
        if description.size is None:
            raise SdoAbortError(NOT_EXPEDITED)
        return self.get(address).to_bytes(description.size, "little")

    def _write(self, address: Address, data: bytes) -> None:
        description = self._find(address)
        if description.access not in WRITABLE:
            raise SdoAbortError(NOT_WRITABLE)
        if description.size != len(data):
            raise SdoAbortError(WRONG_LENGTH)
        value = int.from_bytes(data, "little")
        self._validate_mapping_write(address, value)
        self.values[address] = value
        self.on_write(address, value)

    # --- PDOs -------------------------------------------------------------------------------------------------

    def unpack_received_pdo(self, cob_id: int, data: bytes) -> list[tuple[Address, int]] | None:
        """Return the objects and values that a received PDO writes, without writing them.

        Args:
            cob_id: Id of the frame.
            data: Data bytes of the frame.

        Returns:
            The objects and their values; None if no active receive PDO has this id.
        """
        if self.nmt_state != NmtState.OPERATIONAL:
            return None
        for index in self._list_pdos(RECEIVE_COMMUNICATION):
            if self.values[index, COB_ID_SUB] == cob_id:
                return list(self._unpack(index + MAPPING_OFFSET, data))
        return None

    def list_synchronous_pdos(self) -> Iterator[tuple[int, bytes]]:
        """Yield id and data of each PDO that the node sends after a SYNC."""
        if self.nmt_state != NmtState.OPERATIONAL:
            return
        for index in self._list_pdos(TRANSMIT_COMMUNICATION):
            cob_id = self.values[index, COB_ID_SUB]
            transmission_type = self.values.get((index, TRANSMISSION_TYPE_SUB), 0)
            is_synchronous = 1 <= transmission_type <= LAST_SYNCHRONOUS_TYPE
            is_on = not cob_id & PDO_OFF
            if is_synchronous and is_on:
                yield cob_id & CAN_ID_MASK, self._pack(index + MAPPING_OFFSET)

    def _list_pdos(self, indices: range) -> list[int]:
        """Return the indices of the communication parameters of all PDOs of one direction that the node has."""
        return sorted(
            index for index, sub in self.eds.objects if index in indices and sub == COB_ID_SUB
        )

    def _list_mapped(self, mapping_index: int) -> Iterator[tuple[Address, int]]:
        """Yield the objects in a PDO, in the order of its data, and their lengths in bytes.

        Args:
            mapping_index: Index of the mapping parameters of the PDO. Their subindex 0 is the number of mapped objects,
                and the subindices from 1 on are the entries; see `_parse_mapping_entry`.
        """
        object_count = self.values.get((mapping_index, 0), 0)
        for sub in range(1, object_count + 1):
            yield _parse_mapping_entry(self.values.get((mapping_index, sub), 0))

    def _unpack(self, mapping_index: int, data: bytes) -> Iterator[tuple[Address, int]]:
        """Yield the objects that the data of a PDO writes, and their values."""
        offset = 0
        for address, size in self._list_mapped(mapping_index):
            yield address, int.from_bytes(data[offset : offset + size], "little")
            offset += size

    def _pack(self, mapping_index: int) -> bytes:
        """Return the data of a PDO: the current values of its objects, one after another, little-endian."""
        return b"".join(
            self.get(address).to_bytes(size, "little")
            for address, size in self._list_mapped(mapping_index)
        )

    def _validate_mapping_write(self, address: Address, value: int) -> None:
        """Check a value that a host writes into the mapping parameters of a PDO; other objects need no check.

        A mapping may be changed only while its PDO is off. Its entries may be changed only while subindex 0, the number
        of mapped objects, is 0. A host then sets subindex 0 to the number of entries, which activates the mapping.

        Args:
            address: Index and subindex of the object that is written.
            value: New value of the object.

        Raises:
            SdoAbortError: The mapping is in use, an object cannot be mapped, or the objects are too long for a frame.
        """
        index, sub = address
        if index not in RECEIVE_MAPPING and index not in TRANSMIT_MAPPING:
            return
        cob_id = self.values.get((index - MAPPING_OFFSET, COB_ID_SUB), PDO_OFF)
        is_pdo_on = not cob_id & PDO_OFF
        if is_pdo_on:
            raise SdoAbortError(WRONG_STATE)
        if sub == 0:
            self._validate_mapped_length(index, value)
            return
        is_mapping_active = self.values.get((index, 0), 0) > 0
        if is_mapping_active:
            raise SdoAbortError(WRONG_STATE)
        self._validate_mapping_entry(value)

    def _validate_mapping_entry(self, entry: int) -> None:
        """Check that the object of an entry exists, may be in a PDO, and has that length. Raises SdoAbortError."""
        mapped_address, size = _parse_mapping_entry(entry)
        description = self.eds.objects.get(mapped_address)
        if description is None:
            raise SdoAbortError(NO_OBJECT)
        if not description.mappable or description.size != size:
            raise SdoAbortError(NOT_MAPPABLE)

    def _validate_mapped_length(self, mapping_index: int, object_count: int) -> None:
        """Check that the first objects of a mapping fit into one frame. Raises SdoAbortError."""
        total_bytes = 0
        for sub in range(1, object_count + 1):
            _, size = _parse_mapping_entry(self.values.get((mapping_index, sub), 0))
            total_bytes += size
        if total_bytes > MAX_PDO_BYTES:
            raise SdoAbortError(TOO_LONG_TO_MAP)


def _parse_mapping_entry(entry: int) -> tuple[Address, int]:
    """Return the object of a mapping entry, and its length in bytes.

    Bits 31 to 16 of an entry are the object's index, bits 15 to 8 its subindex, and bits 7 to 0 its length in bits.

    Source: CiA 301, PDO mapping parameter record.
    """
    index = entry >> 16
    sub = (entry >> 8) & 0xFF
    length_bits = entry & 0xFF
    return (index, sub), length_bits // 8
