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

MAX_MESSAGE_BYTES = 64 * 1024  # far above any message of a page
MAX_MESSAGES_PER_S = 300.0  # a page sends at most 50 a second of a camera and 20 of a slider
MAX_BURST = 300.0  # messages that may arrive at once after a pause
MESSAGE_TOO_BIG = 1009  # code with which a websocket is closed


class BrowserConnection(ServerConnection):
    """A websocket whose messages viser cannot read without the check of `admission`.

    The event loop of viser's server calls every method.
    """

    def __init__(self, admission: Admission, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.viewer: int | None = None  # None until viser has given the viewer a number
        self.age = MessageAge()
        self._admission = admission
        self._errors = ErrorReport("a page")
        # Token bucket: the messages that may arrive now, and when that was computed.
        self._allowance = MAX_BURST
        self._allowance_time_s = time.monotonic()

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that viser may read. Messages that are dropped or handled elsewhere are skipped.

        Raises:
            ConnectionClosed: The page is closed, or its message was too long.
        """
        while True:
            data = await self._receive_any(decode)
            await self._wait_for_allowance()
            try:
                checked = self._admission.check_message(self.viewer, data, self.age)
            except Exception as error:  # noqa: BLE001 - this connection's outermost loop: its next message may be a stop
                self._errors.write(error)
                continue
            if checked is not None:
                return checked

    async def _receive_any(self, decode: bool | None) -> Any:
        """Return the next message of the browser; count it as dropped if it closes the connection by its length."""
        try:
            return await super().recv(decode)
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code == MESSAGE_TOO_BIG:
                detail = f"more than {MAX_MESSAGE_BYTES} bytes; its connection was closed"
                self._admission.drop(self.viewer, "too long", detail)
            raise

    def recv_streaming(self, decode: bool | None = None) -> AsyncIterator[Any]:
        """Refuse: a part of a message cannot be checked."""
        raise NotImplementedError("messages of browsers are read whole")

    async def _wait_for_allowance(self) -> None:
        """Count a message, and wait if the browser sends too many; further messages wait at the sender."""
        now_s = time.monotonic()
        refilled = self._allowance + MAX_MESSAGES_PER_S * (now_s - self._allowance_time_s)
        self._allowance = min(MAX_BURST, refilled) - 1.0
        self._allowance_time_s = now_s
        if self._allowance < 0:
            await asyncio.sleep(-self._allowance / MAX_MESSAGES_PER_S)
