"""The loop that is measured, equal for every middleware.

The Python interpreters of the other middleware import this file, so it imports nothing of SnakeSIM.
"""

import os
import time
from collections.abc import Callable

WARM_UP_ROUNDS = 50


def measure_round_trips_us(
    exchange: Callable[[], None], round_count: int, period_s: float
) -> list[float]:
    """Call a function that makes one exchange every `period_s`, and return its durations in microseconds.

    The first WARM_UP_ROUNDS exchanges are left out.
    """
    times_us: list[float] = []
    start_s = time.perf_counter()
    for number in range(WARM_UP_ROUNDS + round_count):
        request_s = time.perf_counter()
        exchange()
        times_us.append((time.perf_counter() - request_s) * 1e6)
        time.sleep(max(start_s + (number + 1) * period_s - time.perf_counter(), 0.0))
    return times_us[WARM_UP_ROUNDS:]


def write_times(times_us: list[float]) -> None:
    """Write durations into the file that the variable PEER_OUT names, one a line."""
    with open(os.environ["PEER_OUT"], "w", encoding="ascii") as out:  # noqa: PTH123 - an interpreter of any age
        out.writelines(f"{time_us}\n" for time_us in times_us)


def read_loop_parameters() -> tuple[int, int, int, float]:
    """Return bytes of the state, bytes of the command, number of rounds, and period in s, from PEER_LOOP."""
    state_bytes, command_bytes, round_count, period_s = os.environ["PEER_LOOP"].split()
    return int(state_bytes), int(command_bytes), int(round_count), float(period_s)
