"""Builds clock samples for tests of recordings."""

import time

from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.messages import Clock
from snakesim_testing.hal import small_robots as rig


def make_clock_sample(tick: int) -> ReceivedSample:
    """Return a clock message of this tick as a recorder receives it now."""
    return ReceivedSample(
        keys.CLOCK, encode(rig.make_clock(tick)), format_encoding(Clock), time.monotonic_ns()
    )
