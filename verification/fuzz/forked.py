"""Runs the `snakesim` command in forked children, each within limits: many times, for the imports of one process.

python -m verification.fuzz.forked        reads a request a line, as JSON, and answers with what became of it
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

GROWTH_MB = 1200  # of address space, beyond that of the imports: a film's renderer takes most of it
CPU_S = 30
UNTIL = b"console: "  # printed by a command that goes on until it is told to stop


@dataclass(frozen=True)
class CommandOutcome:
    """A command that has ended. code: below 0 for a signal."""

    code: int
    out: str
    err: str
    cpu_s: float
    peak_mb: float


Forked = Callable[..., CommandOutcome]


@contextmanager
def forked(home: Path) -> Iterator[Forked]:
    """What runs a command in a folder to its end; the process that forks lives as long as the context."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "XDG_STATE_HOME": str(home)}
    command = [sys.executable, "-m", "verification.fuzz.forked"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        asked, answers = process.stdin, process.stdout
        assert asked is not None and answers is not None

        def snakesim(cwd: Path, *arguments: str) -> CommandOutcome:
            print(json.dumps([str(cwd), *arguments]), file=asked, flush=True)
            return CommandOutcome(**json.loads(answers.readline()))

        yield snakesim


def main() -> None:
    """Serve requests until the end of the input."""
    import snakesim_operator.playback.control
    import snakesim_operator.playback.export
    import snakesim_operator.playback.play
    import snakesim_operator.results.compare
    import snakesim_operator.results.report  # noqa: F401

    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    for line in sys.stdin:
        cwd, *arguments = json.loads(line)
        folder = Path(cwd)
        child = os.fork()
        if child == 0:
            _be(arguments, folder, used_bytes + GROWTH_MB * 2**20)
        print(json.dumps(_ended(child, folder)), flush=True)


def _be(arguments: list[str], cwd: Path, max_bytes: int) -> None:
    """The command; it ends the process as it would end its own."""
    os.chdir(cwd)
    for descriptor, name in ((0, os.devnull), (1, "out"), (2, "err")):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600), descriptor)
    resource.setrlimit(resource.RLIMIT_AS, (max_bytes, max_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    from snakesim_operator.cli import main as snakesim

    sys.exit(snakesim(arguments))


def _ended(child: int, folder: Path) -> dict[str, object]:
    told = False
    while True:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            out, err = ((folder / name).read_text(errors="replace") for name in ("out", "err"))
            cpu_s, peak_mb = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
            code = os.waitstatus_to_exitcode(status)
            return {"code": code, "out": out, "err": err, "cpu_s": cpu_s, "peak_mb": peak_mb}
        if not told and (folder / "out").exists() and UNTIL in (folder / "out").read_bytes():
            os.kill(child, signal.SIGTERM)
            told = True
        time.sleep(0.005)


if __name__ == "__main__":
    main()
