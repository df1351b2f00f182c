"""Our messages for `mcap`'s own reader: `make_reader(file, decoder_factories=[DecoderFactory()])`."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
from mcap.decoder import DecoderFactory as McapDecoderFactory
from mcap.records import Schema

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.messages import VERSIONS
from snakesim_hal.wire.own_sample import own_kind

PREFIX = "snakesim."
OWN = f"{PREFIX}own."  # of sensors with a message of their own


class DecoderFactory(McapDecoderFactory):
    """Decodes the messages of a recording, as their struct; those that this version does not know, as dict.

    A payload that does not fit its message raises `msgspec.DecodeError`.
    """

    def __init__(self) -> None:
        kinds: dict[str, Any] = {f"{PREFIX}{message.__name__}": message for message in VERSIONS}
        self._decoders = {name: msgspec.msgpack.Decoder(message) for name, message in kinds.items()}

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        """The decoder of a channel; None if it is not one of ours."""
        if schema is None or not schema.name.startswith(PREFIX):
            return None
        if message_encoding == "json":  # made for viewers, such as `/planar13/state`
            return msgspec.json.decode
        if schema.name.startswith(OWN):
            with suppress(WireError):
                return msgspec.msgpack.Decoder(own_kind(schema.data.decode(errors="replace")).message).decode
        known = self._decoders.get(schema.name)
        return msgspec.msgpack.decode if known is None else known.decode
