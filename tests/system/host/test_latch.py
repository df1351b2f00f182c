"""An emergency stop on disk: written before it is answered, found again, and latched when in doubt."""

import threading
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from threading import Event

import pytest

from snakesim_hal.host import latch as under_test
from snakesim_hal.host.latch import ESTOP, EstopLatch
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import EstopRequest
from snakesim_testing.hal.local_network import running_host
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.harness.wait import wait_until

HANG_S = 60.0  # far longer than any answer takes on a busy computer


def asked(latch: EstopLatch, what: str) -> str | None:
    answers: SimpleQueue[str | None] = SimpleQueue()
    if what == "engage":
        latch.engage("anna", 7, answers.put)
    else:
        latch.release(answers.put)
    return answers.get(timeout=5)


def test_kept_found_and_released(tmp_path: Path) -> None:
    assert asked(EstopLatch(tmp_path / "no stop yet"), "release") is None
    first = EstopLatch(tmp_path)
    assert first.left_by_earlier_host is None
    assert asked(first, "engage") is None
    assert (tmp_path / ESTOP).is_file()
    assert [path.name for path in tmp_path.iterdir()] == [ESTOP]
    second = EstopLatch(tmp_path)
    assert second.left_by_earlier_host is not None
    assert second.left_by_earlier_host.requester == "anna"
    assert second.left_by_earlier_host.tick == 7
    assert asked(second, "engage") is None
    assert asked(second, "release") is None
    assert EstopLatch(tmp_path).left_by_earlier_host is None
    assert asked(second, "release") is None
    assert asked(second, "engage") is None
    assert EstopLatch(tmp_path).left_by_earlier_host is not None


@pytest.mark.parametrize("content", [b"", b"{", b'{"requester":1}', b"\xff" * 100])
def test_what_cannot_be_read_counts_as_latched(tmp_path: Path, content: bytes) -> None:
    (tmp_path / ESTOP).write_bytes(content)
    latch = EstopLatch(tmp_path)
    assert latch.left_by_earlier_host is not None
    assert "cannot be read" in latch.left_by_earlier_host.requester
    assert asked(latch, "engage") is None
    again = EstopLatch(tmp_path)
    assert (
        again.left_by_earlier_host is not None and again.left_by_earlier_host.requester == "anna"
    )  # a good file in its place
    assert asked(latch, "release") is None
    assert EstopLatch(tmp_path).left_by_earlier_host is None


def test_a_stop_that_cannot_be_kept_says_so(tmp_path: Path) -> None:
    (tmp_path / "in the way").write_text("a file where the folder belongs")
    latch = EstopLatch(tmp_path / "in the way")
    failure = asked(latch, "engage")
    assert failure is not None
    assert "will not outlive this host" in failure


@pytest.fixture
def hanging(monkeypatch: pytest.MonkeyPatch) -> Iterator[Event]:
    """A disk that hangs until the event is set."""
    should_continue, write = Event(), under_test.write_atomically

    def slow(path: Path, content: bytes, *, durable: bool = False) -> None:
        should_continue.wait(HANG_S)
        write(path, content, durable=durable)

    monkeypatch.setattr(under_test, "write_atomically", slow)
    monkeypatch.setattr(under_test, "ANSWER_LIMIT_S", 0.3)
    yield should_continue
    should_continue.set()


def test_a_stop_is_answered_although_the_disk_hangs(tmp_path: Path, hanging: Event) -> None:
    answers: SimpleQueue[str | None] = SimpleQueue()
    threads = threading.active_count()
    latch = EstopLatch(tmp_path)
    for _ in range(1000):  # a flood, too
        latch.engage("anna", 7, answers.put)
    for _ in range(1000):
        said = answers.get(timeout=HANG_S / 2)
        assert said is not None
        assert "not stored yet" in said
        assert str(tmp_path / ESTOP) in said
    assert threading.active_count() <= threads + 2
    latch.close()
    assert not (tmp_path / ESTOP).exists()  # closed without waiting for the disk
    hanging.set()
    wait_until(
        lambda: EstopLatch(tmp_path).left_by_earlier_host is not None, "the stop kept after all"
    )
    assert answers.empty()  # once each


def test_latch_on_hanging_disk_stops_at_once_and_ends(tmp_path: Path, hanging: Event) -> None:
    with running_host(make_run_config(clock_mode="realtime"), latch=EstopLatch(tmp_path)) as run:
        answer = run.request(keys.ESTOP, EstopRequest(requester="anna"))
        assert answer.ok
        assert answer.lifecycle == "estop"
        assert "not stored yet" in answer.reason  # so it was given while the disk hung
        run.wait_for_lifecycle("estop")
