"""Collects the reasons for which a run ends, and turns signals into an end in order."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import FrameType

from snakesim_hal.base.process import list_stop_signals


@dataclass
class RunEnding:
    """Collects how and why a run ends."""

    causes: list[str] = field(default_factory=list[str])
    is_interrupted: bool = False
    is_over: bool = False  # the robot has stopped; later signals do not change how the run ended
    on_interrupt: Callable[[], None] = lambda: None  # called by the signal handler

    @property
    def reason(self) -> str | None:
        """All causes as one text; None if there is none."""
        return "; ".join(self.causes) or None

    def add_cause(self, cause: str, *, first: bool = False) -> None:
        """Add a cause, unless it was added before.

        Args:
            cause: A sentence.
            first: Whether the causes that were added before are consequences of this one.
        """
        if cause in self.causes:
            return
        if first:
            self.causes.insert(0, cause)
        else:
            self.causes.append(cause)


@contextlib.contextmanager
def end_run_on_signals(ending: RunEnding) -> Iterator[None]:
    """End the run in order on Ctrl-C, SIGTERM or a closed terminal, while the context is active.

    A signal that arrives while the record and the report of a finished run are written does not stop that. A second
    Ctrl-C or SIGTERM has its default effect. A second SIGHUP has none, because the kernel and the shell both send one.
    """

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if not ending.is_over:
            ending.is_interrupted = True
            ending.on_interrupt()
        next_handler = signal.SIG_IGN if number == signal.SIGHUP else signal.SIG_DFL
        signal.signal(number, next_handler)

    old_handlers = {number: signal.signal(number, on_signal) for number in list_stop_signals()}
    try:
        yield
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, handler)
