"""How long a command waits for a joint angle that the robot does not know, before it gives up.

A drive does not know its angle while it starts, and an angle may be too old while the computer is busy. Both last for
less than `MAX_UNKNOWN_S`.
"""

import time
from collections.abc import Callable, Sequence

from snakesim_hal.base.errors import RefusedError

MAX_UNKNOWN_S = 1.0


class UnknownAngleTimeout:
    """Raises an error once a joint angle was unknown for longer than `MAX_UNKNOWN_S`."""

    def __init__(self, get_time_s: Callable[[], float] = time.monotonic) -> None:
        """Start without an unknown angle.

        Args:
            get_time_s: Returns the current time.
        """
        self._get_time_s = get_time_s
        self._unknown_since_s: float | None = None  # None while all angles are known

    def check(self, unknown_joints: Sequence[str]) -> None:
        """Check the newest sample of joint angles.

        Args:
            unknown_joints: Names of the joints whose angle is not known in it.

        Raises:
            RefusedError: An angle was unknown in all samples of the last `MAX_UNKNOWN_S`.
        """
        if not unknown_joints:
            self._unknown_since_s = None
            return
        now_s = self._get_time_s()
        if self._unknown_since_s is None:
            self._unknown_since_s = now_s
        if now_s - self._unknown_since_s > MAX_UNKNOWN_S:
            raise RefusedError(
                f"{', '.join(unknown_joints)}: the angle is not known; see `snakesim status`",
                code="commissioning/not-possible",
            )
