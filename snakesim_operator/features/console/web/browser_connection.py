"""The connection of one browser: what it sends is checked before viser reads it, and at a bounded rate."""

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from snakesim_hal.base.workers import ErrorReport
from snakesim_operator.features.console.web.admission import Admission
from snakesim_operator.features.console.web.message_age import MessageAge

MAX_MESSAGE_BYTES = 64 * 1024  # of a message: far above any of a page
MOST_HZ = 300.0  # messages; more wait at the sender. A page sends at most 50 of a camera and 20 of a slider a second.
AT_ONCE = 300.0  # after a pause
TOO_BIG = 1009  # code with which a connection is closed


class BrowserConnection(ServerConnection):
    """Without a way around the check."""

    def __init__(self, admission: Admission, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.viewer: int | None = None  # until viser has given it a number
        self.age = MessageAge()
        self._errors = ErrorReport("a page")
        self._admission = admission
        self._allowance, self._since_s = AT_ONCE, time.monotonic()

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that the viewer may send. Raises ConnectionClosed."""
        while True:
            try:
                data = await super().recv(decode)
            except ConnectionClosed as closed:
                if closed.sent is not None and closed.sent.code == TOO_BIG:
                    self._admission.drop(
                        self.viewer, "too long", f"more than {MAX_MESSAGE_BYTES} bytes; its connection was closed"
                    )
                raise
            await self._in_clock_mode()
            try:
                checked = self._admission.check_message(self.viewer, data, self.age)
            except Exception as error:  # noqa: BLE001 - this connection's outermost loop: its next message may be a stop
                self._errors.write(error)
                continue
            if checked is not None:
                return checked

    def recv_streaming(self, decode: bool | None = None) -> AsyncIterator[Any]:
        """Refused: parts of messages cannot be checked."""
        raise NotImplementedError("messages of browsers are read whole")

    async def _in_clock_mode(self) -> None:
        now_s = time.monotonic()
        self._allowance = min(AT_ONCE, self._allowance + MOST_HZ * (now_s - self._since_s)) - 1.0
        self._since_s = now_s
        if self._allowance < 0:
            await asyncio.sleep(-self._allowance / MOST_HZ)
