"""How a run ends: the reason, and who requested it."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import FrameType

from snakesim_hal.base.process import stop_signals


@dataclass
class Ending:
    """How the run ended, as it becomes known."""

    causes: list[str] = field(default_factory=list[str])
    interrupted: bool = False
    over: bool = False  # the robot has stopped: from here on a signal does not change how the run ended
    on_interrupt: Callable[[], None] = lambda: None  # called by the signal handler

    @property
    def reason(self) -> str | None:
        """All causes, before their consequences; None when there are none."""
        return "; ".join(self.causes) or None

    def because(self, cause: str, *, first: bool = False) -> None:
        """Note a cause. first: the causes noted before are consequences of it."""
        if cause not in self.causes:
            self.causes.insert(0 if first else len(self.causes), cause)


@contextlib.contextmanager
def interruptible(ending: Ending) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a closed terminal end the run in order.

    A signal that comes while the record and the report of a finished run are written does not stop that. A second
    Ctrl-C or SIGTERM is left to the default; SIGHUP comes twice of itself, from the kernel and the shell.
    """

    def handle(number: int, _frame: FrameType | None) -> None:
        if not ending.over:
            ending.interrupted = True
            ending.on_interrupt()
        signal.signal(number, signal.SIG_IGN if number == signal.SIGHUP else signal.SIG_DFL)

    old = {number: signal.signal(number, handle) for number in stop_signals()}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
