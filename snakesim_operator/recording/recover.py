"""Repairs a recording that is damaged or has no end: keeps every readable message, and adds an index and its losses."""

import json
from pathlib import Path

from mcap.records import Channel, McapRecord, Message, Metadata, Schema

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.recording.disk import GrowingFile
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.shown_messages import ShownMessages
from snakesim_operator.recording.stamps import Stamps, mark_stamps, order_times, read_stamps
from snakesim_operator.recording.writer import ABOUT, COPIED

FLUSH_BYTES = 4 * 1024 * 1024  # bounds the memory that waiting messages take


def recover_recording(path: Path, out: Path, stamps: Stamps | None = None) -> tuple[int, list[str]]:
    """Copy the readable messages of a recording, without change, into a new file.

    With other stamps than those of the recording, the messages for viewers are made again: they have timestamps.

    Args:
        path: The recording.
        out: The new file.
        stamps: The clock of the log times in the new file; None: as in the recording.

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
        copy = _Copy(file, stamps)
        if stamps is not None:
            copy.remake_shown(_find_shown_robot(path, stamps))
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


def _find_shown_robot(path: Path, stamps: Stamps) -> str | None:
    """Return the robot's name in the topics for viewers, if these have other stamps; else None."""
    for record in RecordingReader(path).read_records():
        if isinstance(record, Channel) and _is_shown(record) and read_stamps(record.metadata) != stamps:
            return record.topic.split("/")[1]
    return None


def _is_shown(channel: Channel) -> bool:
    """Return whether a channel has messages for viewers, at a topic such as `/planar13/tf`."""
    return "encoding" not in channel.metadata and channel.topic.startswith("/") and channel.topic.count("/") > 1


class _Copy:
    """A recording that is written from the records of another one."""

    def __init__(self, file: GrowingFile, stamps: Stamps | None) -> None:
        """Begin the copy. stamps: the clock of its log times; None: as in the original."""
        self._file = file
        self._mcap = McapFile(file)
        self._schemas: dict[int, int] = {}  # number in the copy, by number in the original
        self._channels: dict[int, int] = {}  # number in the copy, by number in the original
        self._keys: dict[int, str] = {}  # keys of the robot's own messages, by channel in the original
        self._requested_stamps: Stamps | None = stamps
        self._stamps: dict[int, Stamps] = {}  # in the copy, by channel in the original
        self._shown: ShownMessages | None = None  # makes the messages for viewers again; None: they are copied
        self.message_count = 0

    def remake_shown(self, robot_name: str | None) -> None:
        """Make the messages for viewers again. robot_name: in their topics; None: they are copied."""
        if robot_name is not None and self._requested_stamps is not None:
            self._shown = ShownMessages(self._mcap, robot_name, self._requested_stamps)

    def add(self, record: McapRecord) -> None:
        """Add a record, unless it is repeated or is the original's metadata about itself."""
        match record:
            case Schema() if record.id not in self._schemas:
                self._schemas[record.id] = self._mcap.add_schema(record.name, record.encoding, record.data)
            case Channel() if record.id not in self._channels:
                self._add_channel(record)
            case Metadata() if record.name != ABOUT:
                self._mcap.add_metadata(record.name, record.metadata)
            case Message() if record.channel_id in self._channels:
                self._add_message(record)
            case _:
                pass

    def _add_channel(self, channel: Channel) -> None:
        """Add a channel, unless its messages are made again."""
        if self._shown is not None and _is_shown(channel):
            return
        stamps: Stamps = self._requested_stamps or read_stamps(channel.metadata)
        schema = self._schemas.get(channel.schema_id, 0)
        metadata = mark_stamps(channel.metadata, stamps)
        number = self._mcap.add_channel(channel.topic, channel.message_encoding, schema, metadata)
        self._channels[channel.id] = number
        self._stamps[channel.id] = stamps
        if "encoding" in channel.metadata:
            self._keys[channel.id] = channel.topic

    def _add_message(self, message: Message) -> None:
        channel = self._channels[message.channel_id]
        stamps = self._stamps[message.channel_id]
        log_ns, publish_ns = order_times(message.log_time, message.publish_time, stamps)
        self._mcap.add(channel, log_ns, publish_ns, message.sequence, message.data)
        self.message_count += 1
        key = self._keys.get(message.channel_id)
        if self._shown is not None and key is not None:
            self.message_count += self._shown.write(key, message.data, log_ns, publish_ns)
        if self._file.waiting_bytes > FLUSH_BYTES:
            self._mcap.flush()

    def finish(self, about: dict[str, object], missing: list[str]) -> None:
        """Write the metadata, with what is missing in the original, and the index. Raises OSError."""
        if missing:
            about = {**about, COPIED: missing}
        self._mcap.add_metadata(ABOUT, {name: json.dumps(value) for name, value in about.items()})
        self._mcap.finish()
