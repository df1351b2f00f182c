"""The `snakesim` command as anybody runs it, with a home of its own."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from snakesim_testing.harness import command
from snakesim_testing.harness.command import CompletedRun
from snakesim_testing.harness.command import RunningCommand as Run

LIMIT_S = 60.0
# 50 Hz has the longest lease, 100 ms: a busy machine may well forget a process for 50 ms.
HOLDING = ("triplet", "--controller", "hold", "--clock-mode", "realtime", "--set", "rate_hz=50")
STANDING = (*HOLDING, "--duration", "3600", "--stay")


def _machine(home: Path) -> dict[str, str]:
    """On which nothing of ours has run yet."""
    folders = {name: home / name.lower() for name in ("XDG_STATE_HOME", "XDG_RUNTIME_DIR")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    return {"HOME": str(home), **{name: str(folder) for name, folder in folders.items()}}


def snakesim(
    home: Path, *arguments: str, limit_s: float = LIMIT_S, inside: Sequence[str] = ()
) -> CompletedRun:
    """Run a command to its end. inside: a prefix that runs it somewhere else."""
    return command.snakesim(
        *arguments, cwd=home, timeout_s=limit_s, extra_env=_machine(home), command_prefix=inside
    )


def running(
    home: Path,
    *arguments: str,
    name: str = "run",
    endpoint: str | None = "free",
    inside: Sequence[str] = (),
) -> AbstractContextManager[Run]:
    """A run in the background, as `snakesim_testing.harness.command.running` has it."""
    return command.running_snakesim(
        home / name, *arguments, endpoint=endpoint, extra_env=_machine(home), command_prefix=inside
    )


def steering(text: str) -> list[str]:
    """What of it a terminal obeys or turns around, but for new lines."""
    return [char for char in text if not char.isprintable() and char != "\n"]


def address(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return host, int(port)
