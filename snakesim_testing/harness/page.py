"""A connection to a console as its page opens one, which can send any message; and plain HTTP."""

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
    """One viewer. A context manager."""

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
        """Send a message; bytes and text as they are."""
        raw = message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message)
        with contextlib.suppress(ConnectionClosed):
            self._socket.send(raw)

    def find(self, label: str) -> str:
        """The id of the control with a label, once it is there."""
        return wait_until(lambda: self._find_control_id(label), f"{label!r} on the page", 60.0)

    def change(self, control: str, updates: Any) -> None:
        """Say that a control, by its id, has other values."""
        self.send_message({"type": "GuiUpdateMessage", "uuid": control, "updates": updates})

    def click(self, label: str) -> None:
        """Press a button."""
        self.change(self.find(label), {"value": True})

    def ended(self) -> int | None:
        """The code with which the console suspended up, if it has."""
        self._reader.join(10.0)
        return self.closed_by

    def _find_control_id(self, label: str) -> str | None:
        return next(
            (uuid for uuid, props in list(self.controls.items()) if props.get("label") == label),
            None,
        )

    def _read(self) -> None:
        unzip = zstandard.ZstdDecompressor()
        try:
            while True:
                data = self._socket.recv()
                assert isinstance(data, bytes)
                size, packed = (
                    int.from_bytes(data[:8], "little"),
                    int.from_bytes(data[8:16], "little"),
                )
                for message in msgspec.msgpack.decode(
                    unzip.decompress(data[16 : 16 + packed], size)
                )["messages"]:
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
    """The origin of a page at this address, as its browser sends it."""
    parts = urlsplit(address)
    return f"{parts.scheme}://{parts.netloc}"


def send_http_request(
    address: str, method: str, path: str = "/stop", **headers: str
) -> tuple[int, str]:
    """Status and text of an HTTP request. path: behind the token that ends the address."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.netloc, timeout=20.0)
    with contextlib.closing(connection):
        connection.request(method, parts.path.rstrip("/") + path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def flood(address: str, message: Any, seconds: float) -> int:
    """Send one message over and over; how often it went."""
    sent, end_s = 0, time.monotonic() + seconds
    with ViewerPage(address) as page:
        while time.monotonic() < end_s:
            page.send_message(message)
            sent += 1
    return sent
