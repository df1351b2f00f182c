"""An emergency stop is stored on disk before it is answered, and a restarted host finds it again."""

import threading
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Literal

import pytest

from snakesim_hal.host import latch as latch_module
from snakesim_hal.host.latch import ESTOP, EstopLatch
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import EstopRequest
from snakesim_testing.hal.local_network import running_host
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.harness.wait import wait_until

HANG_S = 60.0  # much longer than an answer takes on a busy computer
ANSWER_LIMIT_S = 0.3  # how long the latch waits for the disk before it answers
REQUESTS = 1000  # a flood of stop requests


def change_latch(latch: EstopLatch, action: Literal["engage", "release"]) -> str | None:
    """Engage or release the latch, and return the failure that it reports, or None."""
    answers: SimpleQueue[str | None] = SimpleQueue()
    if action == "engage":
        latch.engage("anna", 7, answers.put)
    else:
        latch.release(answers.put)
    return answers.get(timeout=5)


def test_latch_engaged_stays_until_released_across_restarts(tmp_path: Path) -> None:
    assert change_latch(EstopLatch(tmp_path / "no stop yet"), "release") is None
    first = EstopLatch(tmp_path)
    assert first.left_by_earlier_host is None
    assert change_latch(first, "engage") is None
    assert (tmp_path / ESTOP).is_file()
    assert [path.name for path in tmp_path.iterdir()] == [ESTOP]
    second = EstopLatch(tmp_path)
    assert second.left_by_earlier_host is not None
    assert second.left_by_earlier_host.requester == "anna"
    assert second.left_by_earlier_host.tick == 7
    assert change_latch(second, "engage") is None
    assert change_latch(second, "release") is None
    assert EstopLatch(tmp_path).left_by_earlier_host is None
    assert change_latch(second, "release") is None
    assert change_latch(second, "engage") is None
    assert EstopLatch(tmp_path).left_by_earlier_host is not None


@pytest.mark.parametrize("content", [b"", b"{", b'{"requester":1}', b"\xff" * 100])
def test_latch_with_unreadable_file_is_engaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / ESTOP).write_bytes(content)
    latch = EstopLatch(tmp_path)
    assert latch.left_by_earlier_host is not None
    assert "cannot be read" in latch.left_by_earlier_host.requester
    assert change_latch(latch, "engage") is None
    # A readable file has replaced the unreadable one.
    reloaded = EstopLatch(tmp_path)
    assert reloaded.left_by_earlier_host is not None
    assert reloaded.left_by_earlier_host.requester == "anna"
    assert change_latch(latch, "release") is None
    assert EstopLatch(tmp_path).left_by_earlier_host is None


def test_latch_that_cannot_store_stop_reports_failure(tmp_path: Path) -> None:
    (tmp_path / "in the way").write_text("a file in place of the folder")
    latch = EstopLatch(tmp_path / "in the way")
    failure = change_latch(latch, "engage")
    assert failure is not None
    assert "will not outlive this host" in failure


@pytest.fixture
def hanging_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Event]:
    """Let every write to the disk hang until the event is set."""
    should_continue = Event()
    write_atomically = latch_module.write_atomically

    def write_when_disk_continues(path: Path, content: bytes, *, durable: bool = False) -> None:
        should_continue.wait(HANG_S)
        write_atomically(path, content, durable=durable)

    monkeypatch.setattr(latch_module, "write_atomically", write_when_disk_continues)
    monkeypatch.setattr(latch_module, "ANSWER_LIMIT_S", ANSWER_LIMIT_S)
    yield should_continue
    should_continue.set()


def test_latch_with_hanging_disk_answers_every_stop(tmp_path: Path, hanging_disk: Event) -> None:
    answers: SimpleQueue[str | None] = SimpleQueue()
    thread_count = threading.active_count()
    latch = EstopLatch(tmp_path)
    for _ in range(REQUESTS):
        latch.engage("anna", 7, answers.put)
    for _ in range(REQUESTS):
        answer = answers.get(timeout=HANG_S / 2)
        assert answer is not None
        assert "not stored yet" in answer
        assert str(tmp_path / ESTOP) in answer
    assert threading.active_count() <= thread_count + 2
    latch.close()
    assert not (tmp_path / ESTOP).exists()  # `close` does not wait for the disk.
    hanging_disk.set()
    wait_until(lambda: EstopLatch(tmp_path).left_by_earlier_host is not None, "the stop is stored")
    assert answers.empty()  # Each request has one answer.


def test_host_with_hanging_latch_disk_stops_at_once(tmp_path: Path, hanging_disk: Event) -> None:
    with running_host(make_run_config(clock_mode="realtime"), latch=EstopLatch(tmp_path)) as run:
        answer = run.request(keys.ESTOP, EstopRequest(requester="anna"))
        assert answer.ok
        assert answer.lifecycle == "estop"
        assert "not stored yet" in answer.reason  # The disk hung when the host answered.
        run.wait_for_lifecycle("estop")
