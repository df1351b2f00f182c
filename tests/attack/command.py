"""The `snakesim` command as anybody runs it, in processes of its own, with a home of its own."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.harness.endpoint import free_endpoint
from tests.harness.processes import parts_of, processes_of
from tests.harness.wait import wait_until

SNAKESIM = str(Path(sys.executable).with_name("snakesim"))
LIMIT_S = 60.0
TOO_LONG = 124  # as timeout(1) has it: no exit code of ours
# 50 Hz has the longest lease, 100 ms: a busy machine may well forget a process for 50 ms.
STANDING = (
    *("triplet", "--controller", "hold", "--pace", "realtime", "--set", "rate_hz=50"),
    *("--duration", "3600", "--stay"),
)
CONTROL_CHARACTERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


@dataclass(frozen=True)
class Ended:
    """A finished command."""

    code: int
    said: str
    took_s: float


def environment(home: Path) -> dict[str, str]:
    """Of a machine on which nothing of ours has run yet."""
    for folder in ("state", "runtime"):
        (home / folder).mkdir(parents=True, exist_ok=True)
    return {
        **os.environ,
        "HOME": str(home),
        "XDG_STATE_HOME": str(home / "state"),
        "XDG_RUNTIME_DIR": str(home / "runtime"),
        "PYTHONUNBUFFERED": "1",
    }


def snakesim(home: Path, *arguments: str, limit_s: float = LIMIT_S, inside: Sequence[str] = ()) -> Ended:
    """Run a command to its end. inside: a prefix that runs it somewhere else."""
    home.mkdir(exist_ok=True)
    began = time.monotonic()
    try:
        done = subprocess.run(
            [*inside, SNAKESIM, *arguments],
            cwd=home,
            env=environment(home),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired as late:
        said = (late.stdout or b"").decode(errors="replace")
        return Ended(TOO_LONG, f"{said}\n[did not end within {limit_s:g} s]", limit_s)
    return Ended(done.returncode, done.stdout.decode(errors="replace"), time.monotonic() - began)


@dataclass(frozen=True)
class Run:
    """A `snakesim run` that goes on."""

    process: subprocess.Popen[bytes]
    home: Path
    out: Path
    asked_endpoint: str | None
    inside: Sequence[str] = ()

    @property
    def endpoint(self) -> str:
        """Where its network meets, as it says."""
        if self.asked_endpoint is not None:
            return self.asked_endpoint
        self.says("network: ")
        found = re.search(r"network: (\S+?),", self.said())
        assert found is not None, self.said()
        return found[1]

    def said(self) -> str:
        """All that it has printed."""
        return self.out.with_suffix(".said").read_text(encoding="utf-8", errors="replace")

    def says(self, text: str, limit_s: float = LIMIT_S) -> None:
        """Wait until it has said something."""
        wait_until(lambda: text in self.said() or self.process.poll() is not None, f"{text!r} from the run", limit_s)
        assert text in self.said(), f"the run ended with {self.process.returncode}: {self.said()[-2000:]}"

    def tell(self, *arguments: str, limit_s: float = LIMIT_S) -> Ended:
        """A tool of the same machine, told where this run is."""
        return snakesim(self.home, *arguments, "--endpoint", self.endpoint, limit_s=limit_s, inside=self.inside)

    def part(self, name: str) -> int:
        """Process id of one of its processes: host, guidance, navigation, control."""
        return parts_of(self.out)[name]

    def parts(self) -> dict[str, int]:
        """Process ids of those of its host and services that live."""
        own = ("host", "guidance", "navigation", "control")
        return {name: pid for name, pid in parts_of(self.out).items() if name in own}

    def wait(self, limit_s: float = LIMIT_S) -> int:
        """Its exit code."""
        return self.process.wait(limit_s)

    def interrupt(self, limit_s: float = LIMIT_S) -> int:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        return self.wait(limit_s)


@contextmanager
def running(
    home: Path, *arguments: str, name: str = "run", endpoint: str | None = "free", inside: Sequence[str] = ()
) -> Iterator[Run]:
    """A run in the background, killed at the end if it is still there.

    endpoint: given to it; "free" for a port that nobody has, None to leave the choice to it.
    """
    asked = free_endpoint() if endpoint == "free" else endpoint
    home.mkdir(exist_ok=True)
    out = home / name
    network = ["--endpoint", asked] if asked is not None and "--router" not in arguments else []
    with out.with_suffix(".said").open("wb") as said:
        process = subprocess.Popen(
            [*inside, SNAKESIM, "run", *arguments, "--out", str(out), *network],
            cwd=home,
            env=environment(home),
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
        )
    run = Run(process, home, out, asked, inside)
    try:
        yield run
    finally:
        for pid, _ in processes_of(out):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        if process.poll() is None:
            process.kill()
            process.wait(10)


def address(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return host, int(port)
