"""Makes a whole file of a recording whose recorder was killed: all that can be read of it, and the index."""

from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import Writer

from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recording import PROFILE


def recover(path: Path, out: Path) -> int:
    """Copy the messages that can be read, as they are, into another file. Returns how many. Raises ConfigError."""
    schemas, channels, count = dict[int, int](), dict[int, int](), 0
    with out.open("wb") as target:
        writer = Writer(target)
        writer.start(PROFILE)
        for record in RecordingReader(path).records():
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas.get(record.schema_id, 0), record.metadata
                )
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                count += 1
        writer.finish()
    return count
