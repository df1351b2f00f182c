"""The loop that is measured, alike for every middleware. Their own interpreters import it: nothing of ours here."""

import os
import time
from collections.abc import Callable

WARM_UP = 50


def measure(exchange: Callable[[], None], round_count: int, period_s: float) -> list[float]:
    """Round trips in microseconds, one every `period_s`; the first ones are not counted."""
    times: list[float] = []
    begin = time.perf_counter()
    for number in range(WARM_UP + round_count):
        sent = time.perf_counter()
        exchange()
        times.append((time.perf_counter() - sent) * 1e6)
        time.sleep(max(begin + (number + 1) * period_s - time.perf_counter(), 0.0))
    return times[WARM_UP:]


def tell(times: list[float]) -> None:
    """Write them to the file that the caller has named."""
    with open(os.environ["PEER_OUT"], "w", encoding="ascii") as out:  # noqa: PTH123 - an interpreter of any age
        out.writelines(f"{took}\n" for took in times)


def sizes() -> tuple[int, int, int, float]:
    """Bytes of the state, bytes of the command, rounds, period in seconds."""
    state, command, rounds, period_s = os.environ["PEER_LOOP"].split()
    return int(state), int(command), int(rounds), float(period_s)
