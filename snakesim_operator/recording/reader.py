"""Reads a recording: the messages in the order of the file, also of one that is damaged or was never finished.

Damage ends nothing: the reading goes on at the next chunk that is intact. What is lost in between is known from the
messages' sequence numbers, which count up by key, and from the file's own statistics if it has an end.
"""

import json
import os
import re
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Header, McapRecord, Message, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.keys import row_key
from snakesim_operator.recording.chunks import (
    HEAD,
    LARGEST_BYTES,
    DamagedError,
    chunk_bytes,
    parsed,
    records_in,
    unpack,
)
from snakesim_operator.recording.losses import ELSEWHERE, MOST_GAPS, Losses
from snakesim_operator.recording.mcap_file import PROFILE
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.recording.recording import ABOUT, COPIED

LATEST_NS = 2**62  # 146 years: no robot time is later
MOST_RATIO, FREE_BYTES = 100, 32 * 1024 * 1024  # a file may unpack to so many times its size, and to so much more
_SCANNED_BYTES = 1024 * 1024
_NEXT_BYTES = 64  # of what _NEXT matches, at most
_NEXT = re.compile(  # a chunk of a known compression, our metadata, or the end of the messages
    rb"\x06[\s\S]{4}\0{4}[\s\S]{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4})[\s\S]{4}\0{4}"
    rb"|\x0c[\s\S]{4}\0{4}\x08\0{3}" + ABOUT.encode() + rb"|\x0f\x04\0{7}[\s\S]{4}[\x01-\x0f]"
)
_DATA_END = HEAD.pack(Opcode.DATA_END, 4)  # and a CRC
_FOOTER = HEAD.size + 20 + len(MCAP0_MAGIC)  # bytes at the end: a record of two offsets and a CRC, and the magic
_READ = (Opcode.CHANNEL, Opcode.HEADER, Opcode.METADATA, Opcode.SCHEMA, Opcode.MESSAGE)


