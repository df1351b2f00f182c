"""Bytes on the wire: MessagePack of a message, its name and version in the Zenoh encoding.

`encode` and `MessageDecoder` are pure; the session puts the encoding string on the sample.
"""

from functools import cache
from typing import Any, Generic, TypeVar

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.messages import VERSIONS, ColorImage, CustomSample, DepthImage, Message

MessageT = TypeVar("MessageT", bound=Message)

ENCODING_PREFIX = "application/msgpack;snakesim."
# A world of 4096 obstacles fits; a longer payload is rejected before it is decoded.
MAX_PAYLOAD_BYTES = 1024 * 1024
MAX_IMAGE_BYTES = 4 * 1024 * 1024  # a color image of MAX_PIXELS fits
IMAGE_MESSAGE_TYPES: tuple[type[Message], ...] = (DepthImage, ColorImage)
MAX_DETAIL_LENGTH = 300  # characters of the reason why a payload is malformed
MAX_ENCODING_LENGTH = 80  # characters of a foreign encoding that an error quotes
# Everything that a msgspec decoder raises for untrusted bytes: a payload may be nested too deeply, or not be UTF-8.
UNDECODABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OverflowError, ValueError)

_encoder = msgspec.msgpack.Encoder()
encode = _encoder.encode


class EncodedMessage(msgspec.Struct, frozen=True):
    """A message that has been encoded, and decoded again to check that readers accept it.

    A reader in the same process may use `decoded`: it is what the reader would get from the bytes.
    """

    payload: bytes  # as it is sent
    # Of its own, not the message that was encoded, which its author might still change.
    decoded: Message


def format_encoding(message: type[Message]) -> str:
    """Return the Zenoh encoding of a message type, such as `application/msgpack;snakesim.Clock/1`."""
    known = message
    if issubclass(message, CustomSample):
        # The further fields of a custom message are in the robot's description.
        known = CustomSample
    return f"{ENCODING_PREFIX}{known.__name__}/{VERSIONS[known]}"


class MessageDecoder(Generic[MessageT]):
    """Decodes one message type and rejects everything else with a `WireError`, never another exception."""

    def __init__(self, message: type[MessageT]) -> None:
        self.message = message
        self.encoding = format_encoding(message)
        self._max_bytes = MAX_IMAGE_BYTES if message in IMAGE_MESSAGE_TYPES else MAX_PAYLOAD_BYTES
        self._decoder = msgspec.msgpack.Decoder(message)

    def decode(self, payload: bytes, encoding: str) -> MessageT:
        """Decode a sample.

        Args:
            payload: The bytes of the sample.
            encoding: Zenoh encoding of the sample.

        Raises:
            WireError: The sample is another message, or is malformed. `reason` of the error is a short code.
        """
        if encoding != self.encoding:
            detail = f"got {encoding[:MAX_ENCODING_LENGTH]!r}, want {self.encoding!r}"
            raise WireError(_classify_foreign(encoding, self.encoding), detail)
        return self.decode_payload(payload)

    def decode_payload(self, payload: bytes) -> MessageT:
        """Decode a payload of the right encoding. Raises WireError if it is malformed."""
        if len(payload) > self._max_bytes:
            raise WireError("malformed", f"{len(payload)} bytes, at most {self._max_bytes}")
        try:
            return self._decoder.decode(payload)
        except UNDECODABLE as error:
            detail = str(error)[:MAX_DETAIL_LENGTH]  # it may quote what the sender wrote
            raise WireError("malformed", f"{self.message.__name__}: {detail}") from None


_make_decoder = cache(MessageDecoder[Any])


def get_decoder(message: type[MessageT]) -> MessageDecoder[MessageT]:
    """Return the decoder of a message type. Each is made once in a process, because that takes long."""
    return _make_decoder(message)


def _classify_foreign(received: str, expected: str) -> str:
    """Return the word to count a foreign encoding by: another version of the same message, or another message."""
    same_message = received.rpartition("/")[0] == expected.rpartition("/")[0]
    return "unknown_version" if same_message else "unknown_message"
