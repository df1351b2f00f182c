"""Runs `snakesim drive qualify` in a pseudo-terminal, and answers its questions as a person would.

The drive on the bench is emulated. The command treats it as real, therefore a person must act on it.
"""

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from snakesim_hal.base.errors import BackendError
from snakesim_operator.features.qualification.assistant import (
    BOOT_S,
    INSTRUCTIONS,
    SKIP,
    TYPED_FAULTS,
    Action,
)
from snakesim_operator.features.qualification.emulated_drive import (
    SNAKESIM_MODULE,
    EmulatedDrive,
    LoggedState,
)
from snakesim_operator.features.qualification.protocol.record import PROGRESS, Record, read_record
from snakesim_operator.features.qualification.setup import Request, make_setup
from snakesim_testing.harness.command import SNAKESIM_COMMAND, make_environment
from snakesim_testing.harness.processes import find_processes_with
from snakesim_testing.harness.wait import wait_until

ENTER = "\n"
CTRL_C = "\x03"
CTRL_D = "\x04"  # end of input
HEADING_PATTERN = re.compile(r"^ ?\d+/\d+  (?P<title>.+)$")
QUESTION_START = "       > "
QUESTION_END = ":"  # of a line that waits for an answer
MIN_MOTION_RAD = 0.002
OBSERVED_NS = (
    2_000_000_000  # the person has watched the shaft for this time when the question appears
)


class Bench:
    """One emulated drive on a bus."""

    def __init__(self, folder: Path, driver_type: str) -> None:
        """Start an emulated drive on a bus of its own.

        Args:
            folder: Folder for the files of drive and bus.
            driver_type: Driver type of the drive.
        """
        folder.mkdir()
        self.driver_type = driver_type
        self.scenario = folder / "first_hour.toml"
        setup = make_setup(Request(driver_type, folder))
        self.channel = setup.bus
        self.drive = EmulatedDrive(setup.config, setup.bus, folder, (), SNAKESIM_MODULE)

    def carry_out(self, action: Action) -> None:
        """Do to the drive what the command has instructed the person to do."""
        fault = TYPED_FAULTS.get(action)
        if fault is None:  # friction blocks the joint, and a drive that has started needs nothing
            return
        self.drive.type_fault(fault)
        time.sleep(BOOT_S if fault.startswith("reboot") else 0.1)

    def read_newest_state(self) -> LoggedState:
        """Return what the drive has logged last."""
        return self.drive.read_log()[-1]

    def assert_stays_off(self) -> None:
        """Wait until the drive has no torque, and fail unless it stays without torque and at rest for 1 s."""
        wait_until(lambda: not self.read_newest_state().is_enabled, "a drive without torque", 5.0)
        time.sleep(0.3)  # a joint that still swings comes to rest
        before = self.read_newest_state()
        time.sleep(1.0)
        after = self.read_newest_state()
        assert not after.is_enabled
        assert abs(after.angle_rad - before.angle_rad) < MIN_MOTION_RAD


