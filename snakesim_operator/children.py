"""The processes of a run: started together, watched, ended by id, and never left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

STOP_LIMIT_S = 5.0
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Child:
    """One process, and where what it says goes."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def how_it_ended(self) -> str | None:
        """In words; None while it runs."""
        code = self.process.poll()
        if code is None:
            return None
        if code < 0:
            return f"{self.name} was ended by {signal.Signals(-code).name}"
        return f"{self.name} ended with exit code {code}"

    def last_words(self) -> str:
        """The end of what it wrote to stderr."""
        if not self.log.is_file():
            return ""
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return "\n".join(lines[-15:])


def start(name: str, arguments: Sequence[str], log: Path, *, again: bool = False) -> Child:
    """Start a Python module as a child that dies with this process. again: its log goes on.

    It gets a session of its own, so that Ctrl-C reaches only the supervisor, which then ends its children in order.
    """
    environment = {**os.environ, **ONE_THREAD, "PYTHONUNBUFFERED": "1", "PYTHONHASHSEED": "0"}
    with log.open("ab" if again else "wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments, "--parent", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
    return Child(name, process, log)


def ask_to_end(child: Child) -> None:
    """Have a child end in order; one that is frozen must first be thawed."""
    if child.process.poll() is None:
        child.process.send_signal(signal.SIGTERM)
        child.process.send_signal(signal.SIGCONT)


def stop_all(children: Sequence[Child]) -> None:
    """Ask every child to end, wait, then insist. Returns when all are gone."""
    for child in children:
        ask_to_end(child)
    deadline = time.monotonic() + STOP_LIMIT_S
    for child in children:
        try:
            child.process.wait(max(deadline - time.monotonic(), 0.05))
        except subprocess.TimeoutExpired:
            child.process.kill()
            child.process.wait()
