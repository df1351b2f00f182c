"""Reads and writes of one drive's objects by SDO, one after the other, without waiting."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from snakesim_can_backend.cia402.frames import (
    ABORT,
    DOWNLOAD_ANSWER,
    UPLOAD_ANSWER,
    NmtCommand,
    SdoFrame,
    describe_abort,
    encode_read,
    encode_write,
)
from snakesim_can_backend.cia402.objects import Entry

REPEAT_NS = 100_000_000  # after which a request without an answer is sent again
ALL_BITS = 0xFFFF_FFFF


@dataclass(frozen=True)
class Read:
    """Read an entry, and perhaps check its value."""

    entry: Entry
    expected: int | None = None  # None: any value
    mask: int = ALL_BITS  # the bits that are compared
    optional: bool = False  # True: a drive without this entry is no failure


@dataclass(frozen=True)
class Write:
    """Write an entry."""

    entry: Entry
    value: int
    optional: bool = False  # True: a drive that refuses it is no failure


@dataclass(frozen=True)
class Nmt:
    """Send an NMT command, which has no answer."""

    command: NmtCommand


Step = Read | Write | Nmt


@dataclass(frozen=True)
class StepResult:
    """The answer to a step that has been done."""

    step: Read | Write
    value: int | None = None  # that was read
    abort: int = 0  # code with which the drive refused the step; 0: it did not

    @property
    def failure(self) -> str:
        """Why the step failed, in words; empty if it did not."""
        entry = self.step.entry
        if self.abort:
            if self.step.optional:
                return ""
            verb = "read" if isinstance(self.step, Read) else "written"
            return f"{entry.name} ({entry.address}) cannot be {verb}: {describe_abort(self.abort)}"
        if not isinstance(self.step, Read) or self.step.expected is None or self.value is None:
            return ""
        mask = self.step.mask
        if self.value & mask == self.step.expected & mask:
            return ""
        return (
            f"{entry.name} ({entry.address}) is 0x{self.value & mask:X} after 0x{self.step.expected & mask:X} was "
            f"written"
        )


class SdoQueue:
    """The steps of one drive: at most one request is without an answer at a time."""

    def __init__(
        self,
        send_request: Callable[[bytes], object],
        send_nmt: Callable[[NmtCommand], object],
        on_result: Callable[[StepResult], None],
        now_ns: Callable[[], int],
    ) -> None:
        """Begin without steps.

        Args:
            send_request: Sends a request to the drive.
            send_nmt: Sends an NMT command to the drive.
            on_result: Gets the result of each read and write.
            now_ns: The driver's time.
        """
        self._send_request = send_request
        self._send_nmt = send_nmt
        self._on_result = on_result
        self._now_ns = now_ns
        self._steps: deque[Step] = deque()
        self._current: Read | Write | None = None
        self._sent_ns = 0

    @property
    def is_idle(self) -> bool:
        """Whether every step is done."""
        return self._current is None and not self._steps

    @property
    def awaits_answer(self) -> bool:
        """Whether a request is without an answer, but not late."""
        return self._current is not None and self._now_ns() - self._sent_ns < REPEAT_NS

    def add(self, steps: Iterable[Step]) -> None:
        """Add steps, and begin with the first one if no other step is in progress."""
        self._steps.extend(steps)
        self._proceed()

    def clear(self) -> None:
        """Drop all steps; an answer that still arrives is ignored."""
        self._steps.clear()
        self._current = None

    def repeat_if_late(self) -> None:
        """Send the request in progress again if its answer is late."""
        if self._current is not None and self._now_ns() - self._sent_ns >= REPEAT_NS:
            self._send(self._current)

    def handle_answer(self, answer: SdoFrame) -> None:
        """Finish the step in progress if this is its answer, and begin with the next one.

        Raises:
            struct.error: the value has the wrong length.
        """
        step = self._current
        if step is None or (answer.index, answer.sub) != (step.entry.index, step.entry.sub):
            return
        match step:
            case _ if answer.kind == ABORT:
                result = StepResult(step, abort=answer.abort)
            case Read() if answer.kind == UPLOAD_ANSWER:
                result = StepResult(step, value=step.entry.decode(answer.data))
            case Write() if answer.kind == DOWNLOAD_ANSWER:
                result = StepResult(step)
            case _:
                return
        self._current = None
        self._on_result(result)
        self._proceed()

    def _proceed(self) -> None:
        while self._current is None and self._steps:
            step = self._steps.popleft()
            match step:
                case Nmt():
                    self._send_nmt(step.command)
                case Read() | Write():
                    self._current = step
                    self._send(step)

    def _send(self, step: Read | Write) -> None:
        self._sent_ns = self._now_ns()
        match step:
            case Read():
                self._send_request(encode_read(step.entry))
            case Write():
                self._send_request(encode_write(step.entry, step.value))
