"""The mailbox is the queue in which messages wait for the thread of the host."""

import threading
import time
from queue import Empty

import pytest

from snakesim_hal.network.mailbox import Mailbox

REPETITIONS = 20_000
WAITS_FOR_NOTHING_S = (0.0, -1.0, 1e-9, 0.01)
VERY_SHORT_WAIT_S = 3e-7


def test_mailbox_returns_items_in_order_and_raises_empty_afterwards() -> None:
    mailbox: Mailbox[int] = Mailbox()
    assert mailbox.empty()
    assert mailbox.qsize() == 0
    for item in range(3):
        mailbox.put(item)
    assert not mailbox.empty()
    assert mailbox.qsize() == 3
    assert [mailbox.get(), mailbox.get(timeout=1.0), mailbox.get_nowait()] == [0, 1, 2]
    for wait_s in WAITS_FOR_NOTHING_S:
        with pytest.raises(Empty):
            mailbox.get(timeout=wait_s)


def test_mailbox_get_wakes_when_an_item_arrives() -> None:
    mailbox: Mailbox[str] = Mailbox()
    for item in ("one", "two"):
        timer = threading.Timer(0.02, mailbox.put, [item])
        timer.start()
        assert mailbox.get() == item
        timer.join()


def test_mailbox_wait_does_not_remove_the_item() -> None:
    mailbox: Mailbox[int] = Mailbox()
    for wait_s in WAITS_FOR_NOTHING_S:
        mailbox.wait(wait_s)
    timer = threading.Timer(0.02, mailbox.put, [1])
    timer.start()
    mailbox.wait(10.0)
    assert mailbox.qsize() == 1
    timer.join()
    mailbox.wait(10.0)
    assert mailbox.get(timeout=10.0) == 1
    assert mailbox.empty()


def test_mailbox_get_with_very_short_timeout_always_returns() -> None:
    # With `queue.SimpleQueue` this loop blocks forever after some thousand rounds.
    mailbox: Mailbox[int] = Mailbox()
    start_s = time.monotonic()
    for _ in range(REPETITIONS):
        mailbox.put(1)
        assert mailbox.get() == 1
        with pytest.raises(Empty):
            mailbox.get(timeout=VERY_SHORT_WAIT_S)
    assert time.monotonic() - start_s < 60.0


def test_mailbox_filled_by_several_threads_loses_no_item() -> None:
    mailbox: Mailbox[int] = Mailbox()

    def put_all(first: int) -> None:
        for item in range(first, first + REPETITIONS):
            mailbox.put(item)

    threads = [threading.Thread(target=put_all, args=(k * REPETITIONS,)) for k in range(3)]
    for thread in threads:
        thread.start()
    received = [mailbox.get(timeout=10.0) for _ in range(3 * REPETITIONS)]
    for thread in threads:
        thread.join()
    assert sorted(received) == list(range(3 * REPETITIONS))
    assert mailbox.empty()
