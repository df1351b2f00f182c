"""Which viewer has control of the robot. Thread-safe, because viewers press buttons in threads of their own."""

import threading


class ControlToken:
    """The right of one viewer to command the robot.

    A viewer acquires it while it is free. It is free again when its holder releases it, or when the holder's page is
    closed. No viewer can take it away from another one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._holder: int | None = None

    @property
    def holder(self) -> int | None:
        """The viewer in control, if any."""
        return self._holder

    def acquire(self, viewer_id: int) -> bool:
        """Acquire the token if it is free, and return whether the viewer has it now."""
        with self._lock:
            if self._holder is None:
                self._holder = viewer_id
            return self._holder == viewer_id

    def release(self, viewer_id: int) -> bool:
        """Release the token, and return whether the viewer had it."""
        with self._lock:
            had_token = self._holder == viewer_id
            if had_token:
                self._holder = None
            return had_token
