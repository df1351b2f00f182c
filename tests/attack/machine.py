"""A machine of its own for runs that choose their ports themselves: a network namespace, with nothing else in it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
# Brings the loopback interface up (SIOCSIFFLAGS), says so, and keeps the namespace until its standard input closes.
KEEPER = """
import fcntl, socket, struct, sys
fcntl.ioctl(socket.socket(), 0x8914, struct.pack("16sH14s", b"lo", 0x41, b""))
print("up", flush=True)
sys.stdin.read()
"""


@dataclass
class Machine:
    """Where commands are run with `prefix`."""

    prefix: tuple[str, ...]
    _frozen: list[int] = field(default_factory=list[int])

    def lifecycles(self, endpoint: str) -> list[str]:
        """Of every robot that shows a status at an endpoint."""
        looked = subprocess.run(
            [*self.prefix, sys.executable, "-m", "tests.attack.means.look", endpoint],
            cwd=REPOSITORY,
            capture_output=True,
            timeout=30,
            check=False,
        )
        return json.loads(looked.stdout or "[]")

    def freeze(self, pid: int) -> None:
        """A process, until this machine is gone."""
        os.kill(pid, signal.SIGSTOP)
        self._frozen.append(pid)

    def thaw(self) -> None:
        """All of them."""
        for pid in self._frozen:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


@contextmanager
def machine_of_its_own() -> Iterator[Machine]:
    """Skips the test where the system allows no namespaces."""
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    try:
        keeper = subprocess.Popen(
            ["unshare", *user, "--net", sys.executable, "-c", KEEPER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    except FileNotFoundError:
        pytest.skip("no network namespace here: there is no `unshare`")
    assert keeper.stdin is not None and keeper.stdout is not None
    said = keeper.stdout.readline().strip()
    if said != "up":
        keeper.kill()
        keeper.wait()
        pytest.skip(f"no network namespace here: {said}")
    into = ["--preserve-credentials", "--user"] if user else []
    machine = Machine(("nsenter", "--target", str(keeper.pid), *into, "--net"))
    try:
        yield machine
    finally:
        machine.thaw()
        keeper.stdin.close()
        keeper.wait()
        keeper.stdout.close()
