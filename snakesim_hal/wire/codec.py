"""Bytes on the wire: MessagePack of a message, its name and version in the Zenoh encoding.

`encode` and `Decoder` are pure; the session puts the encoding string on the sample.
"""

from typing import Generic, TypeVar

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.messages import VERSIONS, ColorImage, DepthImage, Message, OwnSample

MessageT = TypeVar("MessageT", bound=Message)

ENCODING_PREFIX = "application/msgpack;snakesim."
MAX_PAYLOAD_BYTES = 1024 * 1024  # a world of 4096 obstacles fits; longer ones are dropped unread, unless images
MAX_IMAGE_BYTES = 4 * 1024 * 1024  # a color image of the most pixels fits
IMAGES: tuple[type[Message], ...] = (DepthImage, ColorImage)
MAX_WHY = 300  # characters of the reason why a payload is malformed
# Everything that a msgspec decoder raises for untrusted bytes: a payload may be nested too deeply, or not be UTF-8.
UNDECODABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OverflowError, ValueError)

_encoder = msgspec.msgpack.Encoder()
encode = _encoder.encode


def encoding_of(message: type[Message]) -> str:
    """The Zenoh encoding of a message type, such as `application/msgpack;snakesim.Clock/1`."""
    known = OwnSample if issubclass(message, OwnSample) else message  # its further fields are in the description
    return f"{ENCODING_PREFIX}{known.__name__}/{VERSIONS[known]}"


class Decoder(Generic[MessageT]):
    """Decodes one message type and rejects everything else with a `WireError`, never another exception."""

    def __init__(self, message: type[MessageT]) -> None:
        self.message = message
        self.encoding = encoding_of(message)
        self._max_bytes = MAX_IMAGE_BYTES if message in IMAGES else MAX_PAYLOAD_BYTES
        self._decoder = msgspec.msgpack.Decoder(message)

    def decode(self, payload: bytes, encoding: str) -> MessageT:
        """Payload and encoding of a sample -> message. Raises WireError with a reason to count by."""
        if encoding != self.encoding:
            raise WireError(_why_foreign(encoding, self.encoding), f"got {encoding[:80]!r}, want {self.encoding!r}")
        if len(payload) > self._max_bytes:
            raise WireError("malformed", f"{len(payload)} bytes, at most {self._max_bytes}")
        try:
            return self._decoder.decode(payload)
        except UNDECODABLE as error:
            why = str(error)[:MAX_WHY]  # it may quote what the sender wrote
            raise WireError("malformed", f"{self.message.__name__}: {why}") from None


def _why_foreign(got: str, want: str) -> str:
    return "unknown_version" if got.rpartition("/")[0] == want.rpartition("/")[0] else "unknown_message"
