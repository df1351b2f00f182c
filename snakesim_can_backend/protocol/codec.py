"""Numbers to bytes and back, by the layouts of the DBC file.

cantools reads the file once; what runs at every frame is made from it here and works on raw integers, which are scaled
once a tick for all joints together. Frames are taken apart by bitstruct, as in cantools. Bus units end in this module.
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

from snakesim_can_backend.protocol.definitions import NODE_BITS, WITH_CHECKSUM, Frame, Opcode, checksum, frame_id
from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.model.files import SCHEMAS

DBC = "snakesim.dbc"
OPCODE_MASK = 0x7FF & ~((1 << NODE_BITS) - 1)
_single = Struct("<f")
Reader = Callable[[bytes], tuple[int, ...]]
Writer = Callable[[int, Sequence[int]], Frame]


class CodecError(SnakesimError, ValueError):
    """A value that does not fit its signal."""


@dataclass(frozen=True)
class Signal:
    """Where a number stands in a frame, and what one step of it is worth."""

    name: str
    shift: int
    bits: int
    signed: bool
    scale: float
    offset: float
    low: float
    high: float
    unit: str
    is_float: bool

    @property
    def mask(self) -> int:
        """All bits of it set."""
        return (1 << self.bits) - 1

    @property
    def format(self) -> str:
        """As bitstruct writes it; of a float only the bits are taken."""
        return f"{'s' if self.signed and not self.is_float else 'u'}{self.bits}"

    def encode(self, value: float) -> int:
        """The nearest step. Raises CodecError for what is out of range."""
        if not self.low <= value <= self.high:  # which NaN fails too
            raise CodecError(f"{self.name} = {value} {self.unit} does not fit; it goes from {self.low} to {self.high}")
        if self.is_float:
            return int.from_bytes(_single.pack(value), "little")
        return round((value - self.offset) / self.scale)

    def decode(self, raw: int) -> float:
        """What a raw number means."""
        if self.is_float:
            return _single.unpack(raw.to_bytes(4, "little"))[0]
        return raw * self.scale + self.offset


class MessageLayout:
    """One message of the protocol."""

    def __init__(self, message: Any) -> None:
        self.name: str = message.name
        self.opcode = Opcode(message.frame_id >> NODE_BITS)
        self.length: int = message.length
        self.signals: dict[str, Signal] = {s.name: _signal(s) for s in message.signals}
        self._checked = self.opcode in WITH_CHECKSUM
        self._readers = {name: self.make_reader(name) for name in self.signals}

    def make_reader(self, *names: str) -> Reader:
        """A function that takes these signals' raw numbers out of a frame of this length; they must not overlap."""
        places, parts, at = dict[str, int](), list[str](), 8 * self.length
        for signal in sorted((self.signals[name] for name in names), key=lambda s: -s.shift):  # from the last bit on
            places[signal.name] = len(places)
            parts += [_padding(at - signal.shift - signal.bits), signal.format]
            at = signal.shift
        unpack = bitstruct.c.compile("".join([*parts, _padding(at)])).unpack
        if list(places) == list(names):
            return lambda data: unpack(data[::-1])
        in_order = itemgetter(*(places[name] for name in names))
        return lambda data: in_order(unpack(data[::-1]))

    def make_writer(self, *names: str) -> Writer:
        """A function that makes the frame of a node from these signals' raw numbers; the checksum comes by itself."""
        parts = [(s.shift, s.mask) for s in (self.signals[name] for name in names)]
        opcode, length, checked = self.opcode, self.length, self._checked
        payload = length - 1 if checked else length

        def write(node: int, raw: Sequence[int]) -> Frame:
            bits = 0
            for (shift, mask), number in zip(parts, raw, strict=True):
                bits |= (number & mask) << shift
            identifier = frame_id(opcode, node)
            data = bits.to_bytes(payload, "little")
            return Frame(identifier, data + bytes((checksum(identifier, data),)) if checked else data)

        return write

    def encode(self, node: int, **values: float) -> Frame:
        """The frame of a node from values in SI units; what is not named is 0. Raises CodecError."""
        raw = [self.signals[name].encode(value) for name, value in values.items()]
        return self.make_writer(*values)(node, raw)

    def decode(self, data: bytes) -> Mapping[str, float]:
        """All signals in SI units. Of a multiplexed group only one means anything: look at `mode`."""
        if len(data) != self.length:
            raise CodecError(f"{self.name} has {self.length} bytes, this one {len(data)}")
        return {name: self.signals[name].decode(read(data)[0]) for name, read in self._readers.items()}


@cache
def load_layouts() -> dict[Opcode, MessageLayout]:
    """The layout of every message of the DBC file, read once a process."""
    layouts = map(MessageLayout, load_database().messages)
    return {layout.opcode: layout for layout in layouts}


def load_database() -> Database:
    """The DBC file, which comes with the HAL, as cantools has it; ids of all nodes find their message."""
    database = cantools.database.load_file(SCHEMAS / "can" / DBC, frame_id_mask=OPCODE_MASK)
    assert isinstance(database, Database)
    return database


def _padding(bits: int) -> str:
    if bits < 0:
        raise CodecError("signals that overlap are read one by one")
    return f"p{bits}" if bits else ""


def _signal(signal: Any) -> Signal:
    if signal.byte_order != "little_endian":
        raise CodecError(f"signal {signal.name}: only little-endian signals are meant here")
    scale, offset = float(signal.scale), float(signal.offset)
    return Signal(
        name=signal.name,
        shift=signal.start,
        bits=signal.length,
        signed=signal.is_signed,
        scale=scale,
        offset=offset,
        low=float(signal.minimum),
        high=float(signal.maximum),
        unit=signal.unit or "",
        is_float=signal.is_float,
    )
