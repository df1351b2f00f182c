"""Runs commands in a network namespace, where a run chooses its ports alone as on a computer of its own.

`python -m verification.attack.network_namespace ENDPOINT` prints the lifecycle state of the robot at an endpoint as
JSON, or `null` if no robot publishes a status there. `read_lifecycle` calls it inside the namespace.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from verification.attack.client import NetworkClient

REPOSITORY = Path(__file__).parents[2]
LISTEN_DURATION_S = 0.6  # a host publishes several statuses a second
# Keeps the namespace alive until its standard input is closed.
KEEPER_SCRIPT = "ip link set lo up && echo up && exec cat"


@contextmanager
def create_network_namespace() -> Iterator[Sequence[str]]:
    """Create a network namespace with a loopback interface and nothing else.

    The test is skipped if the system allows no namespaces.

    Yields:
        Command line prefix that runs a command in the namespace.
    """
    user_options: list[str] = []
    enter_options: list[str] = []
    if os.geteuid() != 0:
        user_options = ["--user", "--map-root-user"]
        enter_options = ["--preserve-credentials", "--user"]
    unshare = ["sh", "-c", 'exec unshare "$@"', "sh", *user_options, "--net"]
    with subprocess.Popen(
        [*unshare, "sh", "-c", KEEPER_SCRIPT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as keeper:
        assert keeper.stdout is not None
        first_line = keeper.stdout.readline().strip()
        if first_line != "up":
            pytest.skip(f"this system allows no network namespace: {first_line}")
        yield "nsenter", "--target", str(keeper.pid), *enter_options, "--net"


def read_lifecycle(command_prefix: Sequence[str], endpoint: str) -> str | None:
    """Return the lifecycle state of the robot at an endpoint in a namespace.

    Args:
        command_prefix: Command line prefix that runs a command in the namespace.
        endpoint: Endpoint of the robot's network.

    Returns:
        The state, or None if no robot publishes a status there.
    """
    module = "verification.attack.network_namespace"
    completed = subprocess.run(
        [*command_prefix, sys.executable, "-m", module, endpoint],
        cwd=REPOSITORY,
        capture_output=True,
        timeout=30,
        check=False,
    )
    return json.loads(completed.stdout or "null")


def main() -> None:
    """Print the lifecycle state in the newest status of the robot at the endpoint."""
    lifecycle: str | None = None
    try:
        with NetworkClient(sys.argv[1], timeout_s=1.0) as client:
            client.subscribe("hal/status")
            time.sleep(LISTEN_DURATION_S)
            statuses = client.list_messages("hal/status")
            if statuses:
                lifecycle = statuses[-1]["lifecycle"]
    except zenoh.ZError:
        pass  # nothing listens at the endpoint
    print(json.dumps(lifecycle), flush=True)


if __name__ == "__main__":
    main()