class QualificationTerminal:
    """A pseudo-terminal in which `snakesim drive qualify` runs, and the keyboard of its operator."""

    def __init__(self, home: Path, bench: Bench) -> None:
        """Start the command, which writes into the folder `home / "out"`.

        Args:
            home: Folder in which it runs.
            bench: The drive.
        """
        self.bench = bench
        self.folder = home / "out"
        self._fd, command_fd = pty.openpty()
        self._close_event = threading.Event()
        self._printed = ""
        self._answered_lines = 0
        command = (*SNAKESIM_COMMAND, "drive", "qualify", bench.driver_type)
        options = ("--channel", bench.channel, "--scenario", str(bench.scenario))
        record = ("--out", str(self.folder), "--key", "key.pem", "--operator", "A. Person")
        # As in a shell: the terminal belongs to the command, which gets its signals.
        in_terminal = ("env", "--default-signal=HUP,INT", "setsid", "--ctty")
        self.process = subprocess.Popen(
            [*in_terminal, *command, *options, *record],
            cwd=home,
            env=make_environment(home),
            stdin=command_fd,
            stdout=command_fd,
            stderr=command_fd,
        )
        os.close(command_fd)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        """Read the output of the command until the terminal is closed. A blocked read would keep the terminal open."""
        with contextlib.suppress(OSError):  # the command has ended
            while not self._close_event.is_set():
                if select.select([self._fd], [], [], 0.02)[0]:
                    self._printed += os.read(self._fd, 4096).decode(errors="replace")

    @property
    def printed(self) -> str:
        """Everything that the terminal shows."""
        return self._printed.replace("\r\n", "\n")

    def type(self, text: str) -> None:
        """Type a text on the keyboard."""
        os.write(self._fd, text.encode())

    def close(self) -> None:
        """Close the terminal, as its window or a connection is closed."""
        if not self._close_event.is_set():
            self._close_event.set()
            self._reader.join()
            os.close(self._fd)

    def read_progress(self) -> Record:
        """Return the record of an interrupted qualification."""
        return read_record(self.folder / PROGRESS)

    def find_question(self) -> str:
        """Return the question that is not answered yet, or an empty text if there is none."""
        lines = self.printed.split("\n")[self._answered_lines : -1]
        for line in lines:
            if line.startswith(QUESTION_START) and line.endswith(QUESTION_END):
                return line
        return ""

    def wait_for_question(self) -> str:
        """Wait for the next question, and return it. Return an empty text if the command ends without a question."""
        wait_until(
            lambda: self.find_question() or self.process.poll() is not None,
            "a question or the end",
        )
        return self.find_question()

    def answer(self, text: str) -> None:
        """Answer the current question."""
        self._answered_lines = self.printed.count("\n")
        self.type(text)

    def find_step(self) -> str:
        """Return the title of the current step, or an empty text before the first step."""
        headings = [HEADING_PATTERN.match(line) for line in self.printed.split("\n")]
        titles = [heading["title"] for heading in headings if heading is not None]
        return titles[-1] if titles else ""

    def end(self) -> int:
        """Wait until the command and its host have ended, and return the exit code of the command."""
        code = self.process.wait(30)
        time.sleep(0.1)  # the last lines arrive
        host = f"{self.folder}/host.json"
        wait_until(lambda: not find_processes_with("cmdline", host), "the end of the host", 10)
        return code


@contextlib.contextmanager
def emulated_drive_on_bench(home: Path, driver_type: str) -> Iterator[Bench]:
    """Start an emulated drive on a bench, and end it with the context."""
    bench = Bench(home / "bench", driver_type)
    try:
        yield bench
    finally:
        with contextlib.suppress(BackendError):
            bench.drive.close()


@contextlib.contextmanager
def running_qualification(home: Path, bench: Bench) -> Iterator[QualificationTerminal]:
    """Run `snakesim drive qualify` in a terminal until the end of the context."""
    terminal = QualificationTerminal(home, bench)
    try:
        yield terminal
    finally:
        terminal.close()
        if terminal.process.poll() is None:
            terminal.process.send_signal(signal.SIGKILL)
        terminal.process.wait(10)


Answer = Callable[[QualificationTerminal, str], str]


def answer_as_person(terminal: QualificationTerminal, question: str) -> str:
    """Return the answer to a question that a person gives who watches the drive."""
    bench = terminal.bench
    for action, instruction in INSTRUCTIONS.items():
        if instruction in question:
            bench.carry_out(action)
            return ENTER
    if "turn the positive way" in question:
        log = bench.drive.read_log()
        start_ns = time.monotonic_ns() - OBSERVED_NS
        states_before = [state for state in log if state.monotonic_ns < start_ns]
        turned_positively = log[-1].angle_rad > states_before[-1].angle_rad
        return "y\n" if turned_positively else "n\n"
    if "without torque" in question:
        return "n\n" if bench.read_newest_state().is_enabled else "y\n"
    if "y, n" in question:  # whether the clamp, the current limit and the switch are in place
        return "y\n"
    return ENTER


def skip_step(terminal: QualificationTerminal, question: str) -> str:
    """Return the answer that skips the current step."""
    del terminal, question
    return f"{SKIP}\n"


def answer_until(
    terminal: QualificationTerminal,
    last_question: str,
    others: Mapping[str, Answer] | None = None,
) -> None:
    """Answer all questions until a certain one.

    Args:
        terminal: The terminal.
        last_question: Part of the question that is left unanswered. Empty: all questions are answered until the
            command ends.
        others: Answers that differ from `answer_as_person`, by a part of the question or by the title of the step.
    """
    while question := terminal.wait_for_question():
        if last_question and last_question in question:
            return
        answer: Answer = answer_as_person
        for part, other in (others or {}).items():
            if part in question or part == terminal.find_step():
                answer = other
        terminal.answer(answer(terminal, question))
    assert not last_question, f"the command ended without {last_question!r}: {terminal.printed}"
