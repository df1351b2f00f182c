"""Decodes the robot's messages in `mcap`'s own reader: `make_reader(file, decoder_factories=[DecoderFactory()])`."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
from mcap.decoder import DecoderFactory as McapDecoderFactory
from mcap.records import Schema

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.custom_sample import parse_custom_message
from snakesim_hal.wire.messages import VERSIONS

SCHEMA_PREFIX = "snakesim."  # of the names of all schemas of the robot's messages
CUSTOM_SCHEMA_PREFIX = f"{SCHEMA_PREFIX}custom."  # of the schemas of custom sensors


class DecoderFactory(McapDecoderFactory):
    """Decodes the messages of a recording into their structs, and messages unknown to this version into dicts.

    A payload that does not fit its message raises `msgspec.DecodeError`.
    """

    def __init__(self) -> None:
        # By name of the schema.
        self._decoder_by_schema_name: dict[str, msgspec.msgpack.Decoder[Any]] = {}
        for message_type in VERSIONS:
            self._decoder_by_schema_name[f"{SCHEMA_PREFIX}{message_type.__name__}"] = (
                msgspec.msgpack.Decoder(message_type)
            )

    def decoder_for(
        self, message_encoding: str, schema: Schema | None
    ) -> Callable[[bytes], Any] | None:
        """Return the function that decodes the messages of a channel, or None if they are not the robot's messages.

        Args:
            message_encoding: Encoding of the messages: `msgpack`, or `json` for messages made for viewers.
            schema: Schema of the channel; None if it has none.
        """
        if schema is None or not schema.name.startswith(SCHEMA_PREFIX):
            return None
        if message_encoding == "json":  # made for viewers, such as `/planar13/state`
            return msgspec.json.decode
        if schema.name.startswith(CUSTOM_SCHEMA_PREFIX):
            with suppress(WireError):
                custom_type = parse_custom_message(schema.data.decode(errors="replace"))
                return msgspec.msgpack.Decoder(custom_type.message).decode
        decoder = self._decoder_by_schema_name.get(schema.name)
        if decoder is None:
            return msgspec.msgpack.decode
        return decoder.decode
