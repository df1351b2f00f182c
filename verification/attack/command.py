"""Runs the `snakesim` command as a user does, with a home folder of its own.

Each command gets its own folders for state and runtime files, so that it finds no other run of this computer.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from snakesim_testing.harness import command
from snakesim_testing.harness.command import CompletedRun, RunningCommand

COMMAND_TIMEOUT_S = 60.0
# Arguments of `snakesim run` for a robot that holds its pose. 50 Hz gives the longest lease (100 ms), because a busy
# machine may not schedule a process for 50 ms.
HOLD_POSE = ("triplet", "--controller", "hold", "--clock-mode", "realtime", "--set", "rate_hz=50")
# The same for a run that lasts longer than any test, and continues after a stop.
HOLD_POSE_FOR_AN_HOUR = (*HOLD_POSE, "--duration", "3600", "--stay")


def run_snakesim(home: Path, *arguments: str, command_prefix: Sequence[str] = ()) -> CompletedRun:
    """Run a command of `snakesim` until it ends.

    Args:
        home: Home folder of the command, in which it runs.
        *arguments: Arguments of the command.
        command_prefix: Command line that runs it elsewhere, such as in a network namespace.

    Returns:
        Its exit code and output.
    """
    return command.snakesim(
        *arguments,
        cwd=home,
        timeout_s=COMMAND_TIMEOUT_S,
        extra_env=_make_user_environment(home),
        command_prefix=command_prefix,
    )


def start_run(
    home: Path,
    *arguments: str,
    name: str = "run",
    endpoint: str | None = "free",
    command_prefix: Sequence[str] = (),
) -> AbstractContextManager[RunningCommand]:
    """Start `snakesim run` in the background; the context ends all of its processes.

    Args:
        home: Home folder of the command.
        *arguments: Arguments of `snakesim run`.
        name: Name of the folder below home into which the run writes.
        endpoint: Endpoint of its network; "free" for an unused port, None to let the run choose.
        command_prefix: Command line that runs it elsewhere, such as in a network namespace.
    """
    return command.running_snakesim(
        home / name,
        *arguments,
        endpoint=endpoint,
        extra_env=_make_user_environment(home),
        command_prefix=command_prefix,
    )


def _make_user_environment(home: Path) -> dict[str, str]:
    """Return the variables of a user who has not used SnakeSIM yet, and create the folders that they name."""
    environment = {"HOME": str(home)}
    for variable in ("XDG_STATE_HOME", "XDG_RUNTIME_DIR"):
        folder = home / variable.lower()
        folder.mkdir(parents=True, exist_ok=True)
        environment[variable] = str(folder)
    return environment


def parse_endpoint(endpoint: str) -> tuple[str, int]:
    """Return host and port of an endpoint such as `tcp/127.0.0.1:7447`."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return host, int(port)
