"""Converts values to frames and back, by the layouts of the DBC file.

cantools reads the file once. The functions that run for every frame are made from it here, and work on raw integers;
their callers scale the numbers of all joints together, once in every control cycle. As in cantools, bitstruct takes
frames apart. Only this module knows the units of the bus.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from struct import Struct
from typing import Any

import bitstruct.c
import cantools
from cantools.database.can import Database

from snakesim_can_backend.protocol.definitions import (
    NODE_BITS,
    NODE_MASK,
    WITH_CHECKSUM,
    CanFrame,
    Opcode,
    checksum,
    frame_id,
)
from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.model.files import SCHEMAS_DIR

DBC = "snakesim.dbc"
OPCODE_MASK = 0x7FF & ~NODE_MASK  # of an 11-bit id
FLOAT_BYTES = 4
_single = Struct("<f")

Reader = Callable[[bytes], tuple[int, ...]]  # data of a frame -> raw numbers
Writer = Callable[[int, Sequence[int]], CanFrame]  # node, raw numbers -> frame


class CodecError(SnakesimError, ValueError):
    """A value does not fit its signal, or a frame does not fit its message."""

    code = "message/rejected"


@dataclass(frozen=True)
class FrameSignal:
    """The place of a number in a frame, and its conversion: value = raw * scale + offset."""

    name: str

    # Place.
    shift: int  # bits before it
    bits: int
    signed: bool
    is_float: bool  # single precision; scale and offset are not used

    # Conversion.
    scale: float  # unit of one step
    offset: float
    low: float  # smallest value
    high: float  # largest value
    unit: str

    @property
    def mask(self) -> int:
        """Return a number of `bits` ones."""
        return (1 << self.bits) - 1

    @property
    def bitstruct_format(self) -> str:
        """Return the signal's format for bitstruct. Of a float only the bits are read."""
        kind = "s" if self.signed and not self.is_float else "u"
        return f"{kind}{self.bits}"

    def encode(self, value: float) -> int:
        """Return the raw number that is nearest to a value. Raises CodecError for a value out of range."""
        if not self.low <= value <= self.high:  # which NaN fails too
            raise CodecError(
                f"{self.name} = {value} {self.unit} does not fit; allowed are {self.low} to {self.high}"
            )
        if self.is_float:
            return int.from_bytes(_single.pack(value), "little")
        return round((value - self.offset) / self.scale)

    def decode(self, raw: int) -> float:
        """Return the value of a raw number, in the signal's unit."""
        if self.is_float:
            (value,) = _single.unpack(raw.to_bytes(FLOAT_BYTES, "little"))
            return value
        return raw * self.scale + self.offset


class MessageLayout:
    """The layout of one message of the protocol: its signals by name, and functions that read and write its frames."""

    def __init__(self, message: Any) -> None:
        """Create the layout from a message of cantools."""
        self.name: str = message.name
        self.opcode = Opcode(message.frame_id >> NODE_BITS)
        self.length: int = message.length  # bytes
        self.signals: dict[str, FrameSignal] = {
            signal.name: _make_signal(signal) for signal in message.signals
        }
        self._has_checksum = self.opcode in WITH_CHECKSUM
        self._readers = {name: self.make_reader(name) for name in self.signals}

    def make_reader(self, *names: str) -> Reader:
        """Return a function that reads the raw numbers of some signals, in this order, from the data of a frame.

        The function is compiled once, because it runs for every frame. Its data must have the length of this message.

        Args:
            names: Names of the signals, which must not overlap.

        Raises:
            CodecError: Some of the signals overlap.
        """
        signals = [self.signals[name] for name in names]
        # bitstruct begins with the highest bit, so the function reverses the bytes and reads the last signal first.
        signals_from_high_bits = sorted(signals, key=lambda signal: -signal.shift)
        formats: list[str] = []
        end = 8 * self.length
        for signal in signals_from_high_bits:
            formats.append(_padding_format(end - signal.shift - signal.bits))
            formats.append(signal.bitstruct_format)
            end = signal.shift
        formats.append(_padding_format(end))
        unpack = bitstruct.c.compile("".join(formats)).unpack
        read_names = [signal.name for signal in signals_from_high_bits]
        if read_names == list(names):
            return lambda data: unpack(data[::-1])
        select = itemgetter(*(read_names.index(name) for name in names))
        return lambda data: select(unpack(data[::-1]))

    def make_writer(self, *names: str) -> Writer:
        """Return a function that makes the frame of a node from the raw numbers of some signals, with the checksum.

        Args:
            names: Names of the signals, in the order in which the function takes their raw numbers.
        """
        bit_fields = [(self.signals[name].shift, self.signals[name].mask) for name in names]
        opcode = self.opcode
        has_checksum = self._has_checksum
        payload_bytes = self.length - 1 if has_checksum else self.length

        def write(node_id: int, raw: Sequence[int]) -> CanFrame:
            bits = 0
            for (shift, mask), number in zip(bit_fields, raw, strict=True):
                bits |= (number & mask) << shift
            identifier = frame_id(opcode, node_id)
            data = bits.to_bytes(payload_bytes, "little")
            if has_checksum:
                data += bytes((checksum(identifier, data),))
            return CanFrame(identifier, data)

        return write

    def encode(self, node_id: int, **values: float) -> CanFrame:
        """Return the frame of a node with some values.

        Args:
            node_id: Sender or receiver.
            values: By signal, in the signal's unit. Signals that are not named are 0.

        Raises:
            CodecError: A value is out of range.
        """
        raw = [self.signals[name].encode(value) for name, value in values.items()]
        return self.make_writer(*values)(node_id, raw)

    def decode(self, data: bytes) -> Mapping[str, float]:
        """Return the values of all signals in a frame's data, in their units.

        Signals that share their bits all get a value; only the one that belongs to the frame's `mode` has a meaning.

        Raises:
            CodecError: The data has another length than this message.
        """
        if len(data) != self.length:
            raise CodecError(f"{self.name} has {self.length} bytes, this one {len(data)}")
        values: dict[str, float] = {}
        for name, read in self._readers.items():
            (raw,) = read(data)
            values[name] = self.signals[name].decode(raw)
        return values


@cache
def load_layouts() -> dict[Opcode, MessageLayout]:
    """Return the layout of every message of the DBC file, which is read once in a process."""
    layouts = [MessageLayout(message) for message in load_database().messages]
    return {layout.opcode: layout for layout in layouts}


def load_database() -> Database:
    """Load the DBC file that comes with the HAL into cantools. The ids of all nodes find their message."""
    database = cantools.database.load_file(SCHEMAS_DIR / "can" / DBC, frame_id_mask=OPCODE_MASK)
    assert isinstance(database, Database)
    return database


def _padding_format(bits: int) -> str:
    """Return bitstruct's format of bits that are skipped."""
    if bits < 0:
        raise CodecError("signals that overlap are read one by one")
    return f"p{bits}" if bits else ""


def _make_signal(signal: Any) -> FrameSignal:
    if signal.byte_order != "little_endian":
        raise CodecError(f"signal {signal.name}: only little-endian signals are meant here")
    return FrameSignal(
        name=signal.name,
        shift=signal.start,
        bits=signal.length,
        signed=signal.is_signed,
        is_float=signal.is_float,
        scale=float(signal.scale),
        offset=float(signal.offset),
        low=float(signal.minimum),
        high=float(signal.maximum),
        unit=signal.unit or "",
    )