@dataclass
class RecordingReader:
    """One file. What it says of itself, and what it lacks, is known once its messages have been read."""

    path: Path
    finished: bool = False  # else its recorder was killed, the disk was full, or the file was cut
    losses: Losses = field(default_factory=Losses)
    about: dict[str, Any] = field(default_factory=dict[str, Any])
    _channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    _schemas: set[int] = field(default_factory=lambda: {0})  # 0: none
    _last: dict[int, tuple[int, int]] = field(default_factory=dict[int, tuple[int, int]])  # sequence, gaps by then
    _newest_ns: int = 0
    _counted: bool = True  # sequence numbers count up
    _unpacked_bytes: int = 0
    _file: BinaryIO | None = None
    _summary: list[McapRecord] | None = None

    @property
    def lacks(self) -> list[str]:
        """What is missing, for people."""
        return self.losses.words()

    def messages(self, keys: Collection[str] | None = None) -> Iterator[RecordedMessage]:
        """Messages at these keys of the robot, or at all. Raises ConfigError for a file that is no recording.

        keys: a pattern of the key space stands for its keys.
        """
        for record in self.records():
            if isinstance(record, Message):
                channel = self._channels[record.channel_id]
                encoding = channel.metadata.get("encoding")
                if encoding is not None and (keys is None or channel.topic in keys or row_key(channel.topic) in keys):
                    yield RecordedMessage(channel.topic, record.data, encoding, record.log_time, record.publish_time)

    def records(self) -> Iterator[McapRecord]:
        """Every schema, channel, message and metadata that can be read. Raises ConfigError for a file that is no MCAP.

        The channel of a message comes before it.
        """
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise ConfigError(f"{self.path} is not a recording: it does not begin as an MCAP file")
                self._file = file
                yield from self._read(file, os.fstat(file.fileno()).st_size)
                self._close_books()
        except OSError as error:
            raise ConfigError(f"{self.path} cannot be read: {error.strerror}") from None

    def _read(self, file: BinaryIO, size: int) -> Iterator[McapRecord]:
        at = len(MCAP0_MAGIC)
        while not self.finished and at < size:
            try:
                opcode, content, end = _record_at(file, at, size)
            except DamagedError as error:
                found = _next(file, at + 1, size)
                if found is not None or str(error) != _CUT:
                    self.losses.damage(at, str(error), self._newest_ns)
                if found is None:
                    break
                at = found
                continue
            try:
                for record in self._taken_apart(opcode, content, end):
                    yield from self._accounted(record)
            except DamagedError as error:
                self.losses.damage(at, str(error), self._newest_ns)
            at = end
        if not self.finished:
            self.losses.cut_ns = self._newest_ns

    def _taken_apart(self, opcode: int, content: bytes, read_bytes: int) -> Iterator[McapRecord]:
        if opcode == Opcode.CHUNK:
            data = unpack(content)
            self._unpacked_bytes += len(data)
            if self._unpacked_bytes > FREE_BYTES + MOST_RATIO * read_bytes:
                raise ConfigError(
                    f"{self.path} is not a recording: its first {read_bytes / 1e6:.2f} MB unpack to "
                    f"{self._unpacked_bytes / 1e6:.0f} MB or more, which no messages of a robot do; the most is "
                    f"{FREE_BYTES / 1e6:.0f} MB and {MOST_RATIO} times the file"
                )
            yield from records_in(data)
        elif opcode == Opcode.DATA_END:
            self.finished = True
            yield DataEnd(0)
        elif opcode in _READ:
            yield parsed(opcode, memoryview(content))

    def _accounted(self, record: McapRecord) -> Iterator[McapRecord]:
        """The record, unless it is of no use; a channel that was lost is made up for."""
        match record:
            case Message():
                if record.channel_id not in self._channels and record.channel_id in (lost := self._lost_channels()):
                    yield from self._opened(lost[record.channel_id])  # as the end of the file repeats it
                if self._is_good(record):
                    yield record
            case Channel():
                yield from self._opened(record)
            case Schema():
                self._schemas.add(record.id)
                yield record
            case Header():
                self._counted = record.profile == PROFILE
            case Metadata(name=name) if name == ABOUT:
                self._take_about(record.metadata)
                yield record
            case _:
                yield record

    def _is_good(self, message: Message) -> bool:
        channel, time_ns = self._channels.get(message.channel_id), message.log_time
        losses = self.losses
        if losses.gaps and losses.gaps[-1].end_ns is None and time_ns < LATEST_NS:
            losses.gaps[-1].end_ns = max(time_ns, losses.gaps[-1].begin_ns)
        topic = ELSEWHERE if channel is None else channel.topic
        last, gaps_then = self._last.get(message.channel_id, (0, 0))
        if self._counted and message.sequence > last + 1:
            self._lose(topic, message.sequence - last - 1, gaps_then, time_ns)
        elif self._counted and message.sequence <= last:
            losses.misplaced += 1
        self._last[message.channel_id] = (max(message.sequence, last), len(losses.gaps))
        if channel is None or time_ns >= LATEST_NS:
            self._lose(topic, 1, 0, self._newest_ns)
            return False
        self._newest_ns = max(self._newest_ns, time_ns)
        return True

    def _lose(self, topic: str, count: int, gaps_then: int, time_ns: int | None) -> None:
        """Of a key whose newest message was read when there were so many gaps."""
        gaps = self.losses.gaps
        if len(gaps) <= gaps_then < MOST_GAPS:
            end_ns = time_ns if time_ns is None else max(min(time_ns, LATEST_NS), self._newest_ns)
            self.losses.open_gap(self._newest_ns, end_ns)
        gaps[-1].lost[topic] += count

    def _close_books(self) -> None:
        """Count what is lost at the end, by the statistics of a file that has them."""
        for statistics in (one for one in self._summarised() if isinstance(one, Statistics)):
            for number, count in statistics.channel_message_counts.items():
                last, gaps_then = self._last.get(number, (0, 0))
                if self._counted and last < count < LATEST_NS:
                    channel = self._channels.get(number) or self._lost_channels().get(number)
                    self._lose(ELSEWHERE if channel is None else channel.topic, count - last, gaps_then, None)

    def _opened(self, channel: Channel) -> Iterator[McapRecord]:
        """The channel, behind its schema if that was lost."""
        self._channels.setdefault(channel.id, channel)
        if channel.schema_id not in self._schemas:
            self._schemas.add(channel.schema_id)
            yield from (one for one in self._summarised() if isinstance(one, Schema) and one.id == channel.schema_id)
        yield channel

    def _lost_channels(self) -> dict[int, Channel]:
        return {one.id: one for one in self._summarised() if isinstance(one, Channel)}

    def _summarised(self) -> list[McapRecord]:
        """Channels, schemas and statistics at the end of the file; empty when it has no such end."""
        if self._summary is None and self._file is not None:
            try:
                self._summary = _summary_of(self._file)
            except DamagedError:
                self._summary = []
        return self._summary or []

    def _take_about(self, metadata: dict[str, str]) -> None:
        for name, value in metadata.items():
            try:
                self.about[name] = json.loads(value)
            except (ValueError, RecursionError):
                continue
        dropped, earlier = self.about.get("dropped"), self.about.get(COPIED)
        if isinstance(dropped, dict):
            known = {str(key)[:200]: count for key, count in dropped.items() if isinstance(count, int) and count > 0}
            self.losses.dropped = known
        if isinstance(earlier, list):
            self.losses.earlier = [str(one)[:500] for one in earlier[:10]]


