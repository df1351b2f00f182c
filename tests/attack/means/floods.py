"""Floods and occupations of a robot's network, in processes of their own, for as long as a context lives."""

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.attack.command import address
from tests.harness.wait import wait_until

REPOSITORY = Path(__file__).parents[3]
READY_S = 30.0


@contextmanager
def flood(folder: Path, kind: str, endpoint: str, amount: int, processes: int = 1) -> Iterator[list["Flooder"]]:
    """So many processes of one kind of `tests.attack.means.flooder`, ready; killed at the end."""
    started = [Flooder(folder / f"{kind}-{i}.said", kind, endpoint, amount) for i in range(processes)]
    try:
        for flooder in started:
            flooder.is_ready()
        yield started
    finally:
        for flooder in started:
            flooder.kill()


class Flooder:
    """One process."""

    def __init__(self, said: Path, kind: str, endpoint: str, amount: int) -> None:
        self._said = said
        with said.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.attack.means.flooder", kind, endpoint, str(amount)],
                cwd=REPOSITORY,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def is_ready(self) -> None:
        """Wait until it is at work."""
        wait_until(
            lambda: "ready" in self._said.read_text(errors="replace") or self.process.poll() is not None,
            f"{self._said.stem} at work",
            READY_S,
        )
        assert self.process.poll() is None, self._said.read_text()

    def kill(self) -> None:
        """At once; what it had on the network goes with it."""
        self.process.kill()
        self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()


@contextmanager
def half_open(endpoint: str, count: int) -> Iterator[None]:
    """TCP connections on which nothing is ever said, as many as there may be."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            connection = stack.enter_context(socket.socket())
            connection.settimeout(0.5)
            try:
                connection.connect(address(endpoint))
            except OSError:
                break
        yield
