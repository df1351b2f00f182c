"""Something that is done again and again, in a thread, while something else is tried."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeating(act: Callable[[], object], every_s: float = 0.0) -> Iterator[None]:
    """every_s: between two of them; 0 for as fast as one thread can."""
    over = threading.Event()

    def repeat() -> None:
        while not over.is_set():
            act()
            if every_s:
                over.wait(every_s)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
