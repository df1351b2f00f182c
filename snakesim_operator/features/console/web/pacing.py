"""Sends a viewer no more than its page can show.

A browser reads what it is sent at once, and keeps it until the page has time for it. So a page that draws slowly would
get older and older, and its stop key would wait behind all of it. Here each page is asked, after each batch of news,
to answer when it has come that far; until then news replaces news on this side, as viser does it.
"""

import asyncio
import contextlib
import uuid
from collections.abc import AsyncGenerator, Sequence
from typing import Any

import viser
from viser import _messages as wire  # the request is not public in a form that needs no thread for each viewer

ANSWER_LIMIT_S = 10.0  # a page that does not answer for so long gets one batch in that time
KEY = "snakesim"  # of the browser's storage: never written, only asked for, because viser's page answers that in turn


def pace_pages(server: viser.ViserServer) -> None:
    """From now on, for each page that connects."""
    buffer = server._websock_server.get_message_buffer()
    windows = buffer.window_generator

    def paced(client_id: int, backlog_done_message: Any = None) -> AsyncGenerator[Sequence[Any], None]:
        return _paced(windows(client_id, backlog_done_message), server, client_id)

    buffer.window_generator = paced


async def _paced(
    windows: AsyncGenerator[Sequence[Any], None], server: viser.ViserServer, client_id: int
) -> AsyncGenerator[Sequence[Any], None]:
    try:
        async for window in windows:
            yield window
            page = server.get_clients().get(client_id)
            if page is not None:  # it has drawn once
                await _shown(page)
    finally:
        await windows.aclose()


def ask_page(page: viser.ClientHandle, request: str) -> None:
    """Ask a page to answer once it has handled what it was sent before; from any thread."""
    page._websock_connection.queue_message(wire.LocalStorageGetItemRequestMessage(key=KEY, request_uuid=request))
    page.flush()


async def _shown(page: viser.ClientHandle) -> None:
    """Until the page has shown what it was sent."""
    request, answered = uuid.uuid4().hex, asyncio.Event()

    def receive(_client_id: int, message: wire.LocalStorageGetItemResponseMessage) -> None:
        if message.request_uuid == request:
            answered.set()

    connection = page._websock_connection
    connection.register_handler(wire.LocalStorageGetItemResponseMessage, receive)
    try:
        ask_page(page, request)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(answered.wait(), ANSWER_LIMIT_S)
    finally:
        connection.unregister_handler(wire.LocalStorageGetItemResponseMessage, receive)
