"""Floods and occupations of a robot's network, in processes of their own, for as long as a context lives."""

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from snakesim_testing.harness.page import origin_of
from snakesim_testing.harness.wait import wait_until
from verification.attack.command import address

REPOSITORY = Path(__file__).parents[3]
READY_S = 30.0


@contextmanager
def flood(
    folder: Path, kind: str, endpoint: str, amount: int, process_count: int = 1
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """So many processes of one kind of `verification.attack.means.flooder`, at work; killed at the end."""
    command = [
        sys.executable,
        "-m",
        "verification.attack.means.flooder",
        kind,
        endpoint,
        str(amount),
    ]
    logs = [folder / f"{kind}-{i}.printed" for i in range(process_count)]
    with contextlib.ExitStack() as stack:
        started: list[subprocess.Popen[bytes]] = []
        for log in logs:
            output = stack.enter_context(log.open("wb"))
            process = subprocess.Popen(
                command,
                cwd=REPOSITORY,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
            started.append(stack.enter_context(process))
            stack.callback(process.kill)

        def at_work() -> bool:
            assert all(process.poll() is None for process in started), [
                log.read_text() for log in logs
            ]
            return all("ready" in log.read_text(errors="replace") for log in logs)

        wait_until(at_work, f"{kind} at work", READY_S)
        yield started


@contextmanager
def half_sent(console: str, count: int, process_count: int) -> Iterator[None]:
    """Half-sent HTTP requests at a console, so many of each process, held open for as long as the context lives."""
    host, port = address(origin_of(console).replace("http://", "tcp/"))
    command = [
        sys.executable,
        "-m",
        "verification.attack.means.half_sent",
        host,
        str(port),
        str(count),
    ]
    with contextlib.ExitStack() as stack:
        started: list[subprocess.Popen[bytes]] = []
        for _ in range(process_count):
            process = subprocess.Popen(
                command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            started.append(stack.enter_context(process))
            stack.callback(process.kill)
        for process in started:
            assert process.stdout is not None
            assert process.stdout.readline().startswith(b"ready")
        yield


def end(process: subprocess.Popen[bytes]) -> None:
    """At once; what it had on the network goes with it."""
    process.kill()
    process.wait()


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
