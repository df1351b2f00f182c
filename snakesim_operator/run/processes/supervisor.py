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
from pathlib import Path

import msgspec

from snakesim_hal.network.private_channel import StarterEnd, socket_pair
from snakesim_hal.network.run_key import RUN_KEY, new_run_key
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.results.summary import ProcessRestart
from snakesim_operator.run.ending import RunEnding
from snakesim_operator.run.processes import children
from snakesim_operator.run.processes.children import ChildProcess
from snakesim_operator.run.run_files import RunFiles

HOST = "host"
# Before the first restart of a process; each further delay is twice the one before.
MIN_RESTART_DELAY_S = 0.5
MAX_RESTART_DELAY_S = 10.0
# A process that ran this long is restarted with the minimum delay again.
MIN_HEALTHY_DURATION_S = 30.0
HOST_RECORD_BYTES = 2**20  # more than the host's statistics ever take
REGULAR_EXIT_CODES = (0, 1)  # the host wrote its record before it ended


@dataclass
class SupervisedProcess:
    """One process of a run, across its restarts."""

    name: str
    arguments: Sequence[str]
    may_restart: bool
    child: ChildProcess
    vital: bool = True  # whether the run ends when this process ends
    started_s: float = field(default_factory=time.monotonic)
    delay_s: float = MIN_RESTART_DELAY_S
    restart_due_s: float | None = None  # monotonic time of its restart; None while it runs

    def describe_exit(self) -> str | None:
        """Describe how the process ended; None while it runs, or if its restart is already scheduled."""
        if self.restart_due_s is not None:
            return None
        return self.child.describe_exit()

    def schedule_restart(self) -> float:
        """Schedule the restart with exponential back-off, and return the delay in s."""
        now = time.monotonic()
        if now - self.started_s > MIN_HEALTHY_DURATION_S:
            self.delay_s = MIN_RESTART_DELAY_S
        delay_s = self.delay_s
        self.restart_due_s = now + delay_s
        self.delay_s = min(2 * delay_s, MAX_RESTART_DELAY_S)
        return delay_s

    def is_restart_due(self) -> bool:
        """Return whether a scheduled restart is due now."""
        return self.restart_due_s is not None and time.monotonic() >= self.restart_due_s


