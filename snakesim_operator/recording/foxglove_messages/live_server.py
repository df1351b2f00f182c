"""A live server for Foxglove: it sends the messages that a recording gets for viewers, as they are written.

It listens on loopback only, and refuses web pages of other origins.
"""

from collections.abc import Callable, Collection
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from snakesim_hal.base.errors import NotConnectedError
from snakesim_operator.recording.foxglove_messages.origin_relay import (
    HOST,
    OriginRelay,
    choose_random_loopback_host,
)
from snakesim_operator.recording.foxglove_messages.topics import (
    COMMON_TOPICS,
    FoxgloveMessage,
    MessageType,
    make_schema,
    make_topic,
)

if TYPE_CHECKING:
    import foxglove


class FoxgloveLiveServer:
    """Sends messages to every viewer that has subscribed to their topic; a slow viewer loses the oldest."""

    def __init__(
        self, robot: str, port: int, origins: Collection[str], report: Callable[[str], None]
    ) -> None:
        """Start the server with the topics that every robot has.

        Args:
            robot: Name of the robot.
            port: Port on loopback; 0 takes any free one.
            origins: Origins of web pages that may read the robot.
            report: Gets a line of text for each page that was refused.

        Raises:
            NotConnectedError: The port is in use.
        """
        import foxglove  # needs the extra `console`

        self._channel_type = foxglove.Channel
        self._schema_type = foxglove.Schema
        self._context = foxglove.Context()
        self._channel_by_topic: dict[str, foxglove.Channel] = {}
        # Before the first viewer: it would not get a channel that is made while it connects.
        for name, message_type in COMMON_TOPICS.items():
            self._add_channel(make_topic(robot, name), message_type)
        hidden_host = choose_random_loopback_host()
        try:
            self._server = foxglove.start_server(
                name=robot, host=hidden_host, port=0, context=self._context
            )
        except RuntimeError as error:
            raise NotConnectedError(
                f"cannot serve Foxglove: {error}", code="network/port-in-use"
            ) from error
        self._relay = OriginRelay(port, (hidden_host, self._server.port), origins, report)
        self.address = f"ws://{HOST}:{self._relay.port}"

    def send(self, message: FoxgloveMessage, time_ns: int) -> None:
        """Send one message to the viewers. time_ns: robot time."""
        channel = self._channel_by_topic.get(message.topic)
        if channel is None:
            channel = self._add_channel(message.topic, message.message_type)
        channel.log(message.payload, log_time=time_ns)

    def _add_channel(self, topic: str, message_type: MessageType) -> "foxglove.Channel":
        schema = make_schema(message_type)
        channel = self._channel_type(
            topic,
            schema=self._schema_type(
                name=schema.name, encoding=schema.schema_encoding, data=schema.data
            ),
            message_encoding=schema.message_encoding,
            context=self._context,
        )
        self._channel_by_topic[topic] = channel
        return channel

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._relay.close()
        with suppress(RuntimeError):  # it ends with its process in any case
            self._server.stop()
