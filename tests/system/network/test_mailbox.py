"""The queue that a host waits at."""

import threading
import time
from queue import Empty

import pytest

from snakesim_hal.network.mailbox import Mailbox

TIMES = 20_000


def test_items_come_in_order_and_nothing_is_empty() -> None:
    box: Mailbox[int] = Mailbox()
    assert box.empty()
    assert box.qsize() == 0
    for item in range(3):
        box.put(item)
    assert not box.empty()
    assert box.qsize() == 3
    assert [box.get(), box.get(timeout=1.0), box.get_nowait()] == [0, 1, 2]
    for wait_s in (0.0, -1.0, 1e-9, 0.01):
        with pytest.raises(Empty):
            box.get(timeout=wait_s)


def test_whoever_waits_is_woken() -> None:
    box: Mailbox[str] = Mailbox()
    for item in ("one", "two"):
        timer = threading.Timer(0.02, box.put, [item])
        timer.start()
        assert box.get() == item
        timer.join()


def test_waiting_for_an_item_takes_none() -> None:
    box: Mailbox[int] = Mailbox()
    for wait_s in (0.0, -1.0, 1e-9, 0.01):
        box.wait(wait_s)
    timer = threading.Timer(0.02, box.put, [1])
    timer.start()
    box.wait(10.0)
    assert box.qsize() == 1
    timer.join()
    box.wait(10.0)
    assert box.get(timeout=10.0) == 1
    assert box.empty()


def test_a_wait_that_is_shorter_than_a_hiccup_ends() -> None:
    # With `queue.SimpleQueue` this hangs after some thousand rounds.
    box: Mailbox[int] = Mailbox()
    began = time.monotonic()
    for _ in range(TIMES):
        box.put(1)
        assert box.get() == 1
        with pytest.raises(Empty):
            box.get(timeout=3e-7)
    assert time.monotonic() - began < 60.0


def test_nothing_is_lost_between_threads() -> None:
    box: Mailbox[int] = Mailbox()

    def put_all(first: int) -> None:
        for item in range(first, first + TIMES):
            box.put(item)

    threads = [threading.Thread(target=put_all, args=(k * TIMES,)) for k in range(3)]
    for thread in threads:
        thread.start()
    got = [box.get(timeout=10.0) for _ in range(3 * TIMES)]
    for thread in threads:
        thread.join()
    assert sorted(got) == list(range(3 * TIMES))
    assert box.empty()
