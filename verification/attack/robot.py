"""The robot that is attacked: a run of the `snakesim` command, and an honest operator on its network."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import zenoh

from snakesim_testing.harness.wait import wait_until
from verification.attack.command import STANDING, Run, running
from verification.attack.stranger import NetworkStranger

BACK_S = 20.0  # until a robot that was attacked is replaced


@dataclass(frozen=True)
class RunHealth:
    """Of a run's processes at one moment."""

    parts: dict[str, int]
    written: dict[Path, int]


@dataclass(frozen=True)
class AttackedRobot:
    """A run, and somebody who may reset and arm it."""

    run: Run
    operator: NetworkStranger

    @property
    def endpoint(self) -> str:
        """Where its network meets."""
        return self.run.endpoint

    def health(self) -> RunHealth:
        """Its processes, and how much they have written down."""
        return RunHealth(
            self.run.parts(), {path: path.stat().st_size for path in self.run.out.glob("*.log")}
        )

    def unharmed(self, before: RunHealth, what: str = "") -> None:
        """Fail unless all its processes are those of before, and none has complained since."""
        complaints = [
            f"{path.stem}: {news[-300:]}"
            for path in sorted(self.run.out.glob("*.log"))
            if "Traceback"
            in (news := path.read_text(errors="replace")[before.written.get(path, 0) :])
        ]
        assert not complaints, f"{what}: {'; '.join(complaints)}"
        assert self.run.parts() == before.parts, f"{what}: {self.run.printed()[-1000:]}"

    def stays(self, lifecycle: str, seconds: float) -> None:
        """Fail unless it says nothing else for so long."""
        began = time.monotonic()
        time.sleep(seconds)
        seen = {
            heard.message["lifecycle"]
            for key in ("hal/clock", "hal/status")
            for heard in self.operator.heard(key)
            if heard.at_s > began
        }
        assert seen == {lifecycle}, f"{seen}: {self.operator.status()['reason']}"


def joined(run: Run) -> NetworkStranger:
    """Somebody on a run's network, as soon as there is one."""

    def join() -> NetworkStranger | bool:
        with contextlib.suppress(zenoh.ZError):
            return NetworkStranger(run.endpoint, timeout_s=0.5)
        return run.process.poll() is not None

    found = wait_until(join, f"a network at {run.endpoint}")
    assert isinstance(found, NetworkStranger), run.describe_ending()
    found.receive("hal/status", "hal/clock", "hal/applied", "hal/description")
    return found


@contextmanager
def standing(
    home: Path, *arguments: str, name: str = "run", inside: Sequence[str] = ()
) -> Iterator[AttackedRobot]:
    """A robot of its own, armed. inside: a prefix that runs it somewhere else."""
    with (
        running(home, *(arguments or STANDING), name=name, inside=inside) as run,
        joined(run) as operator,
    ):
        operator.recover()
        yield AttackedRobot(run, operator)


class Victim:
    """One robot for many attacks: brought back after each, and replaced when it does not come back."""

    def __init__(self, home: Path, *more: str, inside: Sequence[str] = ()) -> None:
        """more: arguments of the run, beside those of a robot that stands still; inside: a prefix of its command."""
        self._home, self._arguments, self._stack = home, (*STANDING, *more), ExitStack()
        self._inside = inside
        self._robot: AttackedRobot | None = None
        self._number = 0

    def armed(self) -> AttackedRobot:
        """It, armed and following its controller."""
        if self._robot is not None:
            with contextlib.suppress(AssertionError):
                self._robot.operator.recover(BACK_S)
                self._robot.operator.forget()
                return self._robot
        self.close()
        self._number += 1
        home = self._home / str(self._number)
        home.mkdir()
        self._robot = self._stack.enter_context(
            standing(home, *self._arguments, inside=self._inside)
        )
        return self._robot

    def close(self) -> None:
        """End it."""
        self._robot = None
        self._stack.close()
