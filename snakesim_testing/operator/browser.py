"""Controls a headless Chromium through its DevTools protocol.

The only package that this needs is websockets, which viser installs.
"""

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


def _find_chromium() -> str | None:
    """Return the path of an installed Chromium or Chrome, or None if there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        path = shutil.which(name)
        if path is not None:
            return path
    return None


CHROMIUM = _find_chromium()
MAX_ERROR_CHARACTERS = 500  # an error may contain a whole script
MAX_PAGE_CHARACTERS = 3000  # the part of the page's text that a failure message contains
BROWSER_MISSING = "needs a browser: install the Debian package chromium"
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
NO_WEBGL_FLAGS = ("--disable-gpu",)  # a page without 3D is rendered about twenty times faster
NEW_WINDOW = {"url": "about:blank", "newWindow": True}
START_LIMIT_S = 60.0
ANSWER_LIMIT_S = 60.0
END_LIMIT_S = 10.0
POLL_PERIOD_S = 0.02


class BrowserTab:
    """One page of a browser, and the errors that its console has shown."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._last_request_id = 0
        self.errors: list[str] = []  # texts of the errors in the page's console
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        # Chromium renders nothing of a page that does not have the focus.
        self.send("Emulation.setFocusEmulationEnabled", enabled=True)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol, and return its result."""
        self._last_request_id += 1
        request = {"id": self._last_request_id, "method": method, "params": parameters}
        self._socket.send(json.dumps(request))
        while True:
            message = json.loads(self._socket.recv(timeout=ANSWER_LIMIT_S))
            if message.get("id") == self._last_request_id:
                assert "error" not in message, message
                return message["result"]
            self._record_error(message)

    def _record_error(self, event: dict[str, Any]) -> None:
        """Keep the text of an event of the browser if it reports an error of the page."""
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

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    def read_text(self) -> str:
        """Return all visible text of the page."""
        return self.evaluate("document.documentElement.innerText") or ""

    def wait_for(self, text: str, limit_s: float = 60.0) -> float:
        """Wait until the page shows a text, and return how long that took, in seconds."""
        start_s = time.monotonic()
        while text not in (page_text := self.read_text()):
            is_in_time = time.monotonic() - start_s < limit_s
            assert is_in_time, f"{text!r} is not on the page:\n{page_text[:MAX_PAGE_CHARACTERS]}"
            time.sleep(POLL_PERIOD_S)
        return time.monotonic() - start_s

    def wait_until_loaded(self, limit_s: float = 60.0) -> None:
        """Wait until the scripts of the page have run. The page loses earlier input."""
        deadline = time.monotonic() + limit_s
        while self.evaluate("document.readyState") != "complete":
            assert time.monotonic() < deadline, f"the page did not load within {limit_s:g} s"
            time.sleep(POLL_PERIOD_S)

    def click(self, label: str, hold_s: float = 0.0) -> None:
        """Press and release the element with this label. A disabled button does nothing, as for a person.

        Args:
            label: The text of the element. The last element with this text is clicked.
            hold_s: How long the element stays pressed.
        """
        # One script finds the element and clicks it: the page moves and replaces elements while it changes.
        text = json.dumps(label)
        find = f"[...document.querySelectorAll('html *')].findLast(e => e.innerText?.trim() === {text})"
        event = "{bubbles: true, pointerId: 1, clientX: r.x + 1, clientY: r.y + 1}"
        hold = ""
        if hold_s:
            hold = f"await new Promise(done => setTimeout(done, {1000 * hold_s}));"
        script = (
            f"(async () => {{ const e = {find}; if (!e) return false; const r = e.getBoundingClientRect();"
            f"e.dispatchEvent(new PointerEvent('pointerdown', {event}));"
            f"{hold}"
            f"e.dispatchEvent(new PointerEvent('pointerup', {event})); e.click(); return true; }})()"
        )
        answer = self.send(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        self._assert_label_exists(label, was_found=answer["result"].get("value"))

    def enter_text(self, label: str, text: str) -> None:
        """Replace the text in the input field that belongs to a label."""
        was_found = self.evaluate(
            f"(() => {{ let e = [...document.querySelectorAll('body *')].findLast(e => e.innerText?.trim() === "
            f"{json.dumps(label)}); while (e && !e.querySelector('input[type=text]')) e = e.parentElement;"
            "if (!e) return false; const field = e.querySelector('input[type=text]');"
            "field.focus(); field.select(); return true; })()"
        )
        self._assert_label_exists(label, was_found=was_found)
        self.send("Input.insertText", text=text)
        self.evaluate("document.activeElement.blur()")

    def _assert_label_exists(self, label: str, *, was_found: bool) -> None:
        assert was_found, f"no {label!r} on the page:\n{self.read_text()[:MAX_PAGE_CHARACTERS]}"

    def press_key(self, key: str, code: int, **key_down: str) -> None:
        """Press and release a key.

        Args:
            key: Name of the key.
            code: Windows code of the key.
            **key_down: Further parameters of the press, such as the `text` that the key enters.
        """
        for event_type, parameters in (("keyDown", key_down), ("keyUp", {})):
            self.send(
                "Input.dispatchKeyEvent",
                type=event_type,
                key=key,
                code=key,
                windowsVirtualKeyCode=code,
                **parameters,
            )

    def set_window_size(
        self, width: int, height: int, *, scale: float = 1.0, mobile: bool = False
    ) -> None:
        """Set the size of the window in CSS pixels, and the screen pixels for each of them."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=mobile,
        )

    def capture_screenshot(self, **parameters: Any) -> bytes:
        """Return a picture of the page as a PNG file.

        Args:
            **parameters: Further parameters of the command captureScreenshot of DevTools, such as `clip`.
        """
        answer = self.send("Page.captureScreenshot", format="png", **parameters)
        return base64.b64decode(answer["data"])


