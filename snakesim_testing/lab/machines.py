"""Machines of a lab as network namespaces, and links between them. Needs root; nothing outside them is touched.

A namespace has no name: it lives as long as a process in it, and that one ends with this process. So nothing is left.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.arithmetic import ONE_THREAD
from snakesim_hal.base.process import SERVICE_PRIORITY, die_with_parent, python_command

NET = "10.78.0"
HURRIED = ("chrt", "--fifo", str(SERVICE_PRIORITY))


class Machine:
    """One network namespace."""

    def __init__(self, stack: ExitStack, name: str = "a machine") -> None:
        self.name, self._stack = name, stack
        self._holder = self._started(["unshare", "--net", "sh", "-c", "echo ready; exec sleep infinity"])
        assert self._holder.stdout is not None
        assert self._holder.stdout.readline() == b"ready\n"
        self.run("ip", "link", "set", "lo", "up")

    @property
    def pid(self) -> str:
        """Of a process in it."""
        return str(self._holder.pid)

    def inside(self, *command: str) -> list[str]:
        """A command that runs in it."""
        return ["nsenter", "--target", self.pid, "--net", *command]

    def run(
        self, *command: str, check: bool = True, cwd: Path | None = None, env: Mapping[str, str] | None = None
    ) -> str:
        """Run a command in it to its end, and return its output."""
        output, env = subprocess.PIPE, {**os.environ, **(env or {})}
        inside = self.inside(*command)
        done = subprocess.run(inside, stdout=output, stderr=subprocess.STDOUT, text=True, check=False, cwd=cwd, env=env)
        assert done.returncode == 0 or not check, f"{self.name}: {' '.join(command)}: {done.stdout}"
        return f"{done.stdout}(exit code {done.returncode})"

    def start(
        self,
        *command: str,
        log: Path,
        env: Mapping[str, str] | None = None,
        inherits: Sequence[int] = (),
        hurried: bool = False,
    ) -> subprocess.Popen[bytes]:
        """Start a program in it, that dies with this process.

        hurried: before ordinary processes, as on a machine that has nothing else to do.
        """
        return self._started(self.inside(*(HURRIED if hurried else ()), *command), log, env or {}, inherits)

    def module(
        self, *module_and_arguments: str, log: Path, inherits: Sequence[int] = (), hurried: bool = False
    ) -> subprocess.Popen[bytes]:
        """The same for a Python module."""
        return self.start(
            *python_command("-m", *module_and_arguments), log=log, env=ONE_THREAD, inherits=inherits, hurried=hurried
        )

    def _started(
        self,
        command: list[str],
        log: Path | None = None,
        env: Mapping[str, str] | None = None,
        keep: Sequence[int] = (),
    ) -> subprocess.Popen[bytes]:
        """Start a program that ends with the tests, also if they are killed.

        Args:
            command: The program and its arguments.
            log: File that gets its output; None: the output can be read from the process.
            env: Variables that are added to its environment.
            keep: File descriptors that it inherits.
        """
        parent = os.getpid()
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if log is None else self._stack.enter_context(log.open("ab")),
            stderr=subprocess.STDOUT,
            pass_fds=keep,
            env={**os.environ, **(env or {})},
            preexec_fn=lambda: die_with_parent(parent),
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


def connected(names: Sequence[str], stack: ExitStack) -> dict[str, Machine]:
    """Machines with a cable each to the first one; addresses 10.78.0.1, .2, ... They reach that one alone."""
    machines = {name: Machine(stack, name) for name in names}
    middle = machines[names[0]]
    middle.address("lo", f"{NET}.1/32")
    for number, name in enumerate(names[1:], 2):
        machine, port, own = machines[name], f"port{number}", f"{NET}.{number}"
        middle.run("ip", "link", "add", port, "type", "veth", "peer", "name", "lab0", "netns", machine.pid)
        middle.run("ip", "link", "set", port, "up")
        middle.run("ip", "route", "add", own, "dev", port, "src", f"{NET}.1")
        machine.address("lab0", f"{own}/32")
        machine.run("ip", "route", "add", f"{NET}.1", "dev", "lab0", "src", own)
    return machines


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
    command = [sys.executable, "-m", "verification.links.relay", a.pid, b.pid, name]
    relay = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert relay.stdout is not None and relay.stdout.readline() == b"ready\n", "no TAP interface"
        a.address(name, f"{net}.1/24")
        b.address(name, f"{net}.2/24")
        yield Radio(relay)
    finally:
        _end(relay)
