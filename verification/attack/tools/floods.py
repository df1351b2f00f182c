"""Floods the network of a robot, or occupies its connections, for as long as a context is open."""

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from snakesim_testing.harness.page import origin_of
from snakesim_testing.harness.wait import wait_until
from verification.attack.command import parse_endpoint

REPOSITORY = Path(__file__).parents[3]
READY_TIMEOUT_S = 30.0
CONNECT_TIMEOUT_S = 0.5


@contextmanager
def run_flooders(
    folder: Path, kind: str, endpoint: str, amount: int, process_count: int = 1
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run processes of `verification.attack.tools.flooder`, which are killed at the end.

    Args:
        folder: Folder into which their output is written.
        kind: What each process does: a key of `flooder.KINDS`.
        endpoint: Endpoint of the robot's network.
        amount: Argument of each process, such as a rate.
        process_count: Number of processes.

    Yields:
        The processes, each of which has printed "ready".
    """
    module = "verification.attack.tools.flooder"
    command = [sys.executable, "-m", module, kind, endpoint, str(amount)]
    logs = [folder / f"{kind}-{i}.printed" for i in range(process_count)]
    with contextlib.ExitStack() as stack:
        processes: list[subprocess.Popen[bytes]] = []
        for log in logs:
            output = stack.enter_context(log.open("wb"))
            process = subprocess.Popen(
                command,
                cwd=REPOSITORY,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
            processes.append(stack.enter_context(process))
            stack.callback(process.kill)

        def are_ready() -> bool:
            texts = [log.read_text(errors="replace") for log in logs]
            assert all(process.poll() is None for process in processes), texts
            return all("ready" in text for text in texts)

        wait_until(are_ready, f"all flooders of kind {kind!r} ready", READY_TIMEOUT_S)
        yield processes


@contextmanager
def hold_half_sent_requests(console_address: str, count: int, process_count: int) -> Iterator[None]:
    """Keep half-sent HTTP requests open at a console.

    Args:
        console_address: Address of the console, http://...
        count: Number of requests of each process.
        process_count: Number of processes of `verification.attack.tools.half_sent_requests`.
    """
    host, port = parse_endpoint(origin_of(console_address).replace("http://", "tcp/"))
    module = "verification.attack.tools.half_sent_requests"
    command = [sys.executable, "-m", module, host, str(port), str(count)]
    with contextlib.ExitStack() as stack:
        processes: list[subprocess.Popen[bytes]] = []
        for _ in range(process_count):
            process = subprocess.Popen(
                command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            processes.append(stack.enter_context(process))
            stack.callback(process.kill)
        for process in processes:
            assert process.stdout is not None
            assert process.stdout.readline().startswith(b"ready")
        yield


@contextmanager
def open_silent_connections(endpoint: str, count: int) -> Iterator[None]:
    """Open TCP connections without sending anything on them, until the endpoint accepts no more.

    Args:
        endpoint: Endpoint of the robot's network.
        count: Maximum number of connections.
    """
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            connection = stack.enter_context(socket.socket())
            connection.settimeout(CONNECT_TIMEOUT_S)
            try:
                connection.connect(parse_endpoint(endpoint))
            except OSError:
                break
        yield
