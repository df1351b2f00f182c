"""Repairs a recording that is damaged or has no end: keeps every readable message, and adds an index and its losses."""

import json
from pathlib import Path

from mcap.records import Channel, McapRecord, Message, Metadata, Schema

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.recording.buffered_file import GrowingFile
from snakesim_operator.recording.foxglove_messages.file_writer import ViewerMessageWriter
from snakesim_operator.recording.log_clock import (
    LogTimeClock,
    order_times,
    read_log_time_clock,
    with_log_time_clock,
)
from snakesim_operator.recording.mcap_format.file_writer import (
    EARLIER_LOSSES_ENTRY,
    METADATA_NAME,
    McapFileWriter,
)
from snakesim_operator.recording.reader import RecordingReader

FLUSH_BYTES = 4 * 1024 * 1024  # bounds the memory that waiting messages take


def recover_recording(
    path: Path, output_path: Path, log_time_clock: LogTimeClock | None = None
) -> tuple[int, list[str]]:
    """Copy the readable messages of a recording, without change, into a new file.

    If the log times of the new file are by another clock, the messages for viewers are generated again instead of
    copied, because they contain timestamps.

    Args:
        path: The recording.
        output_path: The new file.
        log_time_clock: The clock of the log times in the new file; None: as in the recording.

    Returns:
        The number of messages, and sentences about what is missing in it; the copy states that too.

    Raises:
        ConfigError: The recording cannot be read, or the new file exists or cannot be created.
    """
    try:
        file = GrowingFile(output_path)
    except OSError as error:
        raise ConfigError(
            f"{output_path}: {error.strerror}; choose another file", code="file/not-writable"
        ) from error
    try:
        reader = RecordingReader(path)
        copy = _RecordingCopy(file, log_time_clock)
        if log_time_clock is not None:
            copy.regenerate_viewer_messages(
                _find_robot_of_outdated_viewer_topics(path, log_time_clock)
            )
        for record in reader.read_records():
            copy.add_record(record)
        missing = reader.missing
        copy.write_metadata_and_finish(reader.metadata, missing)
    except BaseException:
        output_path.unlink(missing_ok=True)  # half a copy would refuse the next try
        raise
    finally:
        file.close()
    return copy.message_count, missing


def _find_robot_of_outdated_viewer_topics(path: Path, log_time_clock: LogTimeClock) -> str | None:
    """Find viewer topics whose log times are by another clock than the requested one.

    Args:
        path: Path of the recording.
        log_time_clock: Requested clock of the log times.

    Returns:
        The robot's name in these topics, or None if there are no such topics.
    """
    for record in RecordingReader(path).read_records():
        if (
            isinstance(record, Channel)
            and _is_viewer_channel(record)
            and read_log_time_clock(record.metadata) != log_time_clock
        ):
            return record.topic.split("/")[1]
    return None


def _is_viewer_channel(channel: Channel) -> bool:
    """Return whether a channel has messages made for viewers, on a topic such as `/planar13/tf`."""
    return (
        "encoding" not in channel.metadata
        and channel.topic.startswith("/")
        and channel.topic.count("/") > 1
    )


class _RecordingCopy:
    """A recording that is written from the records of another one."""

    def __init__(self, file: GrowingFile, log_time_clock: LogTimeClock | None) -> None:
        """Start an empty copy.

        Args:
            file: The new, empty file.
            log_time_clock: Clock of the log times in the copy. If None, each channel keeps its clock.
        """
        self._file = file
        self._mcap = McapFileWriter(file)
        # Number in the copy, by number in the original.
        self._new_schema_id_by_id: dict[int, int] = {}
        # Number in the copy, by number in the original.
        self._new_channel_id_by_id: dict[int, int] = {}
        # Keys of the robot's own messages, by channel in the original.
        self._key_by_channel: dict[int, str] = {}
        self._requested_log_time_clock: LogTimeClock | None = log_time_clock
        # In the copy, by channel in the original.
        self._log_time_clock_by_channel: dict[int, LogTimeClock] = {}
        # Makes the messages for viewers again; None: they are copied.
        self._viewer_messages: ViewerMessageWriter | None = None
        self.message_count = 0

    def regenerate_viewer_messages(self, robot_name: str | None) -> None:
        """Generate the messages for viewers from the robot's messages, instead of copying them.

        Args:
            robot_name: Name of the robot in the viewer topics. If None, the messages are copied after all.
        """
        if robot_name is not None and self._requested_log_time_clock is not None:
            self._viewer_messages = ViewerMessageWriter(
                self._mcap, robot_name, self._requested_log_time_clock
            )

    def add_record(self, record: McapRecord) -> None:
        """Add a record, unless it is repeated or is the original's metadata about itself."""
        match record:
            case Schema() if record.id not in self._new_schema_id_by_id:
                self._new_schema_id_by_id[record.id] = self._mcap.add_schema(
                    record.name, record.encoding, record.data
                )
            case Channel() if record.id not in self._new_channel_id_by_id:
                self._add_channel(record)
            case Metadata() if record.name != METADATA_NAME:
                self._mcap.add_metadata(record.name, record.metadata)
            case Message() if record.channel_id in self._new_channel_id_by_id:
                self._add_message(record)
            case _:
                pass

    def _add_channel(self, channel: Channel) -> None:
        """Add a channel, unless its messages are made again."""
        if self._viewer_messages is not None and _is_viewer_channel(channel):
            return
        log_time_clock: LogTimeClock = self._requested_log_time_clock or read_log_time_clock(
            channel.metadata
        )
        schema_id = self._new_schema_id_by_id.get(channel.schema_id, 0)
        metadata = with_log_time_clock(channel.metadata, log_time_clock)
        channel_id = self._mcap.add_channel(
            channel.topic, channel.message_encoding, schema_id, metadata
        )
        self._new_channel_id_by_id[channel.id] = channel_id
        self._log_time_clock_by_channel[channel.id] = log_time_clock
        if "encoding" in channel.metadata:
            self._key_by_channel[channel.id] = channel.topic

    def _add_message(self, message: Message) -> None:
        channel_id = self._new_channel_id_by_id[message.channel_id]
        log_time_clock = self._log_time_clock_by_channel[message.channel_id]
        log_time_ns, publish_time_ns = order_times(
            message.log_time, message.publish_time, log_time_clock
        )
        self._mcap.add_message(
            channel_id, log_time_ns, publish_time_ns, message.sequence, message.data
        )
        self.message_count += 1
        key = self._key_by_channel.get(message.channel_id)
        if self._viewer_messages is not None and key is not None:
            self.message_count += self._viewer_messages.write(
                key, message.data, log_time_ns, publish_time_ns
            )
        if self._file.buffered_bytes > FLUSH_BYTES:
            self._mcap.flush()

    def write_metadata_and_finish(self, metadata: dict[str, object], missing: list[str]) -> None:
        """Write the recorder's metadata and the index, which completes the file.

        Args:
            about: Metadata that the recorder of the original wrote about itself.
            missing: Sentences about what the original has lost, which are stored in the metadata.

        Raises:
            OSError: The disk does not take the bytes.
        """
        if missing:
            metadata = {**metadata, EARLIER_LOSSES_ENTRY: missing}
        self._mcap.add_metadata(
            METADATA_NAME, {name: json.dumps(value) for name, value in metadata.items()}
        )
        self._mcap.finish_file()
