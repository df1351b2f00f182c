"""A machine of its own for runs that choose their ports themselves: a network namespace, with nothing else in it.

`python -m verification.attack.machine ENDPOINT` prints the lifecycle of the robot that it finds, as a JSON list.
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

from verification.attack.stranger import NetworkStranger

REPOSITORY = Path(__file__).parents[2]
LOOK_S = 0.6  # a status comes a few times a second
KEEPER = "ip link set lo up && echo up && exec cat"  # keeps the namespace until its standard input closes


def lifecycles(inside: Sequence[str], endpoint: str) -> list[str]:
    """On a machine: of the robot that shows a status at an endpoint, if one does."""
    look = [*inside, sys.executable, "-m", "verification.attack.machine", endpoint]
    looked = subprocess.run(look, cwd=REPOSITORY, capture_output=True, timeout=30, check=False)
    return json.loads(looked.stdout or "[]")


@contextmanager
def machine_of_its_own() -> Iterator[Sequence[str]]:
    """The prefix with which commands are run there. Skips the test where the system allows no namespaces."""
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    with subprocess.Popen(
        ["sh", "-c", 'exec unshare "$@"', "sh", *user, "--net", "sh", "-c", KEEPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as keeper:
        assert keeper.stdout is not None
        said = keeper.stdout.readline().strip()
        if said != "up":
            pytest.skip(f"no network namespace here: {said}")
        into = ["--preserve-credentials", "--user"] if user else []
        yield "nsenter", "--target", str(keeper.pid), *into, "--net"


def main() -> None:
    """Look once; an empty list where nobody shows a status."""
    try:
        with NetworkStranger(sys.argv[1], timeout_s=1.0) as looking:
            looking.receive("hal/status")
            time.sleep(LOOK_S)
            newest = looking.heard("hal/status")[-1:]
    except zenoh.ZError:
        newest = []
    print(json.dumps([heard.message["lifecycle"] for heard in newest]), flush=True)


if __name__ == "__main__":
    main()
