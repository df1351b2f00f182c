"""A headless Chromium, driven over its DevTools protocol: no package is needed but websockets, which viser brings."""

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)
MAX_ERROR_CHARACTERS = 500  # of the text of one error
MISSING = "needs a browser: install the Debian package chromium"
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--disable-renderer-backgrounding",
    "--disable-backgrounding-occluded-windows",
    "--disable-background-timer-throttling",
    "--remote-debugging-port=0",
)
WEBGL_FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_WEBGL_FLAGS = ("--disable-gpu",)  # pages without 3D are drawn about twenty times faster
WINDOW = {"url": "about:blank", "newWindow": True}
START_S, ANSWER_S = 60.0, 60.0


class BrowserTab:
    """One page."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._number = socket, 0
        self.errors: list[str] = []  # of the page's console
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        # A page in the background draws nothing.
        self.send("Emulation.setFocusEmulationEnabled", enabled=True)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol, and its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=ANSWER_S))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        """Store the text of an event of the browser if it reports an error of the page."""
        method = event.get("method")
        params = event.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            error_text = str(details.get("exception", details))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            entry = params["entry"]
            error_text = f"{entry['text']} {entry.get('url', '')}"
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            values = [part.get("value", part.get("description")) for part in params["args"]]
            error_text = " ".join(str(value) for value in values)
        else:
            return
        self.errors.append(error_text[:MAX_ERROR_CHARACTERS])

    def value(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        return self.send("Runtime.evaluate", expression=script, returnByValue=True)["result"].get(
            "value"
        )

    def text(self) -> str:
        """All visible text."""
        return self.value("document.documentElement.innerText") or ""

    def wait_for(self, text: str, limit_s: float = 60.0) -> float:
        """Until the page shows a text; returns how long it took in seconds."""
        began = time.monotonic()
        while text not in (shown := self.text()):
            assert time.monotonic() - began < limit_s, (
                f"{text!r} is not on the page:\n{shown[:3000]}"
            )
            time.sleep(0.02)
        return time.monotonic() - began

    def wait_until_loaded(self, limit_s: float = 60.0) -> None:
        """Until the page's own scripts have run: earlier input is lost."""
        deadline = time.monotonic() + limit_s
        while self.value("document.readyState") != "complete":
            assert time.monotonic() < deadline, "the page does not load"
            time.sleep(0.02)

    def click(self, label: str, hold_s: float = 0.0) -> None:
        """Press and release the element with this label. A disabled button does nothing, as for a person."""
        # Not at a place on the screen, and in one go: the page moves and replaces things while it changes.
        find = f"[...document.querySelectorAll('html *')].findLast(e => e.innerText?.trim() === {json.dumps(label)})"
        event = "{bubbles: true, pointerId: 1, clientX: r.x + 1, clientY: r.y + 1}"
        found = self.send(
            "Runtime.evaluate",
            expression=f"(async () => {{ const e = {find}; if (!e) return false; const r = e.getBoundingClientRect();"
            f"e.dispatchEvent(new PointerEvent('pointerdown', {event}));"
            + (f"await new Promise(done => setTimeout(done, {1000 * hold_s}));" if hold_s else "")
            + f"e.dispatchEvent(new PointerEvent('pointerup', {event})); e.click(); return true; }})()",
            awaitPromise=True,
            returnByValue=True,
        )["result"].get("value")
        assert found, f"no {label!r} on the page:\n{self.text()[:3000]}"

    def type(self, label: str, text: str) -> None:
        """Type a text into the field behind a label, over what is there."""
        assert self.value(
            f"(() => {{ let e = [...document.querySelectorAll('body *')].findLast(e => e.innerText?.trim() === "
            f"{json.dumps(label)}); while (e && !e.querySelector('input[type=text]')) e = e.parentElement;"
            "if (!e) return false; const field = e.querySelector('input[type=text]');"
            "field.focus(); field.select(); return true; })()"
        ), f"no {label!r} on the page:\n{self.text()[:3000]}"
        self.send("Input.insertText", text=text)
        self.value("document.activeElement.blur()")

    def press(self, key: str, code: int, **more: str) -> None:
        """Press a key. more: such as the `text` that it types."""
        for kind, typed in (("keyDown", more), ("keyUp", {})):
            self.send(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=key,
                windowsVirtualKeyCode=code,
                **typed,
            )

    def size(self, width: int, height: int, *, scale: float = 1.0, mobile: bool = False) -> None:
        """The size of the window."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=mobile,
        )

    def picture(self, **more: Any) -> bytes:
        """What it shows, as a PNG. more: for the protocol, such as `clip`."""
        return base64.b64decode(self.send("Page.captureScreenshot", format="png", **more)["data"])


class ChromiumBrowser:
    """A running Chromium."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._sockets: list[ClientConnection] = []

    def open(
        self, address: str, width: int = 1440, height: int = 900, scale: float = 1.0
    ) -> BrowserTab:
        """A new page; each is a viewer of its own."""
        root = f"127.0.0.1:{self._port}/"
        with urllib.request.urlopen(f"http://{root}json/version", timeout=ANSWER_S) as answer:
            whole = self._connect(json.load(answer)["webSocketDebuggerUrl"])
        whole.send(json.dumps({"id": 1, "method": "Target.createTarget", "params": WINDOW}))
        made = json.loads(whole.recv(timeout=ANSWER_S))["result"]["targetId"]
        socket = self._connect(f"ws://{root}devtools/page/{made}")
        tab = BrowserTab(socket)
        tab.size(width, height, scale=scale)
        tab.send("Page.navigate", url=address)
        return tab

    def _connect(self, address: str) -> ClientConnection:
        socket = connect(address, max_size=None, ping_interval=None, proxy=None)
        self._sockets.append(socket)
        return socket

    def close(self) -> None:
        """End all connections."""
        for socket in self._sockets:
            socket.close()


@contextmanager
def open_chromium(*, with_webgl: bool = True) -> Iterator[ChromiumBrowser]:
    """Start a Chromium browser with a profile of its own, and end it with the context.

    Args:
        with_webgl: Whether the browser supports WebGL.
    """
    assert CHROMIUM is not None, MISSING
    flags = (*FLAGS, *(WEBGL_FLAGS if with_webgl else NO_WEBGL_FLAGS))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [CHROMIUM, *flags, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            port_file, deadline = Path(profile) / "DevToolsActivePort", time.monotonic() + START_S
            while not port_file.is_file() or not port_file.read_text().strip():
                assert process.poll() is None and time.monotonic() < deadline, (
                    "chromium did not start"
                )
                time.sleep(0.05)
            browser = ChromiumBrowser(int(port_file.read_text().split()[0]))
            try:
                yield browser
            finally:
                browser.close()
        finally:
            process.terminate()
            process.wait(10)
