"""Virtual buses within the process, and how one waits for frames."""

import math
import socket
import time
import uuid
from collections.abc import Iterator

import pytest

from snakesim_can_backend.bus.bus import VirtualWire, wait
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_testing.messages import raises_error


class End:
    """Another end that says when it wants to run again."""

    def __init__(self, pause_s: float | None, then_send: VirtualWire | None = None) -> None:
        self.pause_s, self.then_send = pause_s, then_send
        self.ran = 0
        self.closed = False

    def __call__(self) -> float | None:
        self.ran += 1
        if self.then_send is not None:
            self.then_send.send(CanFrame(0x101, b"\x01"))
        return self.pause_s

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        raise AssertionError(f"nobody asked for {injection}")

    def close(self) -> None:
        self.closed = True


class OnSocket(VirtualWire):
    """A bus that is waited for by a socket, as a kernel interface is."""

    def __init__(self, source: socket.socket) -> None:
        super().__init__(f"waits-{uuid.uuid4().hex}")
        self.source = source

    def fileno(self) -> int | None:
        return self.source.fileno()


@pytest.fixture
def pair() -> Iterator[tuple[VirtualWire, VirtualWire]]:
    name = f"wire-{uuid.uuid4().hex[:8]}"
    made = VirtualWire(name), VirtualWire(name)
    yield made
    for wire in made:
        wire.close()


def took_s(began: float) -> float:
    return time.monotonic() - began


def test_virtual_bus_ends_receive_each_other_and_not_themselves(
    pair: tuple[VirtualWire, VirtualWire],
) -> None:
    near, far = pair
    frames = [CanFrame(0x105, b"\x01\x02"), CanFrame(0x7FF, b""), CanFrame(0, bytes(8))]
    assert all(near.send(frame) for frame in frames)
    assert far.receive() == frames
    assert far.receive() == []
    assert near.receive() == []
    assert near.fileno() is None
    assert near.errors() == []


def test_a_virtual_bus_says_when_something_may_come(pair: tuple[VirtualWire, VirtualWire]) -> None:
    near, far = pair
    assert near.idle() == math.inf
    near.peer = End(0.25)
    assert near.idle() == 0.25
    near.peer = End(None)
    assert near.idle() is None
    far.send(CanFrame(1, b""))
    assert near.idle() == 0.0


def test_closing_one_end_closes_what_lives_on_the_other() -> None:
    end = End(None)
    VirtualWire(f"wire-{uuid.uuid4().hex[:8]}", end).close()
    assert end.closed


def test_wait_does_not_sleep_when_a_frame_is_there(pair: tuple[VirtualWire, VirtualWire]) -> None:
    near, far = pair
    near.peer = End(5.0, then_send=far)
    began = time.monotonic()
    assert wait([near], 5.0)
    assert took_s(began) < 1.0
    assert near.peer.ran == 1


def test_wait_sleeps_as_long_as_nobody_wants_to_run(pair: tuple[VirtualWire, VirtualWire]) -> None:
    near, other = pair
    near.peer = End(0.05)
    began = time.monotonic()
    assert wait([near, other], 5.0)
    assert 0.045 < took_s(began) < 1.0
    near.peer = End(5.0)
    began = time.monotonic()
    assert wait([near], 0.05) and 0.045 < took_s(began) < 1.0, "and no longer than asked for"
    assert wait([near], -1.0), "time that is over is no error"


def test_wait_says_when_nothing_can_come(pair: tuple[VirtualWire, VirtualWire]) -> None:
    near, _ = pair
    near.peer = End(None)
    began = time.monotonic()
    assert not wait([near], 5.0)
    assert took_s(began) < 1.0


def test_virtual_bus_wait_wakes_for_socket_and_reports_closed_one() -> None:
    near, far = socket.socketpair()
    with far:
        wire = OnSocket(near)
        began = time.monotonic()
        assert wait([wire], 0.05)
        assert took_s(began) > 0.045
        far.send(b"!")
        began = time.monotonic()
        assert wait([wire], 5.0)
        assert took_s(began) < 1.0
        near.close()
        with raises_error(BackendError, code="bus/io-failed"):
            wait([wire], 0.0)
        wire.close()


def test_virtual_bus_that_is_gone_is_a_backend_error() -> None:
    wire = VirtualWire(f"gone-{uuid.uuid4().hex}")
    wire._bus.shutdown()
    with raises_error(BackendError, code="bus/io-failed"):
        wire.send(CanFrame(0x80, b"12345"))
    with raises_error(BackendError, code="bus/io-failed"):
        wire.receive()
