"""A bus sends and receives raw CAN frames and errors as Linux defines them, on sockets that every machine has."""

import errno
import math
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_can_backend.bus import bus as wire_module
from snakesim_can_backend.bus.bus import (
    MAX_AT_ONCE,
    SocketCanWire,
    drain_socket,
    is_up,
    validate_interface,
)
from snakesim_can_backend.bus.bus_errors import BusError, Kind, decode_error_frame
from snakesim_can_backend.protocol.definitions import FROM_HOST, CanFrame, Opcode
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_testing.messages import raises_error

CAN_ERR_FLAG = 0x20000000  # linux/can.h, linux/can/error.h
CAN_ERR_TX_TIMEOUT = 0x001
CAN_ERR_LOSTARB = 0x002
CAN_ERR_CRTL = 0x004
CAN_ERR_PROT = 0x008
CAN_ERR_TRX = 0x010
CAN_ERR_ACK = 0x020
CAN_ERR_BUSOFF = 0x040
CAN_ERR_BUSERROR = 0x080
CAN_ERR_RESTARTED = 0x100
CAN_ERR_CNT = 0x200
RX_OVERFLOW = 0x01
TX_OVERFLOW = 0x02
RX_WARNING = 0x04
TX_WARNING = 0x08
RX_PASSIVE = 0x10
TX_PASSIVE = 0x20
ACTIVE = 0x40


def pack_can_frame(identifier: int, data: bytes) -> bytes:
    """Return `struct can_frame` of linux/can.h: id, length, three bytes of padding, eight bytes of data."""
    return struct.pack("=IB3x8s", identifier, len(data), data)


# --- error frames ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("classes", "controller", "kinds"),
    [
        (CAN_ERR_BUSOFF, 0, ["bus_off"]),
        (CAN_ERR_ACK, 0, ["not_acknowledged"]),
        (CAN_ERR_RESTARTED, 0, ["restarted"]),
        (CAN_ERR_CRTL, RX_PASSIVE, ["error_passive"]),
        (CAN_ERR_CRTL, TX_PASSIVE, ["error_passive"]),
        (CAN_ERR_CRTL, RX_WARNING, ["error_warning"]),
        (CAN_ERR_CRTL, TX_WARNING, ["error_warning"]),
        (CAN_ERR_CRTL, RX_OVERFLOW, ["receive_overflow"]),
        (CAN_ERR_CRTL, TX_OVERFLOW, ["error_frames"]),
        (CAN_ERR_CRTL, ACTIVE, ["error_frames"]),
        (
            CAN_ERR_CRTL | CAN_ERR_BUSOFF,
            TX_PASSIVE | RX_OVERFLOW,
            ["bus_off", "error_passive", "receive_overflow"],
        ),
        (CAN_ERR_PROT, RX_PASSIVE, ["error_frames"]),  # the byte is undefined without its class
        (CAN_ERR_TX_TIMEOUT, 0, ["error_frames"]),
        (CAN_ERR_LOSTARB, 0, ["error_frames"]),
        (CAN_ERR_TRX | CAN_ERR_BUSERROR | CAN_ERR_CNT, 0, ["error_frames"]),
    ],
)
def test_error_frame_is_decoded_into_its_kinds(
    classes: int, controller: int, kinds: list[Kind]
) -> None:
    data = bytes((0, controller, 0, 0, 0, 0, 130, 7))
    expected = [BusError(kind, "can0", "transmit errors 130, receive errors 7") for kind in kinds]
    assert decode_error_frame(CAN_ERR_FLAG | classes, data, "can0") == expected


@given(st.integers(0, 0x1FFFFFFF), st.binary(min_size=8, max_size=8))
def test_every_error_frame_is_decoded_into_distinct_kinds(classes: int, data: bytes) -> None:
    errors = decode_error_frame(CAN_ERR_FLAG | classes, data, "can0")
    assert errors
    assert len({error.kind for error in errors}) == len(errors)


# --- frames through a socket -------------------------------------------------------------------------------------


class FakeCanSocket(socket.socket):
    """A local socket that stores the options of CAN sockets, and raises the errors that a test selects."""

    filters = b""
    raised_error: OSError | None = None
    bound_to: tuple[str] | None = None

    def setsockopt(self, level: int, option: int, value: object, *_more: object) -> None:  # pyright: ignore
        if level == socket.SOL_CAN_RAW:
            assert option == socket.CAN_RAW_FILTER
            assert isinstance(value, bytes)
            self.filters = value

    def bind(self, address: tuple[str]) -> None:  # pyright: ignore
        self.bound_to = address

    def send(self, data: bytes, *_flags: int) -> int:  # pyright: ignore
        if self.raised_error is not None:
            raise self.raised_error
        return super().send(data)

    def recv_into(self, buffer: bytearray, *_more: int) -> int:  # pyright: ignore
        if self.raised_error is not None:
            raise self.raised_error
        return super().recv_into(buffer)


