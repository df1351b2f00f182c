"""Repairs a recording whose recorder was killed: keeps every readable message, and adds the index."""

from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema

from snakesim_hal.errors import ConfigError
from snakesim_operator.recording.disk import GrowingFile
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.reader import RecordingReader

FLUSH_BYTES = 4 * 1024 * 1024


def recover(path: Path, out: Path) -> int:
    """Copy the messages that can be read, as they are, into another file. Returns how many. Raises ConfigError."""
    schemas, channels, count = dict[int, int](), dict[int, int](), 0
    try:
        file = GrowingFile(out)
    except OSError as error:
        raise ConfigError(f"{out}: {error.strerror}; choose another file") from error
    copy = McapFile(file)
    try:
        for record in RecordingReader(path).records():
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = copy.add_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                schema = schemas.get(record.schema_id, 0)
                channels[record.id] = copy.add_channel(record.topic, record.message_encoding, schema, record.metadata)
            elif isinstance(record, Metadata):
                copy.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                copy.add(channel, record.log_time, record.publish_time, record.sequence, record.data)
                count += 1
                if file.waiting_bytes > FLUSH_BYTES:
                    copy.flush()
        copy.finish()
    except BaseException:
        out.unlink(missing_ok=True)  # no half copy, that would refuse the next try
        raise
    finally:
        file.close()
    return count
