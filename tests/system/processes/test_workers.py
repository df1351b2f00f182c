"""Threads that serve requests continue after an unexpected error, and report it."""

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


class UnexpectedError(RuntimeError):
    """An error that the code of the threads does not expect."""


def test_worker_restarts_after_error_and_reports_it_once(capfd: pytest.CaptureFixture[str]) -> None:
    attempts = 0
    errors: list[Exception] = []

    def fail_twice() -> None:
        nonlocal attempts
        attempts += 1
        if attempts < 3:
            raise UnexpectedError("no file is left")

    start_restarting_thread("worker", fail_twice, on_error=errors.append).join(10.0)
    assert attempts == 3
    assert len(errors) == 2
    message = "worker: unexpected error, but it continues: UnexpectedError: no file is left"
    assert capfd.readouterr().err.count(message) == 1


def test_worker_that_should_stop_does_not_restart_after_error() -> None:
    should_stop = threading.Event()
    attempts = 0

    def stop_and_fail() -> None:
        nonlocal attempts
        attempts += 1
        should_stop.set()
        raise UnexpectedError

    start_restarting_thread("worker", stop_and_fail, should_stop=should_stop.is_set).join(10.0)
    assert attempts == 1


def test_background_thread_continues_after_a_job_raises() -> None:
    worker = BackgroundThread("worker")

    def fail() -> None:
        raise UnexpectedError("no file is left")

    with pytest.raises(UnexpectedError):
        worker.submit(fail).result(5.0)
    assert worker.submit(lambda: 7).result(5.0) == 7
    worker.close()


def request_stop_after_error() -> bool:
    """Return whether a stop port answers although its handler raises an error for the first request."""
    requesters: list[str] = []

    def on_stop_request(requester: str, reply: Reply) -> None:
        requesters.append(requester)
        if len(requesters) == 1:
            raise UnexpectedError("no file is left")
        reply("done")

    with open_stop_port(LOOPBACK, 0) as server_socket:
        start_stop_server(server_socket, "worm", on_stop_request)
        port = server_socket.getsockname()[1]
        return request_stop(LOOPBACK, port, "anna", 5.0) is not None


def latch_estop_after_error(folder: Path) -> bool:
    """Return whether a second emergency stop is stored although the callback of the first one raises an error."""
    latch = EstopLatch(folder)
    failures = SimpleQueue[str | None]()

    def fail(_failure: str | None) -> None:
        raise UnexpectedError("the network is closed")

    latch.engage("anna", 1, fail)
    latch.engage("berta", 2, failures.put)
    return failures.get(timeout=5.0) is None


def send_request_after_invalid_message() -> bool:
    """Return whether a host receives a request over its private channel after an invalid message."""
    starter, host = socket_pair()
    received = threading.Event()

    def on_request(_request: LifecycleRequest, _reply: Callable[[Answer], None]) -> None:
        received.set()

    with starter, host:
        HostEnd(host).start_serving(on_request)
        starter.send(b"\xc1 no message")
        starter.send(msgspec.msgpack.encode(LifecycleRequest(action="disarm")))
        was_received = received.wait(5.0)
        host.shutdown(socket.SHUT_RDWR)
    return was_received


def test_threads_that_stop_a_robot_serve_after_an_error(tmp_path: Path) -> None:
    assert request_stop_after_error()
    assert latch_estop_after_error(tmp_path)
    assert send_request_after_invalid_message()


def test_background_thread_starts_before_its_first_job() -> None:
    worker = BackgroundThread("worker-of-the-test")
    wait_until(
        lambda: any(thread.name == "worker-of-the-test" for thread in threading.enumerate()),
        "the thread",
        5.0,
    )
    worker.close()
