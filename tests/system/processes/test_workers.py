"""Threads that serve others go on after an error that nobody expected, and say so."""

import socket
import threading
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import msgspec
import pytest

from snakesim_hal.base.workers import BackgroundThread, start_restarting_thread
from snakesim_hal.host.latch import EstopLatch
from snakesim_hal.network.private_channel import HostEnd, socket_pair
from snakesim_hal.network.stop_port import Reply, open_stop_port, request_stop, start_stop_server
from snakesim_hal.wire.messages import Answer, LifecycleRequest
from snakesim_testing.harness.wait import wait_until

LOOPBACK = "127.0.0.1"


class BrokenError(RuntimeError):
    """What nobody expected."""


def test_worker_restarts_after_error_and_reports_it_once(capfd: pytest.CaptureFixture[str]) -> None:
    attempts, dropped = list[int](), list[Exception]()

    def work() -> None:
        attempts.append(1)
        if len(attempts) < 3:
            raise BrokenError("no file is left")

    start_restarting_thread("bellows", work, on_error=dropped.append).join(10.0)
    assert len(attempts) == 3
    assert len(dropped) == 2
    assert (
        capfd.readouterr().err.count(
            "bellows: unexpected error, going on: BrokenError: no file is left"
        )
        == 1
    )


def test_a_worker_that_is_over_does_not_begin_again() -> None:
    over, attempts = threading.Event(), list[int]()

    def work() -> None:
        attempts.append(1)
        over.set()
        raise BrokenError

    start_restarting_thread("bellows", work, should_stop=over.is_set).join(10.0)
    assert attempts == [1]


def test_a_job_that_raises_costs_nothing_but_its_own_result() -> None:
    worker = BackgroundThread("hammer")

    def fail() -> None:
        raise BrokenError("no file is left")

    with pytest.raises(BrokenError):
        worker.submit(fail).result(5.0)
    assert worker.submit(lambda: 7).result(5.0) == 7
    worker.close()


def stop_port_serves() -> bool:
    asked: list[str] = []

    def take(who: str, reply: Reply) -> None:
        asked.append(who)
        if len(asked) == 1:
            raise BrokenError("no file is left")
        reply("done")

    with open_stop_port(LOOPBACK, 0) as opened:
        start_stop_server(opened, "worm", take)
        return request_stop(LOOPBACK, opened.getsockname()[1], "anna", 5.0) is not None


def stop_is_latched(folder: Path) -> bool:
    latch, told = EstopLatch(folder), SimpleQueue[str | None]()

    def fail(_failure: str | None) -> None:
        raise BrokenError("the network is closed")

    latch.engage("anna", 1, fail)
    latch.engage("berta", 2, told.put)
    return told.get(timeout=5.0) is None


def private_channel_serves() -> bool:
    starter, host = socket_pair()
    taken = threading.Event()

    def take(_request: LifecycleRequest, _reply: Callable[[Answer], None]) -> None:
        taken.set()

    with starter, host:
        HostEnd(host).start_serving(take)
        starter.send(b"\xc1 no message")
        starter.send(_encoded(LifecycleRequest(action="disarm")))
        served = taken.wait(5.0)
        host.shutdown(socket.SHUT_RDWR)
    return served


def _encoded(request: LifecycleRequest) -> bytes:
    return msgspec.msgpack.encode(request)


def test_what_stops_a_robot_is_served_after_an_error(tmp_path: Path) -> None:
    assert stop_port_serves()
    assert stop_is_latched(tmp_path)
    assert private_channel_serves()


def test_a_jobs_thread_is_there_before_it_is_needed() -> None:
    worker = BackgroundThread("hammer")
    wait_until(
        lambda: any(thread.name == "hammer" for thread in threading.enumerate()), "the thread", 5.0
    )
    worker.close()
