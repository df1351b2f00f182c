"""Starts the processes of a run in order, restarts them with back-off where that is allowed, and ends all of them.

Nothing here arms the robot: a restarted host boots disarmed, and a person arms it.
"""

import contextlib
import os
import signal
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
MIN_DELAY_S = 0.5  # before the first restart of a process; each further delay is twice the one before
MAX_DELAY_S = 10.0
HEALTHY_S = 30.0  # a process that ran this long is restarted with the minimum delay again
HOST_RECORD_BYTES = 2**20  # more than the host's statistics ever take
REGULAR_EXIT_CODES = (0, 1)  # the host wrote its record before it ended


@dataclass
class Part:
    """One process of a run, through all its restarts."""

    name: str
    arguments: Sequence[str]
    may_restart: bool
    child: Child
    vital: bool = True  # whether the run ends with it
    started_s: float = field(default_factory=time.monotonic)
    delay_s: float = MIN_DELAY_S
    restart_due_s: float | None = None  # monotonic time of its restart; None while it runs

    def describe_end(self) -> str | None:
        """Return how the process ended; None while it runs, or when its restart is scheduled already."""
        if self.restart_due_s is not None:
            return None
        return self.child.describe_end()

    def schedule_restart(self) -> float:
        """Schedule the restart with exponential back-off. Returns the delay in s."""
        now = time.monotonic()
        if now - self.started_s > HEALTHY_S:
            self.delay_s = MIN_DELAY_S
        delay_s = self.delay_s
        self.restart_due_s = now + delay_s
        self.delay_s = min(2 * delay_s, MAX_DELAY_S)
        return delay_s

    def is_restart_due(self) -> bool:
        """Return whether a scheduled restart is due now."""
        return self.restart_due_s is not None and time.monotonic() >= self.restart_due_s


