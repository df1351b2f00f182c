"""Reads a recording: the messages in the order of the file, of a file that was never finished too."""

import contextlib
import json
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mcap.exceptions
import zstandard
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from snakesim_hal.errors import ConfigError
from snakesim_operator.recording.recording import ABOUT

RECORDING = "recording.mcap"
LARGEST_RECORD = 256 * 1024 * 1024
DAMAGED = (
    mcap.exceptions.McapError,
    zstandard.ZstdError,
    CRCValidationError,
    UnicodeDecodeError,
    OverflowError,
    MemoryError,
)
"""What the library raises where a file is damaged."""


@dataclass(frozen=True)
class Recorded:
    """One message of a recording."""

    key: str
    payload: bytes
    encoding: str  # on the wire
    time_ns: int  # robot time
    wall_ns: int  # at the recorder


@dataclass
class RecordingReader:
    """One file. What it says of itself is known once its messages have been read."""

    path: Path
    finished: bool = False  # else its recorder was killed, or the disk was full
    failure: str = ""  # what ended the reading early, unless the file ends there
    about: dict[str, Any] = field(default_factory=dict[str, Any])

    def messages(self, keys: Collection[str] | None = None) -> Iterator[Recorded]:
        """Messages at these keys of the robot, or at all. Raises ConfigError for a file that is no recording."""
        channels: dict[int, Channel] = {}
        for record in self.records():
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata) and record.name == ABOUT:
                with contextlib.suppress(ValueError):
                    self.about = {name: json.loads(value) for name, value in record.metadata.items()}
            elif isinstance(record, Message) and (channel := channels.get(record.channel_id)) is not None:
                encoding = channel.metadata.get("encoding")
                if encoding is not None and (keys is None or channel.topic in keys):
                    yield Recorded(channel.topic, record.data, encoding, record.log_time, record.publish_time)

    def records(self) -> Iterator[McapRecord]:
        """Everything in the file up to where it ends, or is damaged. Raises ConfigError for a file that is no MCAP."""
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise ConfigError(f"{self.path} is not a recording: it does not begin as an MCAP file")
                file.seek(0)
                yield from self._read(StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_RECORD))
        except OSError as error:
            raise ConfigError(f"{self.path} cannot be read: {error.strerror}") from None

    def _read(self, reader: StreamReader) -> Iterator[McapRecord]:
        records = reader.records
        while not self.finished:
            try:
                record = next(records)
                inside = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
            except (StopIteration, mcap.exceptions.EndOfFile, mcap.exceptions.InvalidMagic, struct.error):
                return  # cut off there
            except DAMAGED as error:
                self.failure = f"{type(error).__name__}: {error}"[:200]
                return
            self.finished = isinstance(record, DataEnd)
            yield from inside
