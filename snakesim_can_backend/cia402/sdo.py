"""Reads and writes of one drive's objects by SDO, one after the other, without waiting."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from snakesim_can_backend.cia402.frames import (
    ABORT,
    DOWNLOAD_RESPONSE,
    UPLOAD_RESPONSE,
    NmtCommand,
    SdoFrame,
    describe_abort,
    encode_read,
    encode_write,
)
from snakesim_can_backend.cia402.objects import ObjectEntry

REPEAT_PERIOD_NS = 100_000_000  # after which a request without an answer is sent again
ALL_BITS = 0xFFFF_FFFF


@dataclass(frozen=True)
class ReadStep:
    """Read an entry, and perhaps check its value."""

    entry: ObjectEntry
    expected: int | None = None  # None: any value
    mask: int = ALL_BITS  # the bits that are compared
    optional: bool = False  # True: a drive without this entry is no failure


@dataclass(frozen=True)
class WriteStep:
    """Write an entry."""

    entry: ObjectEntry
    value: int
    optional: bool = False  # True: a drive that refuses it is no failure


@dataclass(frozen=True)
class NmtStep:
    """Send an NMT command, which has no answer."""

    command: NmtCommand


Step = ReadStep | WriteStep | NmtStep


@dataclass(frozen=True)
class SdoStepResult:
    """The response of a drive to a step."""

    step: ReadStep | WriteStep
    value: int | None = None  # value that was read; None after a write or an abort
    abort: int = 0  # abort code with which the drive refused the step; 0: it did not

    @property
    def failure(self) -> str:
        """A text that describes why the step failed; empty if it did not fail.

        A step fails if the drive aborts it, unless it is optional, or if a value that was read is not the expected one.
        """
        entry = self.step.entry
        if self.abort:
            if self.step.optional:
                return ""
            verb = "read" if isinstance(self.step, ReadStep) else "written"
            return f"{entry.name} ({entry.address}) cannot be {verb}: {describe_abort(self.abort)}"
        if not isinstance(self.step, ReadStep) or self.step.expected is None or self.value is None:
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
        on_result: Callable[[SdoStepResult], None],
        now_ns: Callable[[], int],
    ) -> None:
        """Create an empty queue of steps for one drive.

        Args:
            send_request: Function that sends the data of an SDO request to the drive.
            send_nmt: Function that sends an NMT command to the drive.
            on_result: Function that is called with the result of each read and write.
            now_ns: Function that returns the driver's time in ns.
        """
        self._send_request = send_request
        self._send_nmt = send_nmt
        self._on_result = on_result
        self._now_ns = now_ns
        self._steps: deque[Step] = deque()
        self._current_step: ReadStep | WriteStep | None = None
        self._last_sent_ns = 0

    @property
    def is_idle(self) -> bool:
        """Whether every step is done."""
        return self._current_step is None and not self._steps

    @property
    def is_awaiting_response(self) -> bool:
        """Whether a request is without an answer, but not late."""
        return (
            self._current_step is not None
            and self._now_ns() - self._last_sent_ns < REPEAT_PERIOD_NS
        )

    def add(self, steps: Iterable[Step]) -> None:
        """Add steps, and start the first one if no other step is in progress."""
        self._steps.extend(steps)
        self._start_next_step()

    def clear(self) -> None:
        """Drop all steps; an answer that still arrives is ignored."""
        self._steps.clear()
        self._current_step = None

    def repeat_late_request(self) -> None:
        """Send the request in progress again if its answer is late."""
        if (
            self._current_step is not None
            and self._now_ns() - self._last_sent_ns >= REPEAT_PERIOD_NS
        ):
            self._send(self._current_step)

    def handle_response(self, response: SdoFrame) -> None:
        """Finish the step in progress if this is the response to it, report its result, and start the next step.

        Other responses are ignored.

        Args:
            response: SDO response of the drive.

        Raises:
            struct.error: The value has the wrong length.
        """
        step = self._current_step
        if step is None or (response.index, response.sub) != (step.entry.index, step.entry.sub):
            return
        match step:
            case _ if response.kind == ABORT:
                result = SdoStepResult(step, abort=response.abort)
            case ReadStep() if response.kind == UPLOAD_RESPONSE:
                result = SdoStepResult(step, value=step.entry.decode(response.data))
            case WriteStep() if response.kind == DOWNLOAD_RESPONSE:
                result = SdoStepResult(step)
            case _:
                return
        self._current_step = None
        self._on_result(result)
        self._start_next_step()

    def _start_next_step(self) -> None:
        while self._current_step is None and self._steps:
            step = self._steps.popleft()
            match step:
                case NmtStep():
                    self._send_nmt(step.command)
                case ReadStep() | WriteStep():
                    self._current_step = step
                    self._send(step)

    def _send(self, step: ReadStep | WriteStep) -> None:
        self._last_sent_ns = self._now_ns()
        match step:
            case ReadStep():
                self._send_request(encode_read(step.entry))
            case WriteStep():
                self._send_request(encode_write(step.entry, step.value))
