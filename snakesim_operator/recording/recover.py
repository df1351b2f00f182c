"""Repairs a recording that is damaged or has no end: keeps every readable message, and adds an index and its losses."""

import json
from pathlib import Path

from mcap.records import Channel, McapRecord, Message, Metadata, Schema

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.recording.disk import GrowingFile
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.writer import ABOUT, COPIED

FLUSH_BYTES = 4 * 1024 * 1024  # bounds the memory that waiting messages take


def recover_recording(path: Path, out: Path) -> tuple[int, list[str]]:
    """Copy the readable messages of a recording, without change, into a new file.

    Args:
        path: The recording.
        out: The new file.

    Returns:
        The number of messages, and sentences about what is missing in it; the copy states that too.

    Raises:
        ConfigError: The recording cannot be read, or the new file exists or cannot be created.
    """
    try:
        file = GrowingFile(out)
    except OSError as error:
        raise ConfigError(f"{out}: {error.strerror}; choose another file", code="file/not-writable") from error
    try:
        reader = RecordingReader(path)
        copy = _Copy(file)
        for record in reader.read_records():
            copy.add(record)
        missing = reader.missing
        copy.finish(reader.metadata, missing)
    except BaseException:
        out.unlink(missing_ok=True)  # half a copy would refuse the next try
        raise
    finally:
        file.close()
    return copy.message_count, missing


class _Copy:
    """A recording that is written from the records of another one."""

    def __init__(self, file: GrowingFile) -> None:
        self._file = file
        self._mcap = McapFile(file)
        self._schemas: dict[int, int] = {}  # number in the copy, by number in the original
        self._channels: dict[int, int] = {}  # number in the copy, by number in the original
        self.message_count = 0

    def add(self, record: McapRecord) -> None:
        """Add a record, unless it is repeated or is the original's metadata about itself."""
        match record:
            case Schema() if record.id not in self._schemas:
                self._schemas[record.id] = self._mcap.add_schema(record.name, record.encoding, record.data)
            case Channel() if record.id not in self._channels:
                schema = self._schemas.get(record.schema_id, 0)
                number = self._mcap.add_channel(record.topic, record.message_encoding, schema, record.metadata)
                self._channels[record.id] = number
            case Metadata() if record.name != ABOUT:
                self._mcap.add_metadata(record.name, record.metadata)
            case Message() if record.channel_id in self._channels:
                self._add_message(record)
            case _:
                pass

    def _add_message(self, message: Message) -> None:
        channel = self._channels[message.channel_id]
        self._mcap.add(channel, message.log_time, message.publish_time, message.sequence, message.data)
        self.message_count += 1
        if self._file.waiting_bytes > FLUSH_BYTES:
            self._mcap.flush()

    def finish(self, about: dict[str, object], missing: list[str]) -> None:
        """Write the metadata, with what is missing in the original, and the index. Raises OSError."""
        if missing:
            about = {**about, COPIED: missing}
        self._mcap.add_metadata(ABOUT, {name: json.dumps(value) for name, value in about.items()})
        self._mcap.finish()
