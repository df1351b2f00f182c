"""Virtual buses connect two ends within one process, and `wait` returns when a frame may have arrived."""

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


class EmulatedPeer:
    """The other end of a bus: it sends a frame when it runs, and returns after which time it must run again."""

    def __init__(self, pause_s: float | None, sending_wire: VirtualWire | None = None) -> None:
        self.pause_s = pause_s
        self.sending_wire = sending_wire
        self.run_count = 0
        self.closed = False

    def __call__(self) -> float | None:
        self.run_count += 1
        if self.sending_wire is not None:
            self.sending_wire.send(CanFrame(0x101, b"\x01"))
        return self.pause_s

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        raise AssertionError(f"these tests inject no faults, such as {injection}")

    def close(self) -> None:
        self.closed = True


class SocketWire(VirtualWire):
    """A bus that has a socket to wait for, as an interface of the kernel has."""

    def __init__(self, source: socket.socket) -> None:
        super().__init__(f"waits-{uuid.uuid4().hex}")
        self.source = source

    def fileno(self) -> int | None:
        return self.source.fileno()


@pytest.fixture
def pair() -> Iterator[tuple[VirtualWire, VirtualWire]]:
    name = f"wire-{uuid.uuid4().hex[:8]}"
    wires = (VirtualWire(name), VirtualWire(name))
    yield wires
    for wire in wires:
        wire.close()


def compute_elapsed_s(start_s: float) -> float:
    """Return the time since `start_s` of the monotonic clock."""
    return time.monotonic() - start_s


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


def test_virtual_bus_idle_returns_time_until_next_frame(
    pair: tuple[VirtualWire, VirtualWire],
) -> None:
    near, far = pair
    assert near.idle() == math.inf
    near.peer = EmulatedPeer(0.25)
    assert near.idle() == 0.25
    near.peer = EmulatedPeer(None)
    assert near.idle() is None
    far.send(CanFrame(1, b""))
    assert near.idle() == 0.0


def test_virtual_bus_closed_closes_its_peer() -> None:
    end = EmulatedPeer(None)
    VirtualWire(f"wire-{uuid.uuid4().hex[:8]}", end).close()
    assert end.closed


def test_wait_with_arrived_frame_returns_at_once(pair: tuple[VirtualWire, VirtualWire]) -> None:
    near, far = pair
    near.peer = EmulatedPeer(5.0, sending_wire=far)
    start_s = time.monotonic()
    assert wait([near], 5.0)
    assert compute_elapsed_s(start_s) < 1.0
    assert near.peer.run_count == 1


def test_wait_returns_when_a_peer_must_run(pair: tuple[VirtualWire, VirtualWire]) -> None:
    near, other = pair
    near.peer = EmulatedPeer(0.05)
    start_s = time.monotonic()
    assert wait([near, other], 5.0)
    assert 0.045 < compute_elapsed_s(start_s) < 1.0
    near.peer = EmulatedPeer(5.0)
    start_s = time.monotonic()
    assert wait([near], 0.05)
    assert 0.045 < compute_elapsed_s(start_s) < 1.0, "the wait was longer than its timeout"
    assert wait([near], -1.0), "a negative timeout is an error"


def test_wait_for_peer_that_never_runs_returns_false_at_once(
    pair: tuple[VirtualWire, VirtualWire],
) -> None:
    near, _ = pair
    near.peer = EmulatedPeer(None)
    start_s = time.monotonic()
    assert not wait([near], 5.0)
    assert compute_elapsed_s(start_s) < 1.0


def test_virtual_bus_wait_wakes_for_socket_and_reports_closed_one() -> None:
    near, far = socket.socketpair()
    with far:
        wire = SocketWire(near)
        start_s = time.monotonic()
        assert wait([wire], 0.05)
        assert compute_elapsed_s(start_s) > 0.045
        far.send(b"!")
        start_s = time.monotonic()
        assert wait([wire], 5.0)
        assert compute_elapsed_s(start_s) < 1.0
        near.close()
        with raises_error(BackendError, code="bus/io-failed"):
            wait([wire], 0.0)
        wire.close()


def test_virtual_bus_that_was_shut_down_raises_backend_error() -> None:
    wire = VirtualWire(f"gone-{uuid.uuid4().hex}")
    wire._bus.shutdown()
    with raises_error(BackendError, code="bus/io-failed"):
        wire.send(CanFrame(0x80, b"12345"))
    with raises_error(BackendError, code="bus/io-failed"):
        wire.receive()
