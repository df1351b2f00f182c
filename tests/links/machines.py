"""Machines of a lab as network namespaces, and links between them. Needs root; nothing outside them is touched.

A namespace has no name: it lives as long as a process in it, and that one ends with this process. So nothing is left.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from snakesim_hal.process import SERVICE_PRIORITY


class Machine:
    """One network namespace."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._holder = subprocess.Popen(
            ["unshare", "--net", "sh", "-c", "echo ready; exec cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        stack.callback(_end, self._holder)
        assert self._holder.stdout is not None and self._holder.stdout.readline() == b"ready\n"
        self.run("ip", "link", "set", "lo", "up")

    @property
    def pid(self) -> str:
        """A process in it."""
        return str(self._holder.pid)

    def inside(self, *command: str) -> list[str]:
        """A command that runs in it."""
        return ["nsenter", "--target", self.pid, "--net", *command]

    def run(self, *command: str) -> None:
        """Run a command in it to its end."""
        subprocess.run(self.inside(*command), check=True, capture_output=True, text=True)

    def start(
        self, *module_and_arguments: str, log: str, inherits: Sequence[int] = (), hurried: bool = False
    ) -> subprocess.Popen[bytes]:
        """Start a Python module in it, that dies with this process.

        hurried: before ordinary processes, as on a machine that has nothing else to do.
        """
        priority = ["chrt", "--fifo", str(SERVICE_PRIORITY)] if hurried else []
        with open(log, "ab") as output:  # noqa: PTH123 - a path as text
            process = subprocess.Popen(
                self.inside(*priority, sys.executable, "-m", *module_and_arguments, "--parent", str(os.getpid())),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=inherits,
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        self._stack.callback(_end, process)
        return process

    def address(self, interface: str, address: str) -> None:
        """Give an interface an address, and have it up."""
        self.run("ip", "address", "add", address, "dev", interface)
        self.run("ip", "link", "set", interface, "up")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait(10)


def wire(a: Machine, b: Machine, name: str, net: str) -> None:
    """A cable: `net`.1 at a, `net`.2 at b."""
    a.run("ip", "link", "add", name, "type", "veth", "peer", "name", name, "netns", b.pid)
    a.address(name, f"{net}.1/24")
    b.address(name, f"{net}.2/24")


@dataclass(frozen=True)
class Radio:
    """A link that can be made bad while it is in use."""

    _relay: subprocess.Popen[bytes]

    def make(self, *, loss: float = 0.0, delay_s: float = 0.0, jitter_s: float = 0.0, cut: bool = False) -> None:
        """What is not given is good."""
        assert self._relay.stdin is not None
        order = {"loss": loss, "delay_s": delay_s, "jitter_s": jitter_s, "cut": cut}
        self._relay.stdin.write(json.dumps(order).encode() + b"\n")
        self._relay.stdin.flush()


@contextmanager
def radio(a: Machine, b: Machine, name: str, net: str) -> Iterator[Radio]:
    """Such a link: `net`.1 at a, `net`.2 at b."""
    command = [sys.executable, "-m", "tests.links.relay", a.pid, b.pid, name]
    relay = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert relay.stdout is not None and relay.stdout.readline() == b"ready\n", "no TAP interface"
        a.address(name, f"{net}.1/24")
        b.address(name, f"{net}.2/24")
        yield Radio(relay)
    finally:
        _end(relay)
