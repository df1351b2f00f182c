"""A unit test starts no process, opens no socket and waits for nothing: here each of them is an error."""

import sys
import time
from collections.abc import Iterator

import pytest

FORBIDDEN = {
    "subprocess.Popen": "starts a process",
    "os.fork": "starts a process",
    "os.forkpty": "starts a process",
    "os.posix_spawn": "starts a process",
    "os.exec": "starts a process",
    "socket.bind": "opens a socket",
    "socket.connect": "opens a socket",
    "socket.sendto": "opens a socket",
}
MAX_SLEEP_S = 0.02  # threads of a test may wait for each other; nothing waits for time to pass
_running: list[str] = []  # the test that runs; Python calls the hook also between tests


def _refuse(event: str, _arguments: object) -> None:
    if _running and event in FORBIDDEN:
        raise RuntimeError(
            f"{_running[0]} {FORBIDDEN[event]}: such a test belongs into tests/system"
        )


sys.addaudithook(_refuse)


@pytest.fixture(autouse=True)
def pure(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Refuse processes, sockets and sleep while a unit test runs."""
    sleep = time.sleep

    def short_sleep(seconds: float) -> None:
        if seconds > MAX_SLEEP_S:
            raise RuntimeError(
                f"{request.node.nodeid} sleeps {seconds} s: such a test belongs into tests/system"
            )
        sleep(seconds)

    monkeypatch.setattr(time, "sleep", short_sleep)
    _running.append(request.node.nodeid)
    yield
    _running.clear()
