"""The messages of a recording in the order of robot time: the samples of a tick, its clock, what was applied in it."""

import heapq
from collections.abc import Iterator
from itertools import count

from snakesim_hal.wire import keys
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.recording.reader import RecordingReader

WINDOW_NS = 1_000_000_000  # messages are no further out of order: an image may come long after the clock that names it
LAST = {keys.CLOCK: 1, keys.APPLIED: 2}


def in_robot_order(reader: RecordingReader) -> Iterator[RecordedMessage]:
    """All messages. The file has them in the order of their arrival, in which those of one tick may be mixed."""
    waiting: list[tuple[int, int, int, RecordedMessage]] = []
    number, clock_ns = count(), 0
    for recorded in reader.messages():
        heapq.heappush(waiting, (recorded.time_ns, LAST.get(recorded.key, 0), next(number), recorded))
        if recorded.key == keys.CLOCK:
            clock_ns = recorded.time_ns
        while waiting[0][0] < clock_ns - WINDOW_NS:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]
