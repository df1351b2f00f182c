"""Repairs a recording that is damaged or has no end: keeps every readable message, adds the index, tells what lacks."""

import json
from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.recording.disk import GrowingFile
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recording import ABOUT, COPIED

FLUSH_BYTES = 4 * 1024 * 1024


def recover(path: Path, out: Path) -> tuple[int, list[str]]:
    """Copy the messages that can be read, as they are, into another file. Raises ConfigError.

    Returns how many, and what the recording lacks, which the copy says too.
    """
    schemas, channels, count = dict[int, int](), dict[int, int](), 0
    try:
        file = GrowingFile(out)
    except OSError as error:
        raise ConfigError(f"{out}: {error.strerror}; choose another file") from error
    copy, reader = McapFile(file), RecordingReader(path)
    try:
        for record in reader.records():
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = copy.add_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                schema = schemas.get(record.schema_id, 0)
                channels[record.id] = copy.add_channel(record.topic, record.message_encoding, schema, record.metadata)
            elif isinstance(record, Metadata) and record.name != ABOUT:
                copy.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                copy.add(channel, record.log_time, record.publish_time, record.sequence, record.data)
                count += 1
                if file.waiting_bytes > FLUSH_BYTES:
                    copy.flush()
        lacks = reader.lacks
        about = {**reader.about, COPIED: lacks} if lacks else reader.about
        copy.add_metadata(ABOUT, {name: json.dumps(value) for name, value in about.items()})
        copy.finish()
    except BaseException:
        out.unlink(missing_ok=True)  # no half copy, that would refuse the next try
        raise
    finally:
        file.close()
    return count, lacks
