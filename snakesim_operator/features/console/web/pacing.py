"""Sends a viewer no more than its page can show.

A browser accepts everything at once, and keeps it until the page has time for it. So what a slow page shows would
become older and older, and its stop key would wait behind all of it. Therefore the server asks each page, after each
batch of changes, to answer when it has shown them. Until then newer values replace older ones on the server, as they
do within viser.
"""

import asyncio
import contextlib
import uuid
from collections.abc import AsyncGenerator, Sequence
from typing import Any

import viser

# The request is not public in a form that needs no thread for each viewer.
from viser import _messages as wire

ANSWER_LIMIT_S = 10.0  # a page that does not answer gets one batch in this time
STORAGE_KEY = "snakesim"  # never written, only read: viser's page answers such a request after all earlier messages

Batches = AsyncGenerator[Sequence[Any], None]


def pace_pages(server: viser.ViserServer) -> None:
    """Pace each page that connects from now on."""
    buffer = server._websock_server.get_message_buffer()
    generate_batches = buffer.window_generator

    def generate_paced_batches(client_id: int, backlog_done_message: Any = None) -> Batches:
        return _pace_batches(generate_batches(client_id, backlog_done_message), server, client_id)

    buffer.window_generator = generate_paced_batches


async def _pace_batches(batches: Batches, server: viser.ViserServer, client_id: int) -> Batches:
    """Yield each batch for a viewer once its page has shown the one before."""
    try:
        async for batch in batches:
            yield batch
            page = server.get_clients().get(client_id)
            if page is not None:  # None until the page has drawn the scene once
                await _wait_until_shown(page)
    finally:
        await batches.aclose()


def ask_page(page: viser.ClientHandle, request_uuid: str) -> None:
    """Ask a page to answer once it has handled what it was sent before; from any thread."""
    request = wire.LocalStorageGetItemRequestMessage(key=STORAGE_KEY, request_uuid=request_uuid)
    page._websock_connection.queue_message(request)
    page.flush()


async def _wait_until_shown(page: viser.ClientHandle) -> None:
    """Wait until a page has shown what it was sent, or ANSWER_LIMIT_S has passed."""
    request_uuid = uuid.uuid4().hex
    is_answered = asyncio.Event()

    def on_answer(_client_id: int, message: wire.LocalStorageGetItemResponseMessage) -> None:
        if message.request_uuid == request_uuid:
            is_answered.set()

    connection = page._websock_connection
    connection.register_handler(wire.LocalStorageGetItemResponseMessage, on_answer)
    try:
        ask_page(page, request_uuid)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(is_answered.wait(), ANSWER_LIMIT_S)
    finally:
        connection.unregister_handler(wire.LocalStorageGetItemResponseMessage, on_answer)
