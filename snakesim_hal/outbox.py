"""What goes out of the HAL host: a publisher for each key, declared when it is needed first."""

from typing import Any

from snakesim_hal import keys
from snakesim_hal.injection import HAL
from snakesim_hal.messages import Description, Message, Status
from snakesim_hal.session import Publisher, Session


class Outbox:
    """Of one host."""

    def __init__(self, session: Session, description: Description, *, lossless: bool) -> None:
        """Shows the robot, and that its host is there. lossless: wait for slow readers, as in lockstep."""
        self._session, self._lossless = session, lossless
        self._publishers: dict[str, Publisher[Any]] = {keys.STATUS: session.latched_publisher(keys.STATUS, Status)}
        session.latched_publisher(keys.DESCRIPTION, Description).put(description)
        session.declare_alive(HAL)

    def put(self, key: str, message: Message) -> None:
        """Publish it."""
        self._publisher(key, type(message)).put(message)

    def heard(self, key: str, message: type[Message]) -> bool:
        """Whether anybody listens to a key."""
        return self._publisher(key, message).heard()

    def _publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.publisher(key, message, lossless=self._lossless)
        return publisher
