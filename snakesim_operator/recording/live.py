"""A live server for Foxglove: what a recording holds for it, as it is written. On loopback only, for no other pages."""

from collections.abc import Callable, Collection
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from snakesim_hal.base.errors import NotConnectedError
from snakesim_operator.recording.foxglove import ALWAYS, FoxgloveMessage, Kind, schema_of, topic
from snakesim_operator.recording.origin_relay import HOST, OriginRelay, hidden_host

if TYPE_CHECKING:
    import foxglove


class LiveServer:
    """Hands messages to every viewer that has subscribed to their topic; a slow one loses the oldest."""

    def __init__(self, robot: str, port: int, origins: Collection[str], report: Callable[[str], None]) -> None:
        """port: 0 takes any; origins: of web pages that may read the robot; report: told of those that may not.

        Raises NotConnectedError when the port is in use."""
        import foxglove  # needs the extra `foxglove`

        self._new_channel, self._schema = foxglove.Channel, foxglove.Schema
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        for name, kind in ALWAYS.items():  # before the first viewer: it subscribes in vain to one made as it connects
            self._add(topic(robot, name), kind)
        host = hidden_host()
        try:
            self._server = foxglove.start_server(name=robot, host=host, port=0, context=self._context)
        except RuntimeError as error:
            raise NotConnectedError(f"cannot serve Foxglove: {error}") from error
        self._relay = OriginRelay(port, (host, self._server.port), origins, report)
        self.address = f"ws://{HOST}:{self._relay.port}"

    def show(self, shown: FoxgloveMessage, time_ns: int) -> None:
        """Hand on one message. time_ns: robot time."""
        channel = self._channels.get(shown.topic) or self._add(shown.topic, shown.kind)
        channel.log(shown.payload, log_time=time_ns)

    def _add(self, of: str, kind: Kind) -> "foxglove.Channel":
        name, message_encoding, encoding, data = schema_of(kind)
        schema = self._schema(name=name, encoding=encoding, data=data)
        channel = self._new_channel(of, schema=schema, message_encoding=message_encoding, context=self._context)
        self._channels[of] = channel
        return channel

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._relay.close()
        with suppress(RuntimeError):  # it ends with its process in any case
            self._server.stop()
