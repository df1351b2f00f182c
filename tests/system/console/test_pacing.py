"""A slow console page receives only the newest state when it is ready for it, and a quick page every change."""

import asyncio
from typing import Any

import viser

from snakesim_testing.operator.served_console import running_console
from snakesim_testing.operator.viewer import STORAGE_REQUEST_TYPE, ConsoleViewer, connect_viewer

CHANGES = 200
TIMEOUT_S = 20.0
MAX_SHOWN_BY_SLOW_PAGE = 5


def test_slow_console_page_gets_only_the_newest_state() -> None:
    with running_console() as (server, address):
        text = server.gui.add_text("Tick", "0")

        async def show_slowly() -> list[str]:
            """Draw until all changes have been made, then receive the newest; return the values shown."""
            async with connect_viewer(address) as socket:
                viewer = ConsoleViewer(socket)
                await viewer.register_as_viewer()
                changes = asyncio.create_task(change_text(text))
                batch = await receive_until_confirmation_request(viewer)
                await changes  # The page has not confirmed its first batch yet.
                last_value = str(CHANGES - 1)
                shown = list[str]()
                while last_value not in shown:
                    await viewer.confirm_batch(batch)
                    batch = await receive_until_confirmation_request(viewer)
                    shown += list_values(batch)
                return shown

        shown = asyncio.run(asyncio.wait_for(show_slowly(), TIMEOUT_S))
        assert len(shown) < MAX_SHOWN_BY_SLOW_PAGE


def test_quick_console_page_gets_every_change() -> None:
    with running_console() as (server, address):
        text = server.gui.add_text("Tick", "")

        async def show_quickly() -> list[str]:
            """Confirm every batch at once, and return the values shown."""
            async with connect_viewer(address) as socket:
                viewer = ConsoleViewer(socket)
                await viewer.register_as_viewer()
                shown = list[str]()
                for number in range(5):
                    text.value = str(number)
                    while str(number) not in shown:
                        batch = await viewer.receive_batch()
                        await viewer.confirm_batch(batch)
                        shown += list_values(batch)
                return shown

        shown = asyncio.run(asyncio.wait_for(show_quickly(), TIMEOUT_S))
        assert shown[-5:] == ["0", "1", "2", "3", "4"]


async def change_text(text: viser.GuiTextHandle) -> None:
    """Change the text many times, faster than a slow page draws."""
    for number in range(CHANGES):
        text.value = str(number)
        await asyncio.sleep(0.002)


async def receive_until_confirmation_request(viewer: ConsoleViewer) -> list[dict[str, Any]]:
    """Return all messages up to the request to confirm that they were shown."""
    messages = list[dict[str, Any]]()
    while not any(message["type"] == STORAGE_REQUEST_TYPE for message in messages):
        messages += await viewer.receive_batch()
    return messages


def list_values(batch: list[dict[str, Any]]) -> list[str]:
    """Return the values of the text in a batch of messages."""
    updates = [message["updates"] for message in batch if message["type"] == "GuiUpdateMessage"]
    return [update["value"] for update in updates if "value" in update]