_CUT = "the file ends in the middle of a record"


def _record_at(file: BinaryIO, at: int, size: int) -> tuple[int, bytes, int]:
    """Kind, content and end of a record; no content for those that are skipped. Raises DamagedError, OSError."""
    file.seek(at)
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        raise DamagedError(_CUT)
    opcode, length = HEAD.unpack(head)
    begin, end = at + HEAD.size, at + HEAD.size + length
    if not 0 < opcode < 0x10 and opcode < 0x80:
        raise DamagedError("no record")
    if end > size:
        raise DamagedError(_CUT)
    if opcode == Opcode.CHUNK:
        _check(length == chunk_bytes(file.read(_NEXT_BYTES)), "a chunk whose lengths contradict each other")
        file.seek(begin)
    elif opcode == Opcode.MESSAGE_INDEX:
        listed = int.from_bytes(file.read(6)[2:], "little")
        _check(length == 6 + listed and listed % 16 == 0, "an index whose lengths contradict each other")
    elif opcode == Opcode.DATA_END:
        _check(length == 4, "an end that is none")
    if opcode != Opcode.CHUNK and opcode not in _READ:
        return opcode, b"", end
    _check(length <= LARGEST_BYTES, f"a record of {length / 1e6:.0f} MB, more than {LARGEST_BYTES / 1e6:.0f} MB")
    content = file.read(length)
    _check(len(content) == length, _CUT)
    return opcode, content, end


def _check(holds: bool, why: str) -> None:
    if not holds:
        raise DamagedError(why)


def _next(file: BinaryIO, at: int, size: int) -> int | None:
    """Where the next record begins that one can go on at; None: nowhere. Raises OSError."""
    while at < size:
        file.seek(at)
        block = file.read(_SCANNED_BYTES + _NEXT_BYTES)
        begin = 0
        while (found := _NEXT.search(block, begin)) is not None and found.start() < _SCANNED_BYTES:
            try:
                _record_at(file, at + found.start(), size)
            except DamagedError:
                begin = found.start() + 1
            else:
                return at + found.start()
        at += _SCANNED_BYTES
    return None


def _summary_of(file: BinaryIO) -> list[McapRecord]:
    """Raises DamagedError, OSError."""
    size = file.seek(0, os.SEEK_END)
    _check(size > _FOOTER, _CUT)
    file.seek(size - _FOOTER)
    tail = file.read(_FOOTER)
    _check(tail.endswith(MCAP0_MAGIC) and tail[: HEAD.size] == HEAD.pack(Opcode.FOOTER, 20), _CUT)
    begin, crc = int.from_bytes(tail[9:17], "little"), int.from_bytes(tail[25:29], "little")
    at = max(size - _FOOTER - LARGEST_BYTES, 0)
    file.seek(at)
    last = file.read(size - _FOOTER - at)
    # Where the footer says; or behind the last messages, wherever these are when a part of the file is gone.
    for start in (begin - at, last.rfind(_DATA_END) + len(_DATA_END) + 4):
        summary = last[start:] if 0 < start <= len(last) else b""
        if crc and zlib.crc32(tail[:25], zlib.crc32(summary)) == crc:
            break
    else:
        raise DamagedError("a summary whose checksum does not fit")
    found, at, view = list[McapRecord](), 0, memoryview(summary)
    while at + HEAD.size <= len(summary):
        opcode, length = HEAD.unpack_from(summary, at)
        at += HEAD.size
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            _check(at + length <= len(summary), "a summary whose lengths contradict each other")
            found.append(parsed(opcode, view[at : at + length]))
        at += length
    return found
