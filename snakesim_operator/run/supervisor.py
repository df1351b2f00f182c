"""The processes of a run: started in order, restarted with back-off where allowed, and never left behind.

Nothing here arms anything: a restarted host boots disarmed, and a person arms it.
"""

import contextlib
import os
import socket
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import msgspec

from snakesim_hal.network.private_channel import StarterEnd, socket_pair
from snakesim_hal.network.run_key import RUN_KEY, new_run_key
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Description
from snakesim_operator.results.summary import Restart
from snakesim_operator.run import children
from snakesim_operator.run.children import Child
from snakesim_operator.run.ending import Ending
from snakesim_operator.run.run_files import RunFiles

HOST = "host"
FIRST_DELAY_S, LAST_DELAY_S = 0.5, 10.0
HEALTHY_S = 30.0  # after which the next restart is the first one again


@dataclass
class Part:
    """One process of a run, through all its restarts."""

    name: str
    arguments: Sequence[str]
    may_restart: bool
    child: Child
    vital: bool = True  # whether the run ends with it
    started_s: float = field(default_factory=time.monotonic)
    delay_s: float = FIRST_DELAY_S
    again_s: float | None = None  # time of its restart; None while it runs

    def ended(self) -> str | None:
        """How it ended; reported once for each time it ends."""
        return self.child.how_it_ended() if self.again_s is None else None

    def put_off(self) -> float:
        """Schedule its restart; returns the delay."""
        now = time.monotonic()
        if now - self.started_s > HEALTHY_S:
            self.delay_s = FIRST_DELAY_S
        delay_s, self.again_s = self.delay_s, now + self.delay_s
        self.delay_s = min(2 * delay_s, LAST_DELAY_S)
        return delay_s

    def is_due(self) -> bool:
        """Whether its restart is due."""
        return self.again_s is not None and time.monotonic() >= self.again_s


