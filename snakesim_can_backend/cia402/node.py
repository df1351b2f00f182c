"""An emulated CANopen node: its object dictionary from an EDS, its SDO server, its PDOs and its NMT state. Pure.

It supports expedited transfers only. What its objects do is in `emulator`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from snakesim_can_backend.cia402.eds import READABLE, WRITABLE, Eds, EdsObject
from snakesim_can_backend.cia402.frames import (
    DOWNLOAD_REQUEST,
    UPLOAD_REQUEST,
    NmtCommand,
    NmtState,
    SdoFrame,
    encode_abort,
    encode_read_answer,
    encode_write_answer,
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
LAST_SYNCHRONOUS_TYPE = 240
COMMUNICATION_OBJECTS = range(0x1000, 0x2000)  # that a reset of the communication sets to their defaults
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
class Node:
    """One node. Values are whole numbers without a sign, as they are sent."""

    eds: Eds
    node: int
    on_write: Callable[[Address, int], None]  # gets every value that a host has written
    read_live: Callable[[Address], int | None]  # returns a value that changes by itself; None: the stored one counts
    nmt_state: NmtState = NmtState.PRE_OPERATIONAL
    values: dict[Address, int] = field(default_factory=dict[Address, int])

    def __post_init__(self) -> None:
        """Set every object to its default."""
        for address, described in self.eds.objects.items():
            self.values[address] = described.default_value(self.node)

    # --- values -----------------------------------------------------------------------------------------------

    def get(self, address: Address) -> int:
        """Return the present value of an object, without a sign; 0 if it does not exist."""
        live = self.read_live(address)
        if live is None:
            return self.values.get(address, 0)
        described = self.eds.objects.get(address)
        bits = 8 * (described.size or 4) if described is not None else 32
        return live & ((1 << bits) - 1)

    def reset_communication(self) -> None:
        """Set the communication objects to their defaults."""
        for address, described in self.eds.objects.items():
            if address[0] in COMMUNICATION_OBJECTS:
                self.values[address] = described.default_value(self.node)

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

    def answer_sdo(self, request: SdoFrame) -> bytes:
        """Return the answer to a request."""
        address = (request.index, request.sub)
        try:
            if request.kind == UPLOAD_REQUEST:
                return encode_read_answer(*address, self._read(address))
            if request.kind == DOWNLOAD_REQUEST:
                self._write(address, request.data)
                return encode_write_answer(*address)
            return encode_abort(*address, UNKNOWN_COMMAND)
        except SdoAbortError as error:
            return encode_abort(*address, error.code)

    def _find(self, address: Address) -> EdsObject:
        described = self.eds.objects.get(address)
        if described is not None:
            return described
        has_index = any(index == address[0] for index, _ in self.eds.objects)
        raise SdoAbortError(NO_SUBINDEX if has_index else NO_OBJECT)

    def _read(self, address: Address) -> bytes:
        described = self._find(address)
        if described.access not in READABLE:
            raise SdoAbortError(NOT_READABLE)
        if described.size is None:
            raise SdoAbortError(NOT_EXPEDITED)
        return self.get(address).to_bytes(described.size, "little")

    def _write(self, address: Address, data: bytes) -> None:
        described = self._find(address)
        if described.access not in WRITABLE:
            raise SdoAbortError(NOT_WRITABLE)
        if described.size != len(data):
            raise SdoAbortError(WRONG_LENGTH)
        value = int.from_bytes(data, "little")
        self._check_mapping(address, value)
        self.values[address] = value
        self.on_write(address, value)

    # --- PDOs -------------------------------------------------------------------------------------------------

    def find_received(self, cob_id: int, data: bytes) -> list[tuple[Address, int]] | None:
        """Return what a receive PDO writes.

        Args:
            cob_id: The id of the frame.
            data: Its data.

        Returns:
            The objects and their values; None if no active receive PDO has this id.
        """
        if self.nmt_state != NmtState.OPERATIONAL:
            return None
        for index in self._list_pdos(RECEIVE_COMMUNICATION):
            if self.values[index, 1] == cob_id:
                return list(self._unpack(index + MAPPING_OFFSET, data))
        return None

    def list_synchronous(self) -> Iterator[tuple[int, bytes]]:
        """Yield id and data of each PDO that the node sends after a SYNC."""
        if self.nmt_state != NmtState.OPERATIONAL:
            return
        for index in self._list_pdos(TRANSMIT_COMMUNICATION):
            cob_id = self.values[index, 1]
            is_synchronous = 1 <= self.values.get((index, 2), 0) <= LAST_SYNCHRONOUS_TYPE
            if is_synchronous and not cob_id & PDO_OFF:
                yield cob_id & 0x7FF, self._pack(index + MAPPING_OFFSET)

    def _list_pdos(self, indices: range) -> list[int]:
        return sorted(index for index, sub in self.eds.objects if index in indices and sub == 1)

    def _list_mapped(self, mapping_index: int) -> Iterator[tuple[Address, int]]:
        """Yield the objects of a PDO, and their lengths in bytes."""
        for sub in range(1, self.values.get((mapping_index, 0), 0) + 1):
            mapped = self.values.get((mapping_index, sub), 0)
            yield (mapped >> 16, mapped >> 8 & 0xFF), (mapped & 0xFF) // 8

    def _unpack(self, mapping_index: int, data: bytes) -> Iterator[tuple[Address, int]]:
        offset = 0
        for address, size in self._list_mapped(mapping_index):
            yield address, int.from_bytes(data[offset : offset + size], "little")
            offset += size

    def _pack(self, mapping_index: int) -> bytes:
        return b"".join(
            self.get(address).to_bytes(size, "little") for address, size in self._list_mapped(mapping_index)
        )

    def _check_mapping(self, address: Address, value: int) -> None:
        """Refuse a change of an active mapping, and objects that cannot be mapped. Raises SdoAbortError."""
        index, sub = address
        if index not in RECEIVE_MAPPING and index not in TRANSMIT_MAPPING:
            return
        cob_id = self.values.get((index - MAPPING_OFFSET, 1), PDO_OFF)
        if not cob_id & PDO_OFF or (sub and self.values.get((index, 0), 0)):
            raise SdoAbortError(WRONG_STATE)
        if sub:
            described = self.eds.objects.get((value >> 16, value >> 8 & 0xFF))
            if described is None:
                raise SdoAbortError(NO_OBJECT)
            if not described.mappable or described.size != (value & 0xFF) // 8:
                raise SdoAbortError(NOT_MAPPABLE)
            return
        sizes = [(self.values.get((index, entry), 0) & 0xFF) // 8 for entry in range(1, value + 1)]
        if sum(sizes) > MAX_PDO_BYTES:
            raise SdoAbortError(TOO_LONG_TO_MAP)
