"""A page that cannot keep up gets the newest state when it is ready for it, not all states."""

import asyncio
from typing import Any

import viser

from snakesim_testing.operator.served_console import running_console
from snakesim_testing.operator.viewer import STORAGE_REQUEST_TYPE, ConsoleViewer, connect_viewer

CHANGES = 200
LIMIT_S = 20.0


def test_a_slow_page_gets_the_newest_state_only() -> None:
    with running_console() as (server, address):
        text = server.gui.add_text("Tick", "0")

        async def slow() -> list[str]:
            async with connect_viewer(address) as socket:
                viewer = ConsoleViewer(socket)
                await viewer.register_as_viewer()
                changing = asyncio.create_task(_change(text))
                batch = await _until_asked(viewer)
                await changing  # while the page still draws
                last = str(CHANGES - 1)
                seen = list[str]()
                while last not in seen:
                    await viewer.confirm_batch(batch)
                    batch = await _until_asked(viewer)
                    seen += _values(batch)
                return seen

        assert len(asyncio.run(asyncio.wait_for(slow(), LIMIT_S))) < 5


def test_a_page_that_keeps_up_gets_every_change() -> None:
    with running_console() as (server, address):
        text = server.gui.add_text("Tick", "")

        async def quick() -> list[str]:
            async with connect_viewer(address) as socket:
                viewer = ConsoleViewer(socket)
                await viewer.register_as_viewer()
                seen = list[str]()
                for i in range(5):
                    text.value = str(i)
                    while str(i) not in seen:
                        batch = await viewer.receive_batch()
                        await viewer.confirm_batch(batch)
                        seen += _values(batch)
                return seen

        assert asyncio.run(asyncio.wait_for(quick(), LIMIT_S))[-5:] == ["0", "1", "2", "3", "4"]


async def _change(text: viser.GuiTextHandle) -> None:
    for i in range(CHANGES):
        text.value = str(i)
        await asyncio.sleep(0.002)


async def _until_asked(viewer: ConsoleViewer) -> list[dict[str, Any]]:
    """All messages up to the question whether they have been shown."""
    found = list[dict[str, Any]]()
    while not any(message["type"] == STORAGE_REQUEST_TYPE for message in found):
        found += await viewer.receive_batch()
    return found


def _values(batch: list[dict[str, Any]]) -> list[str]:
    updates = [message["updates"] for message in batch if message["type"] == "GuiUpdateMessage"]
    return [update["value"] for update in updates if "value" in update]
