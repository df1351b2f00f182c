"""One request on a CAN bus, and the wait for its answer, for programs beside the driver."""

import struct
import time
from collections.abc import Callable
from typing import TypeVar

from snakesim_can_backend.bus.bus import Wire, wait
from snakesim_can_backend.protocol.definitions import CanFrame

ResponseT = TypeVar("ResponseT")


def request_response(
    wire: Wire,
    request: CanFrame | None,
    decode: Callable[[CanFrame], ResponseT | None],
    timeout_s: float,
) -> ResponseT | None:
    """Send a request, and return the first answer to it.

    Args:
        wire: Bus of the drive. Frames that arrived earlier are dropped.
        request: Frame to send; None to wait for what a drive sends by itself.
        decode: Function that returns the content of an answer, and None for any other frame. It may raise ValueError,
            LookupError and struct.error for a malformed frame, which is ignored.
        timeout_s: Maximum wait.

    Returns:
        The content of the answer; None if none arrived in time.
    """
    if request is not None:
        wire.receive()
        wire.send(request)
    deadline_s = time.monotonic() + timeout_s
    while (remaining_s := deadline_s - time.monotonic()) > 0:
        wait([wire], remaining_s)
        for frame in wire.receive():
            try:
                response = decode(frame)
            except (ValueError, LookupError, struct.error):
                continue
            if response is not None:
                return response
    return None
