"""Repeats an action in a thread while a test does something else."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeat_in_background(action: Callable[[], object], period_s: float = 0.0) -> Iterator[None]:
    """Repeat an action in a thread for as long as the context is open.

    Args:
        action: Function that is called again and again.
        period_s: Pause in s after each call; 0 to call it as fast as one thread can.
    """
    is_over = threading.Event()

    def repeat() -> None:
        while not is_over.is_set():
            action()
            if period_s:
                is_over.wait(period_s)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
