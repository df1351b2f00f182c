"""Kills and freezes processes."""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager


def kill_process(process: subprocess.Popen[bytes]) -> None:
    """Kill a process at once; its sessions, subscribers and connections end with it."""
    process.kill()
    process.wait()


@contextmanager
def freeze_process(process_id: int) -> Iterator[None]:
    """Stop a process for as long as the context is open."""
    os.kill(process_id, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process_id, signal.SIGCONT)