class Supervisor:
    """Supervises all processes of a run."""

    def __init__(
        self,
        files: RunFiles,
        ending: Ending,
        say: Callable[[str], None],
        stop_port: socket.socket,
        *,
        stay: bool = False,
    ) -> None:
        """stop_port: for every host of the run, one after the other; requests without a host wait in it.

        stay: processes that end are restarted, once the run has started up.
        """
        self.restarts: list[Restart] = []
        self.lost: dict[str, str] = {}  # parts that ended and were not vital, and how
        self.came_up = False  # until then a restart would not help a process that ends
        self._files = files
        self._memory = os.memfd_create("snakesim-host")
        self._ending = ending
        self._say = say
        self._stay = stay
        self._stop_port = stop_port
        self._secret = {RUN_KEY: new_run_key()}
        self._parts: dict[str, Part] = {}
        self.host: StarterEnd | None = None  # the private channel to the newest host
        self._begun_s = time.monotonic()

    def start(self, name: str, arguments: Sequence[str], *, may_restart: bool = True, vital: bool = True) -> None:
        """Start a Python module as a part of the run. vital: whether the run ends when this part does."""
        self._parts[name] = Part(name, arguments, may_restart, self._launch(name, arguments), vital)

    def _launch(self, name: str, arguments: Sequence[str]) -> Child:
        keep = partial(self._files.append, f"{name}.log")
        if name != HOST:
            return children.start(name, arguments, keep, more=self._secret)
        ours, its = socket_pair()
        with its:
            private = ["--channel", str(its.fileno()), "--stop-port", str(self._stop_port.fileno())]
            inherits = (its.fileno(), self._stop_port.fileno())
            child = children.start(name, [*arguments, *private], keep, inherits=inherits, more=self._secret)
        if self.host is not None:
            self.host.close()
        self.host = StarterEnd(ours)
        return child

    @property
    def memory(self) -> str:
        """Path of an in-memory file for the host's statistics."""
        return f"/proc/{os.getpid()}/fd/{self._memory}"

    def host_record(self) -> HostRecord | None:
        """The host's statistics, half a second old while it runs; None while unknown."""
        with contextlib.suppress(OSError, *UNDECODABLE):
            return msgspec.json.decode(os.pread(self._memory, 2**20, 0), type=HostRecord)
        return None

    def robot(self) -> Description | None:
        """The host's description; None while unknown."""
        return self.host.description if self.host is not None else None

    def take_in(self) -> None:
        """Read what the host has said; one that was reset counts as another."""
        if self.host is None:
            return
        before = self.host.resets
        self.host.take_in()
        for _ in range(self.host.resets - before):
            at_s = time.monotonic() - self._begun_s
            self.restarts.append(Restart(name=HOST, how="host was reset", at_s=round(at_s, 3), after_s=0.0))
            robot = self.host.description
            what = f"snakesim arm {robot.robot} {robot.backend}" if robot is not None else "snakesim arm"
            self._say(f"the simulator was reset: it is at the start, and disarmed; go on with `{what}`")

    @property
    def names(self) -> list[str]:
        """Every process of the run."""
        return list(self._parts)

    @property
    def hosts(self) -> int:
        """How many HAL hosts the run has had."""
        return 1 + sum(restart.name == HOST for restart in self.restarts)

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a process of the run; one that has ended gets none."""
        self._parts[name].child.process.send_signal(number)

    def pids(self) -> dict[str, int]:
        """The process id of each process that runs now, by name."""
        return {name: part.child.process.pid for name, part in self._parts.items() if part.again_s is None}

    def host_runs(self) -> bool:
        """Whether the host runs now."""
        return self._parts[HOST].child.process.poll() is None

    def first_ended(self) -> str | None:
        """How the first process that ended did so; None while all run."""
        vital = [part for part in self._parts.values() if part.vital]
        return next((how for part in vital if (how := part.child.how_it_ended()) is not None), None)

    def goes_on(self) -> bool:
        """Restart ended processes where allowed; False when the run is over, regularly or not."""
        for part in self._parts.values():
            how = part.ended()
            if how is None:
                if part.is_due():
                    part.child = self._launch(part.name, part.arguments)
                    part.again_s, part.started_s = None, time.monotonic()
            elif not part.vital:
                self._go_on_without(part, how)
            elif part.name == HOST and self._host_is_done():
                return False
            elif self._stay and self.came_up and part.may_restart:
                self._put_off(part, how)
            else:
                self._ending.because(how, first=True)
                return False
        return True

    def _go_on_without(self, part: Part, how: str) -> None:
        if part.name not in self.lost:
            self.lost[part.name] = (part.child.words.last() or [how])[-1]
            self._files.warn(self.lost[part.name])

    def _put_off(self, part: Part, how: str) -> None:
        delay_s = part.put_off()
        if part.name == HOST and self.host is not None:
            self.host.close()
            self.host = None
        at_s = time.monotonic() - self._begun_s
        self.restarts.append(Restart(name=part.name, how=how, at_s=round(at_s, 3), after_s=delay_s))
        self._say(f"{how}; restart in {delay_s:g} s")

    def _host_is_done(self) -> bool:
        """Whether the host has ended with a complete record."""
        record = self.host_record()
        if record is None or record.ended == "running" or self._parts[HOST].child.process.returncode not in (0, 1):
            return False
        return not self._stay or record.ended in ("complete", "finished")

    def end(self) -> None:
        """End everything, the host first and in order, so that its record is written. Nothing is left after this."""
        running = [part.child for part in self._parts.values()]
        host = self._parts.get(HOST)
        if host is not None and host.again_s is None:
            children.ask_to_end(host.child)
            with contextlib.suppress(subprocess.TimeoutExpired):
                host.child.process.wait(children.STOP_LIMIT_S)
            how = host.child.how_it_ended()
            if how is not None and host.child.process.returncode not in (0, 1):
                self._ending.because(how)
        for part in self._parts.values():
            how = part.ended()
            if part.name != HOST and part.vital and how is not None:
                self._ending.because(how, first=True)  # before any fault that the host has noted since
        children.stop_all(running)
        for part in self._parts.values():
            if not part.vital and part.child.process.returncode:
                self._go_on_without(part, part.child.how_it_ended() or "")
        self._print_last_words()

    def _print_last_words(self) -> None:
        if self._ending.reason is None or self._ending.interrupted:
            return
        for part in self._parts.values():
            words = part.child.words.last()
            if words:
                self._say(f"--- output of {part.name}:")
                for line in words:
                    self._say(line)
