"""Which viewer has control. Pure, but for a lock: viewers press buttons in threads of their own."""

import threading


class ControlToken:
    """One token. It is taken while free, released, and returned when its holder's page is gone; never taken away."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._holder: int | None = None

    @property
    def holder(self) -> int | None:
        """The viewer in control, if any."""
        return self._holder

    def take(self, viewer: int) -> bool:
        """Take it if it is free; whether the viewer has it now."""
        with self._lock:
            if self._holder is None:
                self._holder = viewer
            return self._holder == viewer

    def release(self, viewer: int) -> bool:
        """Give it back; False when the viewer did not have it."""
        with self._lock:
            had = self._holder == viewer
            if had:
                self._holder = None
            return had
