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

PREFIX = "snakesim."  # of the names of all schemas of the robot's messages
CUSTOM_PREFIX = f"{PREFIX}custom."  # of the schemas of custom sensors


class DecoderFactory(McapDecoderFactory):
    """Decodes the messages of a recording into their structs, and messages unknown to this version into dicts.

    A payload that does not fit its message raises `msgspec.DecodeError`.
    """

    def __init__(self) -> None:
        self._decoders: dict[str, msgspec.msgpack.Decoder[Any]] = {}  # by name of the schema
        for message_type in VERSIONS:
            self._decoders[f"{PREFIX}{message_type.__name__}"] = msgspec.msgpack.Decoder(message_type)

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        """Return the decoder of a channel, or None if its messages are none of the robot's."""
        if schema is None or not schema.name.startswith(PREFIX):
            return None
        if message_encoding == "json":  # made for viewers, such as `/planar13/state`
            return msgspec.json.decode
        if schema.name.startswith(CUSTOM_PREFIX):
            with suppress(WireError):
                custom_type = parse_custom_message(schema.data.decode(errors="replace"))
                return msgspec.msgpack.Decoder(custom_type.message).decode
        decoder = self._decoders.get(schema.name)
        if decoder is None:
            return msgspec.msgpack.decode
        return decoder.decode
