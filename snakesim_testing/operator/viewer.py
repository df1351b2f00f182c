"""A viewer of the console without a browser.

It connects to a console as viser's page does, reads all messages, and sends the answers that the console waits for.
Run `python -m snakesim_testing.operator.viewer ADDRESS COUNT` to connect COUNT viewers until the console ends.
"""

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
STORAGE_REQUEST_TYPE = "LocalStorageGetItemRequestMessage"
PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


class ConsoleViewer:
    """One page of the console, and the elements that the console has put on it."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._decompressor = zstandard.ZstdDecompressor()
        self._element_by_uuid: dict[str, dict[str, Any]] = {}

    async def register_as_viewer(self) -> None:
        """Send the first message of a page. The console counts the page as a viewer from then on."""
        await self.send_message(CAMERA)

    async def receive_batch(self) -> list[dict[str, Any]]:
        """Wait for the next batch of messages, and update the elements of the page.

        A batch has two lengths of 8 bytes, the decompressed and the compressed one, and then the compressed messages.
        """
        data = await self._socket.recv()
        assert isinstance(data, bytes)
        decompressed_size = int.from_bytes(data[:8], "little")
        compressed_size = int.from_bytes(data[8:16], "little")
        compressed = data[16 : 16 + compressed_size]
        batch = self._decompressor.decompress(compressed, decompressed_size)
        messages = msgspec.msgpack.decode(batch)["messages"]
        for message in messages:
            self._update_elements(message)
        return messages

    def _update_elements(self, message: dict[str, Any]) -> None:
        """Add the element that a message creates, or change the one that it updates."""
        uuid = message.get("uuid")
        if "props" in message and uuid is not None:
            self._element_by_uuid[uuid] = dict(message["props"])
        elif "updates" in message and uuid in self._element_by_uuid:
            self._element_by_uuid[uuid] |= message["updates"]

    async def confirm_batch(self, batch: list[dict[str, Any]]) -> None:
        """Confirm to the console that the page has shown a batch, if the batch contains a request for it."""
        for message in batch:
            if message["type"] == STORAGE_REQUEST_TYPE:
                response = {
                    "type": "LocalStorageGetItemResponseMessage",
                    "value": None,
                    "error": None,
                    "request_uuid": message["request_uuid"],
                }
                await self.send_message(response)

    async def receive_until_closed(self) -> None:
        """Receive and confirm all batches until the connection ends."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                await self.confirm_batch(await self.receive_batch())

    def has_label(self, label: str) -> bool:
        """Return whether the page has a button, an input or a command with this label."""
        return any(props.get("label") == label for props in self._element_by_uuid.values())

    def is_visible(self, label: str) -> bool:
        """Return whether the page has a button or an input with this label that is not hidden."""
        return any(
            props.get("label") == label and props.get("visible", True)
            for props in self._element_by_uuid.values()
        )

    def shows_text(self, text: str) -> bool:
        """Return whether the HTML of the page contains a text."""
        return any(text in props.get("content", "") for props in self._element_by_uuid.values())

    async def click(self, button: str) -> None:
        """Press the button with this label."""
        await self.choose(button, value=True)

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
        """Press the key of the command with this label."""
        await self.send_message(
            {"type": "CommandTriggerMessage", "uuid": await self.wait_for_uuid(command)}
        )

    async def wait_for_uuid(self, label: str) -> str:
        """Return the id of the button, input or command with a label, as soon as the page has received it.

        The parts of a page arrive one after another, while `receive_until_closed` runs. On a busy computer a label
        that belongs together with another one may arrive later.
        """
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            for uuid, props in self._element_by_uuid.items():
                if props.get("label") == label:
                    return uuid
            await asyncio.sleep(POLL_S)
        raise AssertionError(f"no {label!r} on the page within {TIMEOUT_S:g} s")

    async def send_message(self, message: dict[str, Any]) -> None:
        """Send any message to the console."""
        await self._socket.send(msgspec.msgpack.encode(message))


def connect_viewer(address: str) -> connect:
    """Return the connection of a page to the console at this address, for `async with`."""
    socket_address = address.replace("http", "ws")
    return connect(
        socket_address,
        subprotocols=[PROTOCOL],
        compression=None,
        max_size=None,
        proxy=None,
        open_timeout=TIMEOUT_S,
    )


async def watch(address: str) -> None:
    """Connect one viewer, and keep it connected until the console ends."""
    async with connect_viewer(address) as socket:
        viewer = ConsoleViewer(socket)
        await viewer.register_as_viewer()
        await viewer.receive_until_closed()


async def watch_together(address: str, viewer_count: int) -> None:
    """Connect several viewers, and keep them connected until the console ends."""
    await asyncio.gather(*[watch(address) for _ in range(viewer_count)])


if __name__ == "__main__":
    asyncio.run(watch_together(sys.argv[1], int(sys.argv[2])))
