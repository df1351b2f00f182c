"""What a session hands out: publishers, readers, received samples, and queries that wait for an answer."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.codec import (
    IMAGE_MESSAGE_TYPES,
    EncodedMessage,
    MessageDecoder,
    MessageT,
    encode,
    format_encoding,
)
from snakesim_hal.wire.messages import Answer, Message

READER_DEPTH = 256  # samples; a burst of noise on a key must not displace the valid sample
IMAGES_DEPTH = 32  # samples; images take much memory, and in lockstep a reader may lag by that many


class ReceivedSample(msgspec.Struct, frozen=True):
    """A received sample, not decoded yet."""

    key: str
    payload: bytes
    encoding: str
    monotonic_ns: int

    def decode(self, decoder: MessageDecoder[MessageT]) -> MessageT:
        """Return the message. Raises WireError if it is another one than the decoder's, or malformed."""
        return decoder.decode(self.payload, self.encoding)


class Publisher(Generic[MessageT]):
    """Publishes messages of one type on one key."""

    def __init__(
        self,
        message: type[MessageT],
        send: Callable[[bytes], None],
        has_subscriber: Callable[[], bool],
    ) -> None:
        """Wrap the two functions of a network's publisher.

        Args:
            message: The type of its messages.
            send: Sends bytes as they are, bypassing any reroute.
            has_subscriber: Returns whether the key has a subscriber now.
        """
        self.message = message
        self.send = send
        self.has_subscriber = has_subscriber
        self._put = send

    def put(self, message: MessageT, encoded: EncodedMessage | None = None) -> None:
        """Send a message. Only a publisher that was declared lossless waits for slow subscribers.

        Args:
            message: Message to send.
            encoded: The same message, encoded and checked. None if the publisher has to encode it.
        """
        payload = encode(message) if encoded is None else encoded.payload
        self._put(payload)

    @property
    def is_rerouted(self) -> bool:
        """Whether payloads are passed to another function instead of being sent."""
        return self._put is not self.send

    def reroute(self, put: Callable[[bytes], None] | None) -> None:
        """Pass payloads to `put` instead of sending them; None: send directly again."""
        self._put = self.send if put is None else put


class SampleReader(Generic[MessageT]):
    """Keeps the newest samples of one key. It decodes them when it is called, in the caller's thread."""

    def __init__(self, subscriber: Any, message: type[MessageT], rejected: Counter[str]) -> None:
        """Read from a subscriber; count samples that cannot be decoded into `rejected`, by reason."""
        self.subscriber = subscriber
        self._decoder = MessageDecoder(message)
        self._rejected = rejected

    def drain(self) -> list[MessageT]:
        """Return all samples since the last call, oldest first. Samples that cannot be decoded are dropped."""
        messages: list[MessageT] = []
        for sample in self._pop_samples():
            message = self._decode(sample)
            if message is not None:
                messages.append(message)
        return messages

    def pop_newest(self, is_acceptable: Callable[[MessageT], bool]) -> MessageT | None:
        """Return the newest sample since the last call for which `is_acceptable` is true.

        Earlier samples are dropped without decoding, so that a flood costs little.
        """
        for sample in reversed(self._pop_samples()):
            message = self._decode(sample)
            if message is not None and is_acceptable(message):
                return message
        return None

    def _pop_samples(self) -> list[Any]:
        samples: list[Any] = []
        while (sample := self.subscriber.try_recv()) is not None:
            samples.append(sample)
        return samples

    def _decode(self, sample: Any) -> MessageT | None:
        try:
            return self._decode_sample(sample, self._decoder)
        except WireError as error:
            self._rejected[error.reason] += 1
            return None

    def _decode_sample(self, sample: Any, decoder: MessageDecoder[MessageT]) -> MessageT:
        """Return the message of a sample. Raises WireError."""
        return decoder.decode(sample.payload.to_bytes(), str(sample.encoding))


@dataclass(frozen=True)
class IncomingQuery:
    """A query that waits for its answer."""

    key: str
    payload: bytes
    encoding: str
    _query: Any

    def reply(self, answer: Answer) -> None:
        """Send the answer and close the query. May be called from any thread."""
        self._query.reply(self.key, encode(answer), encoding=format_encoding(Answer))
        self._query.drop()


def get_reader_depth(message: type[Message]) -> int:
    """Return how many samples of a stream a reader keeps."""
    return IMAGES_DEPTH if message in IMAGE_MESSAGE_TYPES else READER_DEPTH
