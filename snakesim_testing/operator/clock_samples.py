"""Clock samples for recordings."""

import time

from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.messages import Clock
from snakesim_testing.hal import small_robots as rig


def clock(tick: int) -> ReceivedSample:
    return ReceivedSample(
        keys.CLOCK, encode(rig.make_clock(tick)), format_encoding(Clock), time.monotonic_ns()
    )