class ChromiumBrowser:
    """A running Chromium, and the connections to its pages."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._sockets: list[ClientConnection] = []

    def open_page(
        self, address: str, width: int = 1440, height: int = 900, scale: float = 1.0
    ) -> BrowserTab:
        """Open an address in a new page. The console counts each page as a viewer."""
        root = f"127.0.0.1:{self._port}/"
        with urllib.request.urlopen(f"http://{root}json/version", timeout=ANSWER_LIMIT_S) as answer:
            browser_socket = self._connect(json.load(answer)["webSocketDebuggerUrl"])
        request = {"id": 1, "method": "Target.createTarget", "params": NEW_WINDOW}
        browser_socket.send(json.dumps(request))
        answer = json.loads(browser_socket.recv(timeout=ANSWER_LIMIT_S))
        target_id = answer["result"]["targetId"]
        tab = BrowserTab(self._connect(f"ws://{root}devtools/page/{target_id}"))
        tab.set_window_size(width, height, scale=scale)
        tab.send("Page.navigate", url=address)
        return tab

    def _connect(self, address: str) -> ClientConnection:
        socket = connect(address, max_size=None, ping_interval=None, proxy=None)
        self._sockets.append(socket)
        return socket

    def close(self) -> None:
        """Close all connections to the browser."""
        for socket in self._sockets:
            socket.close()


@contextmanager
def open_chromium(*, with_webgl: bool = True) -> Iterator[ChromiumBrowser]:
    """Start a Chromium browser with a profile of its own, and end it with the context.

    Args:
        with_webgl: Whether the browser supports WebGL.
    """
    assert CHROMIUM is not None, BROWSER_MISSING
    webgl_flags = WEBGL_FLAGS if with_webgl else NO_WEBGL_FLAGS
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [CHROMIUM, *FLAGS, *webgl_flags, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            browser = ChromiumBrowser(_wait_for_port(process, Path(profile)))
            try:
                yield browser
            finally:
                browser.close()
        finally:
            process.terminate()
            process.wait(END_LIMIT_S)


def _wait_for_port(process: "subprocess.Popen[bytes]", profile: Path) -> int:
    """Return the port of the DevTools protocol as soon as the browser has written it into its profile."""
    port_file = profile / "DevToolsActivePort"
    deadline = time.monotonic() + START_LIMIT_S
    while not port_file.is_file() or not port_file.read_text().strip():
        assert process.poll() is None, "chromium ended before it was ready"
        assert time.monotonic() < deadline, f"chromium did not start within {START_LIMIT_S:g} s"
        time.sleep(POLL_PERIOD_S)
    return int(port_file.read_text().split()[0])