class WireWithFakeKernel:
    """A SocketCanWire that is connected to the test instead of the kernel."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, only: frozenset[Opcode] | None = None
    ) -> None:
        near, self.kernel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.kernel.settimeout(2.0)
        self.socket = FakeCanSocket(fileno=near.detach())
        self.up = True
        self.opened_with: dict[str, object] = {}

        def open_fake_bus(**options: object) -> SimpleNamespace:
            """Replace the bus of python-can."""
            self.opened_with = options
            return SimpleNamespace(socket=self.socket, shutdown=self.socket.close)

        monkeypatch.setattr(wire_module, "SocketcanBus", open_fake_bus)
        monkeypatch.setattr(wire_module, "validate_interface", lambda _channel: None)
        monkeypatch.setattr(wire_module, "is_up", lambda _channel: self.up)
        self.wire = SocketCanWire("can7", only)

    def read_error_kinds(self) -> list[Kind]:
        """Return the kinds of the errors since the last call."""
        return [error.kind for error in self.wire.errors()]


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[WireWithFakeKernel]:
    rig = WireWithFakeKernel(monkeypatch)
    yield rig
    rig.wire.close()
    rig.kernel.close()


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=20))
def test_drain_socket_returns_all_frames_in_order(frames: list[tuple[int, bytes]]) -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        near.setblocking(False)
        errors: list[tuple[int, bytes]] = []
        received_frames: list[CanFrame] = []
        for identifier, data in frames:
            far.send(pack_can_frame(identifier, data))
        far.send(pack_can_frame(CAN_ERR_FLAG | CAN_ERR_BUSOFF, bytes(range(8))))
        drain_socket(
            near,
            bytearray(16),
            received_frames,
            lambda identifier, data: errors.append((identifier, data)),
        )
        assert received_frames == [CanFrame(*frame) for frame in frames]
        assert all(type(frame) is CanFrame for frame in received_frames)
        assert errors == [(CAN_ERR_FLAG | CAN_ERR_BUSOFF, bytes(range(8)))]
        drain_socket(near, bytearray(16), received_frames, lambda *_: None)
        assert len(received_frames) == len(frames)


def test_drain_socket_of_endless_frames_returns_a_limited_number() -> None:
    class EndlessSocket:
        def recv_into(self, buffer: bytearray) -> int:
            buffer[:] = pack_can_frame(0x101, bytes(8))
            return 16

    received_frames: list[CanFrame] = []
    drain_socket(EndlessSocket(), bytearray(16), received_frames, lambda *_: None)  # pyright: ignore[reportArgumentType]
    assert len(received_frames) == MAX_AT_ONCE


def test_wire_sends_frame_in_format_of_the_kernel(rig: WireWithFakeKernel) -> None:
    assert rig.wire.send(CanFrame(0x0C5, bytes.fromhex("3178EC581BF4")))
    assert rig.kernel.recv(64) == bytes.fromhex("C5000000 06000000 3178EC581BF40000")
    assert rig.wire.fileno() == rig.socket.fileno()
    assert rig.wire.idle() == math.inf
    assert rig.opened_with == {"channel": "can7", "ignore_rx_error_frames": False}


def test_wire_receives_frames_and_errors(rig: WireWithFakeKernel) -> None:
    rig.kernel.send(pack_can_frame(0x105, b"\x01\x02"))
    rig.kernel.send(pack_can_frame(CAN_ERR_FLAG | CAN_ERR_BUSOFF, bytes(8)))
    rig.kernel.send(pack_can_frame(0x080, bytes(5)))
    assert rig.wire.receive() == [CanFrame(0x105, b"\x01\x02"), CanFrame(0x080, bytes(5))]
    assert rig.read_error_kinds() == ["bus_off"]
    assert rig.read_error_kinds() == []
    assert rig.wire.receive() == []


def test_wire_full_queue_is_reported_and_nothing_kept(rig: WireWithFakeKernel) -> None:
    sent = 0
    while rig.wire.send(CanFrame(0x101, bytes(8))):
        sent += 1
    assert rig.read_error_kinds() == ["queue_full"]
    for _ in range(sent):
        rig.kernel.recv(64)
    rig.kernel.settimeout(0.01)
    with pytest.raises(TimeoutError):
        rig.kernel.recv(64)
    assert rig.wire.send(CanFrame(0x102, b""))
    assert rig.read_error_kinds() == []


@pytest.mark.parametrize("error_number", [errno.ENOBUFS, errno.EAGAIN])
def test_wire_errors_of_full_queue_are_reported_alike(
    rig: WireWithFakeKernel, error_number: int
) -> None:
    rig.socket.raised_error = OSError(error_number, "full")
    assert not rig.wire.send(CanFrame(0x101, b""))
    assert rig.wire.errors() == [BusError("queue_full", "can7", "the transmit queue is full")]


@pytest.mark.parametrize(
    ("error_number", "word"),
    [(errno.ENETDOWN, "down"), (errno.ENODEV, "gone"), (errno.ENXIO, "gone")],
)
def test_wire_lost_interface_is_reported_once_per_loss(
    rig: WireWithFakeKernel, error_number: int, word: str
) -> None:
    rig.socket.raised_error = OSError(error_number, "")
    rig.up = False
    for _ in range(3):
        assert not rig.wire.send(CanFrame(0x101, b""))
        assert rig.wire.receive() == []
    assert rig.wire.errors() == [BusError("interface_down", "can7", f"the interface is {word}")]
    assert rig.read_error_kinds() == []
    rig.socket.raised_error = None
    rig.up = True
    assert rig.wire.errors() == [BusError("interface_up", "can7", "the interface is up again")]
    assert rig.socket.bound_to == (("can7",) if word == "gone" else None)
    assert rig.read_error_kinds() == []
    assert rig.wire.send(CanFrame(0x101, b""))


def test_wire_sent_frame_proves_interface_is_back(rig: WireWithFakeKernel) -> None:
    rig.socket.raised_error = OSError(errno.ENETDOWN, "")
    rig.up = False
    rig.wire.receive()
    rig.socket.raised_error = None
    assert rig.wire.send(CanFrame(0x101, b""))
    assert rig.read_error_kinds() == ["interface_down", "interface_up"]


def test_wire_frames_before_an_error_are_received(rig: WireWithFakeKernel) -> None:
    rig.kernel.send(pack_can_frame(0x105, b"\x01"))
    call_count = 0
    receive = rig.socket.recv_into

    def receive_once_then_fail(buffer: bytearray, *_more: int) -> int:
        nonlocal call_count
        call_count += 1
        if call_count == 2:
            raise OSError(errno.ENETDOWN, "down")
        return receive(buffer)

    rig.socket.recv_into = receive_once_then_fail
    rig.up = False
    assert rig.wire.receive() == [CanFrame(0x105, b"\x01")]
    assert rig.read_error_kinds() == ["interface_down"]


def test_wire_unknown_error_raises_backend_error(rig: WireWithFakeKernel) -> None:
    rig.kernel.close()
    with raises_error(BackendError, code="bus/io-failed"):
        rig.wire.send(CanFrame(0x101, b""))


@pytest.mark.parametrize("only", [None, FROM_HOST])
def test_wire_filters_pass_only_wanted_standard_frames(
    monkeypatch: pytest.MonkeyPatch, only: frozenset[Opcode] | None
) -> None:
    rig = WireWithFakeKernel(monkeypatch, only)
    pairs = list(struct.iter_unpack("=II", rig.socket.filters))
    rig.wire.close()
    rig.kernel.close()

    def passes_filter(identifier: int) -> bool:
        return any(identifier & mask == wanted & mask for wanted, mask in pairs)

    for identifier in range(0x800):
        assert passes_filter(identifier) is (only is None or identifier >> 6 in only)
        extended_identifier = 0x80000000 | identifier
        remote_identifier = 0x40000000 | identifier
        assert not passes_filter(extended_identifier)
        assert not passes_filter(remote_identifier)
    assert rig.socket.fileno() == -1, "the socket is not closed"


def test_wire_dropped_frames_are_reported_with_their_number(
    rig: WireWithFakeKernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    drop_counts = iter([3, 3, 10])

    def get_memory_info(_level: int, option: int, length: int) -> bytes:
        assert option == 55
        assert length == 36  # SO_MEMINFO has nine numbers; the last one counts dropped frames
        return struct.pack("=9I", *range(8), next(drop_counts))

    monkeypatch.setattr(rig.socket, "getsockopt", get_memory_info)
    first_errors, second_errors, third_errors = (rig.wire.errors() for _ in range(3))
    assert [error.kind for error in first_errors] == ["receive_overflow"]
    assert second_errors == []
    assert [error.kind for error in third_errors] == ["receive_overflow"]
    assert "dropped 3 frames" in first_errors[0].detail
    assert "dropped 7 frames" in third_errors[0].detail


# --- interfaces --------------------------------------------------------------------------------------------------


def test_validate_interface_requires_can_and_interface_that_is_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(wire_module, "_kernel_has_can", lambda: False)
    with raises_error(ConfigError, code="bus/not-available", field="lo"):
        validate_interface("lo")
    monkeypatch.setattr(wire_module, "_kernel_has_can", lambda: True)
    with raises_error(ConfigError, code="bus/not-available", field="nocan7"):
        validate_interface("nocan7")
    monkeypatch.setattr(wire_module, "is_up", lambda _channel: False)
    with raises_error(ConfigError, code="bus/not-available", field="lo"):
        validate_interface("lo")
    monkeypatch.setattr(wire_module, "is_up", lambda _channel: True)
    validate_interface("lo")


def test_wire_absent_or_removed_interface_is_not_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not is_up("nocan7")
    (tmp_path / "flags").write_text("")
    monkeypatch.setattr(wire_module, "Path", lambda *parts: tmp_path / parts[-1])
    assert not is_up("can0")
