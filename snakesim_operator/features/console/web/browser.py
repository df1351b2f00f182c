"""What the page server knows about one browser, and the check of each message that it sends."""

import asyncio
import time

from websockets.http11 import Request

from snakesim_hal.base.workers import ErrorReporter
from snakesim_operator.features.console.web.added_html import DARK_COOKIE
from snakesim_operator.features.console.web.admission import ControlAdmission
from snakesim_operator.features.console.web.message_age import MessageAge

MAX_MESSAGES_PER_S = 300.0  # a page sends at most 50 a second of a camera and 20 of a slider
MAX_BURST = 300.0  # messages that may arrive at once after a pause


class BrowserConnection:
    """A browser whose page is open. The event loop of the page server calls its methods."""

    def __init__(self, request: Request, admission: ControlAdmission) -> None:
        """Start without a viewer number. `request` is the one with which the browser opened its websocket."""
        cookies = "; ".join(request.headers.get_all("Cookie"))
        self.prefers_dark = DARK_COOKIE in cookies.split("; ")
        self.age = MessageAge()
        self.viewer: int | None = None  # viser's number of it
        self._loop = asyncio.get_running_loop()
        self._is_numbered = asyncio.Event()
        self._admission = admission
        self._errors = ErrorReporter("a page")
        # Token bucket: the messages that may arrive now, and when that was computed.
        self._allowance = MAX_BURST
        self._allowance_time_s = time.monotonic()

    def note_number(self, viewer_id: int) -> None:
        """Note the number that viser gave this viewer; from any thread."""
        self.viewer = viewer_id
        self._loop.call_soon_threadsafe(self._is_numbered.set)

    async def wait_for_number(self) -> None:
        """Wait until viser has numbered this viewer. Messages cannot be checked before."""
        await self._is_numbered.wait()

    async def wait_for_allowance(self) -> None:
        """Count a message, and wait if the browser sends too many; further messages wait at the sender."""
        now_s = time.monotonic()
        refilled = self._allowance + MAX_MESSAGES_PER_S * (now_s - self._allowance_time_s)
        self._allowance = min(MAX_BURST, refilled) - 1.0
        self._allowance_time_s = now_s
        if self._allowance < 0:
            await asyncio.sleep(-self._allowance / MAX_MESSAGES_PER_S)

    def check_message(self, data: bytes | str) -> bytes | None:
        """Return the message that viser may read; None if it was dropped or handled."""
        try:
            return self._admission.filter_message(self.viewer, data, self.age)
        except Exception as error:  # noqa: BLE001 - a handler has failed, but the next message may be a stop
            self._errors.print_error(error)
            return None

    def drop(self, kind: str, detail: str) -> None:
        """Count something of this browser that is not passed on."""
        self._admission.count_dropped_message(self.viewer, kind, detail)
