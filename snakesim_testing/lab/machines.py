"""Creates the machines of a lab as network namespaces, and links between them.

It needs root, but changes nothing outside of the namespaces. A namespace has no name: it exists as long as a process
in it, and this process ends with the tests. Thus nothing is left.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.arithmetic import SINGLE_THREAD_ENV
from snakesim_hal.base.process import SERVICE_PRIORITY, make_python_command, set_parent_death_signal

NET = "10.78.0"
REAL_TIME_PRIORITY = ("chrt", "--fifo", str(SERVICE_PRIORITY))


class NamespaceMachine:
    """A machine that is a network namespace."""

    def __init__(self, stack: ExitStack, name: str = "a machine") -> None:
        self.name = name
        self._stack = stack
        self._holder = self._start_process(
            ["unshare", "--net", "sh", "-c", "echo ready; exec sleep infinity"]
        )
        assert self._holder.stdout is not None
        assert self._holder.stdout.readline() == b"ready\n"
        self.run("ip", "link", "set", "lo", "up")

    @property
    def pid(self) -> str:
        """Process id of a process in the namespace."""
        return str(self._holder.pid)

    def wrap_command(self, *command: str) -> list[str]:
        """Return a command line that runs a command in this namespace."""
        return ["nsenter", "--target", self.pid, "--net", *command]

    def run(
        self,
        *command: str,
        check: bool = True,
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
    ) -> str:
        """Run a command in the namespace until it ends.

        Args:
            command: The program and its arguments.
            check: Whether to fail if its exit code is not 0.
            cwd: Folder in which it runs; None for the present one.
            env: Variables that are added to the environment.

        Returns:
            Its output, with its exit code at the end.
        """
        completed = subprocess.run(
            self.wrap_command(*command),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            cwd=cwd,
            env={**os.environ, **(env or {})},
        )
        output = completed.stdout
        has_failed = completed.returncode != 0
        assert not (check and has_failed), f"{self.name}: {' '.join(command)}: {output}"
        return f"{output}(exit code {completed.returncode})"

    def start(
        self,
        *command: str,
        log: Path,
        env: Mapping[str, str] | None = None,
        inherits: Sequence[int] = (),
        hurried: bool = False,
    ) -> subprocess.Popen[bytes]:
        """Start a program in the namespace. It ends with this process.

        Args:
            command: The program and its arguments.
            log: File that gets the output.
            env: Variables that are added to the environment.
            inherits: File descriptors that the program inherits.
            hurried: Whether the program gets a real-time priority, as on a machine that has nothing else to do.
        """
        return self._start_process(
            self.wrap_command(*(REAL_TIME_PRIORITY if hurried else ()), *command),
            log,
            env or {},
            inherits,
        )

    def start_module(
        self,
        *module_and_arguments: str,
        log: Path,
        inherits: Sequence[int] = (),
        hurried: bool = False,
    ) -> subprocess.Popen[bytes]:
        """Start a Python module in the namespace, with one thread for numeric libraries. See `start`."""
        return self.start(
            *make_python_command("-m", *module_and_arguments),
            log=log,
            env=SINGLE_THREAD_ENV,
            inherits=inherits,
            hurried=hurried,
        )

    def _start_process(
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
            preexec_fn=lambda: set_parent_death_signal(parent),
        )
        self._stack.callback(_end, process)
        return process

    def set_address(self, interface: str, address: str) -> None:
        """Give an interface an address, and set it up."""
        self.run("ip", "address", "add", address, "dev", interface)
        self.run("ip", "link", "set", interface, "up")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait(10)


def connect_machines(names: Sequence[str], stack: ExitStack) -> dict[str, NamespaceMachine]:
    """Create machines, and connect each by a cable to the first one, which is the only one that they reach.

    Args:
        names: Names of the machines. Their addresses are 10.78.0.1, 10.78.0.2 and so on.
        stack: Ends the machines.

    Returns:
        The machines by name.
    """
    machines = {name: NamespaceMachine(stack, name) for name in names}
    middle = machines[names[0]]
    middle.set_address("lo", f"{NET}.1/32")
    for number, name in enumerate(names[1:], 2):
        machine = machines[name]
        port = f"port{number}"  # end of the cable at the first machine; the other end is `lab0`
        own_address = f"{NET}.{number}"
        middle.run(
            "ip", "link", "add", port, "type", "veth", "peer", "name", "lab0", "netns", machine.pid
        )
        middle.run("ip", "link", "set", port, "up")
        middle.run("ip", "route", "add", own_address, "dev", port, "src", f"{NET}.1")
        machine.set_address("lab0", f"{own_address}/32")
        machine.run("ip", "route", "add", f"{NET}.1", "dev", "lab0", "src", own_address)
    return machines


def connect_by_cable(a: NamespaceMachine, b: NamespaceMachine, name: str, net: str) -> None:
    """Connect two machines by a cable, with the addresses `net`.1 and `net`.2."""
    a.run("ip", "link", "add", name, "type", "veth", "peer", "name", name, "netns", b.pid)
    a.set_address(name, f"{net}.1/24")
    b.set_address(name, f"{net}.2/24")


@dataclass(frozen=True)
class RadioLink:
    """A radio link between two machines whose quality can be changed while it is in use."""

    _relay: subprocess.Popen[bytes]

    def set_quality(
        self, *, loss: float = 0.0, delay_s: float = 0.0, jitter_s: float = 0.0, cut: bool = False
    ) -> None:
        """Set the quality of the link. A property that is not named becomes perfect."""
        assert self._relay.stdin is not None
        order = {"loss": loss, "delay_s": delay_s, "jitter_s": jitter_s, "cut": cut}
        self._relay.stdin.write(json.dumps(order).encode() + b"\n")
        self._relay.stdin.flush()


@contextmanager
def connect_by_radio(
    a: NamespaceMachine, b: NamespaceMachine, name: str, net: str
) -> Iterator[RadioLink]:
    """Connect two machines by a radio link, with the addresses `net`.1 and `net`.2, within the context."""
    command = [sys.executable, "-m", "verification.links.relay", a.pid, b.pid, name]
    relay = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert relay.stdout is not None and relay.stdout.readline() == b"ready\n", (
            "no TAP interface"
        )
        a.set_address(name, f"{net}.1/24")
        b.set_address(name, f"{net}.2/24")
        yield RadioLink(relay)
    finally:
        _end(relay)