class RunSupervisor:
    """Supervises all processes of a run."""

    def __init__(
        self,
        files: RunFiles,
        ending: RunEnding,
        print_text: Callable[[str], None],
        stop_port: socket.socket,
        *,
        stay: bool = False,
    ) -> None:
        """Prepare a run; no process is started yet.

        Args:
            files: Files of the run, which receive the output of each process.
            ending: Collects the causes of the end of the run.
            print_text: Prints a line for the operator.
            stop_port: Bound socket that each host of the run inherits. Requests that arrive while no host runs wait in
                this socket.
            stay: Whether processes that end are restarted, once the run has started up.
        """
        # What the run reports about its processes.
        self.restarts: list[ProcessRestart] = []
        # Last output of each ended process that was not vital.
        self.losses_by_process: dict[str, str] = {}
        self.has_started_up = False  # until then a restart would not help a process that ends

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
        self._processes: dict[str, SupervisedProcess] = {}
        self.host: StarterEnd | None = None  # the private channel to the newest host
        self._start_time_s = time.monotonic()

    def start(
        self,
        name: str,
        arguments: Sequence[str],
        *,
        may_restart: bool = True,
        vital: bool = True,
        written_file: Path | None = None,
    ) -> None:
        """Start a Python module as a process of the run.

        Args:
            name: Name of the process, unique in the run.
            arguments: Name of the module, followed by its command-line arguments.
            may_restart: Whether the process may be restarted when it ends.
            vital: Whether the run ends when this process ends.
            written_file: File that the process completes before it ends. At the end of the run, the process is not
                killed while this file grows.
        """
        child = self._launch(name, arguments, written_file)
        self._processes[name] = SupervisedProcess(name, arguments, may_restart, child, vital)

    def _launch(
        self, name: str, arguments: Sequence[str], written_file: Path | None
    ) -> ChildProcess:
        """Start a process of the run, whose output is appended to its log."""
        on_output = partial(self._files.append, f"{name}.log")
        if name == HOST:
            return self._launch_host(arguments, on_output)
        return children.start_child(
            name, arguments, on_output, extra_env=self._secret, written_file=written_file
        )

    def _launch_host(
        self, arguments: Sequence[str], on_output: Callable[[bytes], object]
    ) -> ChildProcess:
        """Start a host that inherits the stop port and its end of a new private channel."""
        supervisor_end, host_end = socket_pair()
        with host_end:
            pass_fds = (host_end.fileno(), self._stop_port.fileno())
            private = ["--parent-socket", str(pass_fds[0]), "--stop-port", str(pass_fds[1])]
            child = children.start_child(
                HOST, [*arguments, *private], on_output, pass_fds=pass_fds, extra_env=self._secret
            )
        if self.host is not None:
            self.host.close()
        self.host = StarterEnd(supervisor_end)
        return child

    @property
    def host_record_path(self) -> str:
        """Path of the memory file into which the host writes its statistics."""
        return f"/proc/{os.getpid()}/fd/{self._memory}"

    def read_host_record(self) -> HostRecord | None:
        """Read the statistics of the host, up to half a second old while it runs; None while they are unknown."""
        with contextlib.suppress(OSError, *UNDECODABLE):
            content = os.pread(self._memory, HOST_RECORD_BYTES, 0)
            return msgspec.json.decode(content, type=HostRecord)
        return None

    def get_description(self) -> RobotDescription | None:
        """Return the description that the host sent; None while it is unknown."""
        return self.host.description if self.host is not None else None

    def read_host_messages(self) -> None:
        """Read the messages of the host. A host that was reset counts as another host."""
        if self.host is None:
            return
        resets_before = self.host.resets
        self.host.receive()
        for _ in range(self.host.resets - resets_before):
            self._note_restart(HOST, "host was reset", delay_s=0.0)
            robot = self.host.description
            command = (
                f"snakesim robot arm {robot.robot} {robot.backend}"
                if robot is not None
                else "snakesim robot arm"
            )
            self._print_text(
                f"the simulator was reset: it is at the start, and disarmed; continue with `{command}`"
            )

    def _note_restart(self, name: str, how: str, delay_s: float) -> None:
        elapsed_s = time.monotonic() - self._start_time_s
        self.restarts.append(
            ProcessRestart(name=name, how=how, at_s=round(elapsed_s, 3), after_s=delay_s)
        )

    @property
    def process_names(self) -> list[str]:
        """Names of all processes of the run."""
        return list(self._processes)

    @property
    def host_count(self) -> int:
        """Number of HAL hosts that the run has had."""
        return 1 + sum(restart.name == HOST for restart in self.restarts)

    def send_signal(self, name: str, number: int) -> None:
        """Send a signal to a process of the run. A process that has ended is ignored."""
        self._processes[name].child.process.send_signal(number)

    def get_pids(self) -> dict[str, int]:
        """Return the process id of each running process by name."""
        return {
            name: process.child.process.pid
            for name, process in self._processes.items()
            if process.restart_due_s is None
        }

    def is_host_running(self) -> bool:
        """Return whether the host runs now."""
        return self._processes[HOST].child.process.poll() is None

    def describe_first_end(self) -> str | None:
        """Describe the end of the first vital process that has ended, in order of their start; None while all run."""
        for process in self._processes.values():
            if not process.vital:
                continue
            how = process.child.describe_exit()
            if how is not None:
                return how
        return None

    def restart_ended_processes(self) -> bool:
        """Restart processes that have ended, where that is allowed.

        Returns:
            Whether the run continues: no process has ended that may not be restarted, and the host is not done.
        """
        for process in self._processes.values():
            how = process.describe_exit()
            if how is not None:
                if not self._handle_end(process, how):
                    return False
            elif process.is_restart_due():
                process.child = self._launch(
                    process.name, process.arguments, process.child.written_file
                )
                process.restart_due_s = None
                process.started_s = time.monotonic()
        return True

    def _handle_end(self, process: SupervisedProcess, how: str) -> bool:
        """Handle the end of a process: ignore it, schedule its restart, or end the run.

        Returns:
            Whether the run continues.
        """
        if not process.vital:
            self._continue_without(process, how)
            return True
        if process.name == HOST and self._host_is_done():
            return False
        if self._stay and self.has_started_up and process.may_restart:
            self._restart_later(process, how)
            return True
        self._ending.add_cause(how, first=True)
        return False

    def _continue_without(self, process: SupervisedProcess, how: str) -> None:
        """Warn once that a process that is not vital has ended."""
        if process.name in self.losses_by_process:
            return
        lines = process.child.output.last_lines() or [how]
        self.losses_by_process[process.name] = lines[-1]
        self._files.warn(lines[-1])

    def _restart_later(self, process: SupervisedProcess, how: str) -> None:
        delay_s = process.schedule_restart()
        if process.name == HOST and self.host is not None:
            self.host.close()
            self.host = None
        self._note_restart(process.name, how, delay_s)
        self._print_text(f"{how}; restart in {delay_s:g} s")

    def _host_is_done(self) -> bool:
        """Return whether the host has ended with a complete record."""
        record = self.read_host_record()
        if record is None or record.ended == "running":
            return False
        if self._processes[HOST].child.process.returncode not in REGULAR_EXIT_CODES:
            return False
        return not self._stay or record.ended in ("complete", "finished")

    def end_all_processes(self) -> None:
        """End all processes, the host first so that it writes its record. None is left afterwards."""
        running = [process.child for process in self._processes.values()]
        self._end_host()
        self._note_early_ends()
        children.stop_children(running)
        for process in self._processes.values():
            if not process.vital and process.child.process.returncode:
                self._note_loss(process)
            elif process.child.was_killed:
                self._print_text(f"warning: {process.child.describe_exit()}")
        self._print_last_output()

    def _note_loss(self, process: SupervisedProcess) -> None:
        """Note what is missing in the record because a process that is not vital failed."""
        if _was_starting(process.child):
            self.losses_by_process[process.name] = (
                f"{process.name} had not started when the run ended"
            )
            self._print_text(
                f"warning: {self.losses_by_process[process.name]}: there is nothing of it"
            )
        else:
            self._continue_without(process, process.child.describe_exit() or "")

    def _end_host(self) -> None:
        """End the host in order, and add the cause if it wrote no record."""
        host = self._processes.get(HOST)
        if host is None or host.restart_due_s is not None:
            return
        children.request_child_end(host.child)
        with contextlib.suppress(subprocess.TimeoutExpired):
            host.child.process.wait(children.STOP_TIMEOUT_S)
        how = host.child.describe_exit()
        if how is None or host.child.process.returncode in REGULAR_EXIT_CODES:
            return
        if _was_starting(host.child):
            how = f"{HOST} had not started when the run ended"
        self._ending.add_cause(how)

    def _note_early_ends(self) -> None:
        """Add the vital processes that ended by themselves as first causes: faults of the host are consequences."""
        for process in self._processes.values():
            how = process.describe_exit()
            if process.name != HOST and process.vital and how is not None:
                self._ending.add_cause(how, first=True)

    def _print_last_output(self) -> None:
        """Print the last output of each process, if the run has failed."""
        if self._ending.reason is None or self._ending.is_interrupted:
            return
        for process in self._processes.values():
            lines = process.child.output.last_lines()
            if not lines:
                continue
            self._print_text(f"--- output of {process.name}:")
            for line in lines:
                self._print_text(line)


def _was_starting(child: ChildProcess) -> bool:
    """Return whether the request to end reached a host or recorder before it had a handler for that signal."""
    return child.is_end_requested and child.process.returncode == -signal.SIGTERM
