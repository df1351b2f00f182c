"""A viewer without a browser: connects to a console as viser's page does, reads all it is sent, and answers in turn."""

import asyncio
import contextlib
import sys
import time
from typing import Any

import msgspec
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from snakesim_testing.harness.wait import TIMEOUT_S

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 3.0),
    "fov": 0.75,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
POLL_S = 0.02
ASKED = "LocalStorageGetItemRequestMessage"
PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


class ConsoleViewer:
    """One page."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._unzip = zstandard.ZstdDecompressor()
        self._of: dict[str, dict[str, Any]] = {}  # what is on the page, by its id

    async def come(self) -> None:
        """Send the first message of a page: from then on it counts as a viewer."""
        await self.send_message(CAMERA)

    async def batch(self) -> list[dict[str, Any]]:
        """The next messages."""
        data = await self._socket.recv()
        assert isinstance(data, bytes)
        size, packed = int.from_bytes(data[:8], "little"), int.from_bytes(data[8:16], "little")
        messages = msgspec.msgpack.decode(self._unzip.decompress(data[16 : 16 + packed], size))[
            "messages"
        ]
        for message in messages:
            if "props" in message and "uuid" in message:
                self._of[message["uuid"]] = dict(message["props"])
            elif "updates" in message and message.get("uuid") in self._of:
                self._of[message["uuid"]] |= message["updates"]
        return messages

    async def answer(self, batch: list[dict[str, Any]]) -> None:
        """Tell the console that a batch has been shown, if it asks."""
        for message in batch:
            if message["type"] == ASKED:
                reported = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
                await self.send_message({"type": "LocalStorageGetItemResponseMessage", **reported})

    async def watch(self) -> None:
        """Show all that comes, until the connection ends."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                await self.answer(await self.batch())

    def has(self, label: str) -> bool:
        """Whether a button, an input or a command with this label is there."""
        return any(props.get("label") == label for props in self._of.values())

    def visible(self, label: str) -> bool:
        """Whether a button or an input with this label is there, and not hidden."""
        return any(
            props.get("label") == label and props.get("visible", True)
            for props in self._of.values()
        )

    def shows(self, text: str) -> bool:
        """Whether a text is on the page, as HTML."""
        return any(text in props.get("content", "") for props in self._of.values())

    async def click(self, button: str) -> None:
        """Press a button."""
        await self.send_message(
            {
                "type": "GuiUpdateMessage",
                "uuid": await self.wait_for_uuid(button),
                "updates": {"value": True},
            }
        )

    async def choose(self, label: str, value: str | bool | int) -> None:
        """Set the value of an input: press a button, choose from a list, or enter a number."""
        await self.send_message(
            {
                "type": "GuiUpdateMessage",
                "uuid": await self.wait_for_uuid(label),
                "updates": {"value": value},
            }
        )

    async def trigger(self, command: str) -> None:
        """Press the key of a command."""
        await self.send_message(
            {"type": "CommandTriggerMessage", "uuid": await self.wait_for_uuid(command)}
        )

    async def wait_for_uuid(self, label: str) -> str:
        """Return the id of the button, input or command with a label, as soon as the page has received it.

        The parts of a page arrive one after another, while `watch` runs. On a busy computer a label that belongs
        together with another one may arrive later.
        """
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            for uuid, props in self._of.items():
                if props.get("label") == label:
                    return uuid
            await asyncio.sleep(POLL_S)
        raise AssertionError(f"no {label!r} on the page within {TIMEOUT_S:g} s")

    async def send_message(self, message: dict[str, Any]) -> None:
        """Send any message."""
        await self._socket.send(msgspec.msgpack.encode(message))


def viewing(address: str) -> connect:
    """The connection of a page; `async with` it."""
    socket = address.replace("http", "ws")
    return connect(
        socket,
        subprotocols=[PROTOCOL],
        compression=None,
        max_size=None,
        proxy=None,
        open_timeout=TIMEOUT_S,
    )


async def watch(address: str) -> None:
    """Look on until the console ends."""
    async with viewing(address) as socket:
        viewer = ConsoleViewer(socket)
        await viewer.come()
        await viewer.watch()


async def watch_together(address: str, count: int) -> None:
    """So many viewers."""
    await asyncio.gather(*[watch(address) for _ in range(count)])


if __name__ == "__main__":
    asyncio.run(watch_together(sys.argv[1], int(sys.argv[2])))