class Supervisor:
    """Supervises all processes of a run."""

    def __init__(
        self,
        files: RunFiles,
        ending: Ending,
        print_text: Callable[[str], None],
        stop_port: socket.socket,
        *,
        stay: bool = False,
    ) -> None:
        """Prepare a run; no process is started yet.

        Args:
            files: receive the output of each process.
            ending: collects the reasons for which the run ends.
            print_text: prints a line for the operator.
            stop_port: bound socket that each host of the run inherits in turn. Requests that arrive while no host runs
                wait in it.
            stay: whether processes that end are restarted, once the run has started up.
        """
        # What the run reports about its processes.
        self.restarts: list[Restart] = []
        self.lost: dict[str, str] = {}  # for each part that ended and was not vital: its last line of output
        self.started_up = False  # until then a restart would not help a process that ends

        # Collaborators.
        self._files = files
        self._ending = ending
        self._print_text = print_text
        self._stay = stay

        # What the processes share.
        self._memory = os.memfd_create("snakesim-host")
        self._stop_port = stop_port
        self._secret = {RUN_KEY: new_run_key()}

        # The processes.
        self._parts: dict[str, Part] = {}
        self.host: StarterEnd | None = None  # the private channel to the newest host
        self._begun_s = time.monotonic()

    def start(self, name: str, arguments: Sequence[str], *, may_restart: bool = True, vital: bool = True) -> None:
        """Start a Python module as a part of the run.

        Args:
            name: of the part, unique in the run.
            arguments: the module's name and its command line.
            may_restart: whether the part may be restarted when it ends.
            vital: whether the run ends when this part does.
        """
        child = self._launch(name, arguments)
        self._parts[name] = Part(name, arguments, may_restart, child, vital)

    def _launch(self, name: str, arguments: Sequence[str]) -> Child:
        keep = partial(self._files.append, f"{name}.log")
        if name == HOST:
            return self._launch_host(arguments, keep)
        return children.start_child(name, arguments, keep, more=self._secret)

    def _launch_host(self, arguments: Sequence[str], keep: Callable[[bytes], object]) -> Child:
        """Start a host that inherits the stop port and its end of a new private channel."""
        supervisor_end, host_end = socket_pair()
        with host_end:
            inherits = (host_end.fileno(), self._stop_port.fileno())
            private = ["--parent-socket", str(inherits[0]), "--stop-port", str(inherits[1])]
            child = children.start_child(HOST, [*arguments, *private], keep, inherits=inherits, more=self._secret)
        if self.host is not None:
            self.host.close()
        self.host = StarterEnd(supervisor_end)
        return child

    @property
    def memory(self) -> str:
        """Path of an in-memory file for the host's statistics."""
        return f"/proc/{os.getpid()}/fd/{self._memory}"

    def host_record(self) -> HostRecord | None:
        """Return the host's statistics, up to half a second old while it runs; None while they are unknown."""
        with contextlib.suppress(OSError, *UNDECODABLE):
            content = os.pread(self._memory, HOST_RECORD_BYTES, 0)
            return msgspec.json.decode(content, type=HostRecord)
        return None

    def robot(self) -> Description | None:
        """Return the host's description; None while it is unknown."""
        return self.host.description if self.host is not None else None

    def read_host_messages(self) -> None:
        """Read what the host has sent. A host that was reset counts as another host."""
        if self.host is None:
            return
        resets_before = self.host.resets
        self.host.receive()
        for _ in range(self.host.resets - resets_before):
            self._note_restart(HOST, "host was reset", delay_s=0.0)
            robot = self.host.description
            command = f"snakesim robot arm {robot.robot} {robot.backend}" if robot is not None else "snakesim robot arm"
            self._print_text(f"the simulator was reset: it is at the start, and disarmed; continue with `{command}`")

    def _note_restart(self, name: str, how: str, delay_s: float) -> None:
        elapsed_s = time.monotonic() - self._begun_s
        self.restarts.append(Restart(name=name, how=how, at_s=round(elapsed_s, 3), after_s=delay_s))

    @property
    def names(self) -> list[str]:
        """The names of all processes of the run."""
        return list(self._parts)

    @property
    def hosts(self) -> int:
        """The number of HAL hosts that the run has had."""
        return 1 + sum(restart.name == HOST for restart in self.restarts)

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a process of the run; one that has ended gets none."""
        self._parts[name].child.process.send_signal(number)

    def pids(self) -> dict[str, int]:
        """Return the process id of each process that runs now, by name."""
        return {name: part.child.process.pid for name, part in self._parts.items() if part.restart_due_s is None}

    def host_runs(self) -> bool:
        """Return whether the host runs now."""
        return self._parts[HOST].child.process.poll() is None

    def describe_first_end(self) -> str | None:
        """Return how the first vital part that has ended did so, in the order of their start; None while all run."""
        for part in self._parts.values():
            if not part.vital:
                continue
            how = part.child.describe_end()
            if how is not None:
                return how
        return None

    def restart_ended_parts(self) -> bool:
        """Restart processes that have ended, where that is allowed.

        Returns:
            Whether the run continues. False: a part has ended that may not be restarted, or the host is done.
        """
        for part in self._parts.values():
            how = part.describe_end()
            if how is not None:
                if not self._continue_after_end(part, how):
                    return False
            elif part.is_restart_due():
                part.child = self._launch(part.name, part.arguments)
                part.restart_due_s = None
                part.started_s = time.monotonic()
        return True

    def _continue_after_end(self, part: Part, how: str) -> bool:
        """Decide what the end of a part means for the run. Returns whether the run continues."""
        if not part.vital:
            self._continue_without(part, how)
            return True
        if part.name == HOST and self._host_is_done():
            return False
        if self._stay and self.started_up and part.may_restart:
            self._restart_later(part, how)
            return True
        self._ending.add_cause(how, first=True)
        return False

    def _continue_without(self, part: Part, how: str) -> None:
        """Warn once that a part that the run does not need has ended."""
        if part.name in self.lost:
            return
        lines = part.child.output.last_lines() or [how]
        self.lost[part.name] = lines[-1]
        self._files.warn(lines[-1])

    def _restart_later(self, part: Part, how: str) -> None:
        delay_s = part.schedule_restart()
        if part.name == HOST and self.host is not None:
            self.host.close()
            self.host = None
        self._note_restart(part.name, how, delay_s)
        self._print_text(f"{how}; restart in {delay_s:g} s")

    def _host_is_done(self) -> bool:
        """Return whether the host has ended with a complete record."""
        record = self.host_record()
        if record is None or record.ended == "running":
            return False
        if self._parts[HOST].child.process.returncode not in REGULAR_EXIT_CODES:
            return False
        return not self._stay or record.ended in ("complete", "finished")

    def end(self) -> None:
        """End all processes, the host first, so that its record is written. None is left after this."""
        running = [part.child for part in self._parts.values()]
        self._end_host()
        self._note_early_ends()
        children.stop_all(running)
        for part in self._parts.values():
            if not part.vital and part.child.process.returncode:
                self._note_loss(part)
            elif part.child.was_killed:
                self._print_text(f"warning: {part.child.describe_end()}")
        self._print_last_output()

    def _note_loss(self, part: Part) -> None:
        """Note what is missing from the record because a part that the run does not need did not end in order."""
        if _was_starting(part.child):
            self.lost[part.name] = f"{part.name} had not started when the run ended"
            self._print_text(f"warning: {self.lost[part.name]}: there is nothing of it")
        else:
            self._continue_without(part, part.child.describe_end() or "")

    def _end_host(self) -> None:
        """End the host in order, and note how it ended if it wrote no record."""
        host = self._parts.get(HOST)
        if host is None or host.restart_due_s is not None:
            return
        children.request_end(host.child)
        with contextlib.suppress(subprocess.TimeoutExpired):
            host.child.process.wait(children.STOP_LIMIT_S)
        how = host.child.describe_end()
        if how is None or host.child.process.returncode in REGULAR_EXIT_CODES:
            return
        if _was_starting(host.child):
            how = f"{HOST} had not started when the run ended"
        self._ending.add_cause(how)

    def _note_early_ends(self) -> None:
        """Note the vital parts that ended before they were stopped: any fault that the host noted is a consequence."""
        for part in self._parts.values():
            how = part.describe_end()
            if part.name != HOST and part.vital and how is not None:
                self._ending.add_cause(how, first=True)

    def _print_last_output(self) -> None:
        if self._ending.reason is None or self._ending.interrupted:
            return
        for part in self._parts.values():
            lines = part.child.output.last_lines()
            if not lines:
                continue
            self._print_text(f"--- output of {part.name}:")
            for line in lines:
                self._print_text(line)


def _was_starting(child: Child) -> bool:
    """Return whether the request to end reached a host or recorder before it had a handler for that signal."""
    return child.end_requested and child.process.returncode == -signal.SIGTERM
