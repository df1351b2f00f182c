"""Makes a whole file of a recording whose recorder was killed: all that can be read of it, and the index."""

from pathlib import Path

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import Writer


def recover(path: Path, out: Path) -> int:
    """Copy the messages that can be read, as they are, into another file. Returns how many."""
    schemas, channels, count = dict[int, int](), dict[int, int](), 0
    with path.open("rb") as source, out.open("wb") as target:
        writer = Writer(target)
        writer.start("snakesim")
        records = StreamReader(source, validate_crcs=True).records
        while True:
            try:
                record = next(records)
            except (StopIteration, EndOfFile, InvalidMagic, McapError, CRCValidationError):
                break
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                schema = schemas.get(record.schema_id, 0)
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
                )
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message):
                writer.add_message(
                    channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
                )
                count += 1
        writer.finish()
    return count
