"""Connects to a console as its page does, sends any message, and sends plain HTTP requests."""

import contextlib
import http.client
import threading
import time
from importlib.metadata import version
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from snakesim_testing.harness.wait import TIMEOUT_S, wait_until

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, 3.0],
    "fov": 0.75,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
STOP = "EMERGENCY STOP  (Esc)"


class ViewerPage:
    """The connection of one viewer to a console. It is closed at the end of the context."""

    def __init__(self, address: str, origin: str | None = None, *, draws: bool = True) -> None:
        """Connect to the page server of a console, as a browser does.

        Args:
            address: Address of the console, http://...
            origin: Origin that the browser names; None for a program that is not a browser.
            draws: Whether the page draws the scene. A page without WebGL does not send where its camera is.

        Raises:
            InvalidStatus: The server refuses the connection.
        """
        self._socket = connect(
            address.replace("http", "ws"),
            origin=None if origin is None else Origin(origin),
            subprotocols=[Subprotocol(f"viser-v{version('viser')}")],
            compression=None,
            max_size=None,
            proxy=None,
            open_timeout=TIMEOUT_S,
        )
        self.controls: dict[str, dict[str, Any]] = {}  # by their id
        self.closed_by: int | None = None
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if draws:
            self.send_message(CAMERA)

    def __enter__(self) -> "ViewerPage":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send_message(self, message: Any) -> None:
        """Send a message. Bytes and text are sent unchanged."""
        raw = message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message)
        with contextlib.suppress(ConnectionClosed):
            self._socket.send(raw)

    def find(self, label: str) -> str:
        """Wait until the page has a control with this label, and return the id of the control."""
        return wait_until(lambda: self._find_control_id(label), f"{label!r} on the page", 60.0)

    def change(self, control: str, updates: Any) -> None:
        """Send new values of the control with this id."""
        self.send_message({"type": "GuiUpdateMessage", "uuid": control, "updates": updates})

    def click(self, label: str) -> None:
        """Press the button with this label."""
        self.change(self.find(label), {"value": True})

    def ended(self) -> int | None:
        """Return the code with which the console has closed the connection, or None if it is open."""
        self._reader.join(10.0)
        return self.closed_by

    def _find_control_id(self, label: str) -> str | None:
        for uuid, props in list(self.controls.items()):  # a copy, because `_read` adds controls
            if props.get("label") == label:
                return uuid
        return None

    def _read(self) -> None:
        decompressor = zstandard.ZstdDecompressor()
        try:
            while True:
                data = self._socket.recv()
                assert isinstance(data, bytes)
                decompressed_size = int.from_bytes(data[:8], "little")
                compressed_size = int.from_bytes(data[8:16], "little")
                compressed = data[16 : 16 + compressed_size]
                batch = decompressor.decompress(compressed, decompressed_size)
                for message in msgspec.msgpack.decode(batch)["messages"]:
                    self._handle_message(message)
        except ConnectionClosed as closed:
            self.closed_by = None if closed.rcvd is None else closed.rcvd.code

    def _handle_message(self, message: dict[str, Any]) -> None:
        if "props" in message and "uuid" in message:
            self.controls[message["uuid"]] = dict(message["props"])
        elif message["type"] == "GuiUpdateMessage":
            self.controls.setdefault(message["uuid"], {}).update(message["updates"])
        elif message["type"] == "LocalStorageGetItemRequestMessage":
            answer = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
            self.send_message({"type": "LocalStorageGetItemResponseMessage", **answer})


def origin_of(address: str) -> str:
    """Return the origin of a page at this address, as its browser sends it."""
    parts = urlsplit(address)
    return f"{parts.scheme}://{parts.netloc}"


def send_http_request(
    address: str, method: str, path: str = "/stop", **headers: str
) -> tuple[int, str]:
    """Send an HTTP request to a console, and return the status and the text of the response.

    Args:
        address: Address of the console, which ends with its token.
        method: The HTTP method.
        path: Path after the token.
        **headers: Headers of the request.
    """
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.netloc, timeout=20.0)
    with contextlib.closing(connection):
        connection.request(method, parts.path.rstrip("/") + path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def flood(address: str, message: Any, seconds: float) -> int:
    """Send one message as often as possible for some seconds, and return how often it was sent."""
    sent = 0
    end_s = time.monotonic() + seconds
    with ViewerPage(address) as page:
        while time.monotonic() < end_s:
            page.send_message(message)
            sent += 1
    return sent
