"""Machines of a lab as network namespaces, with cables (veth) to the one in the middle. Needs root.

A namespace has no name: it lives as long as a process in it, and that one ends with this process. Nothing outside is
touched, and nothing is left.
"""

import os
import subprocess
from contextlib import ExitStack
from pathlib import Path

from snakesim_hal.process import die_with_parent

NET = "10.78.0"


class Machine:
    """One network namespace."""

    def __init__(self, name: str, stack: ExitStack) -> None:
        self.name, self._stack = name, stack
        self._holder = self.popen(["unshare", "--net", "sh", "-c", "echo ready; exec sleep infinity"], prefix=[])
        assert self._holder.stdout is not None and self._holder.stdout.readline() == "ready\n"
        self.run("ip", "link", "set", "lo", "up")

    def inside(self) -> list[str]:
        """What runs a command in it."""
        return ["nsenter", "--target", self.pid, "--net"]

    def run(self, *command: str, check: bool = True, cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
        """Run a command in it to its end; what it says."""
        done = subprocess.run(
            [*self.inside(), *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            cwd=cwd,
            env={**os.environ, **(env or {})},
        )
        assert done.returncode == 0 or not check, f"{self.name}: {' '.join(command)}: {done.stdout}"
        return f"{done.stdout}(exit code {done.returncode})"

    def popen(
        self,
        command: list[str],
        *,
        prefix: list[str] | None = None,
        log: Path | None = None,
        env: dict[str, str] | None = None,
    ) -> subprocess.Popen[str]:
        """Start a program in it, that dies with this process."""
        parent = os.getpid()
        output = self._stack.enter_context(log.open("a")) if log is not None else subprocess.PIPE
        process = subprocess.Popen(
            [*(self.inside() if prefix is None else prefix), *command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, **(env or {})},
            preexec_fn=lambda: die_with_parent(parent),
        )
        self._stack.callback(process.wait, 10)
        self._stack.callback(process.kill)
        return process

    @property
    def pid(self) -> str:
        """Of a process in it."""
        return str(self._holder.pid)


def connected(names: list[str], stack: ExitStack) -> dict[str, Machine]:
    """Machines with a cable each to the first one; addresses 10.78.0.1, .2, ... They reach that one alone."""
    machines = {name: Machine(name, stack) for name in names}
    middle = machines[names[0]]
    middle.run("ip", "address", "add", f"{NET}.1/32", "dev", "lo")
    for number, name in enumerate(names[1:], 2):
        machine, port, own = machines[name], f"port{number}", f"{NET}.{number}"
        middle.run("ip", "link", "add", port, "type", "veth", "peer", "name", "lab0", "netns", machine.pid)
        middle.run("ip", "link", "set", port, "up")
        middle.run("ip", "route", "add", own, "dev", port, "src", f"{NET}.1")
        machine.run("ip", "address", "add", f"{own}/32", "dev", "lab0")
        machine.run("ip", "link", "set", "lab0", "up")
        machine.run("ip", "route", "add", f"{NET}.1", "dev", "lab0", "src", own)
    return machines
