"""One bus from one end: raw CAN frames and errors as Linux has them, on sockets that every machine has."""

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
CAN_ERR_TX_TIMEOUT, CAN_ERR_LOSTARB, CAN_ERR_CRTL, CAN_ERR_PROT = 0x001, 0x002, 0x004, 0x008
CAN_ERR_TRX, CAN_ERR_ACK, CAN_ERR_BUSOFF, CAN_ERR_BUSERROR = 0x010, 0x020, 0x040, 0x080
CAN_ERR_RESTARTED, CAN_ERR_CNT = 0x100, 0x200
RX_OVERFLOW, TX_OVERFLOW, RX_WARNING, TX_WARNING = 0x01, 0x02, 0x04, 0x08
RX_PASSIVE, TX_PASSIVE, ACTIVE = 0x10, 0x20, 0x40


def can_frame(identifier: int, data: bytes) -> bytes:
    """struct can_frame of linux/can.h: id, length, three bytes of padding, eight bytes of data."""
    return struct.pack("=IB3x8s", identifier, len(data), data)


# --- error frames ------------------------------------------------------------------------------------------


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
        (CAN_ERR_PROT, RX_PASSIVE, ["error_frames"]),  # without the class, the byte means nothing
        (CAN_ERR_TX_TIMEOUT, 0, ["error_frames"]),
        (CAN_ERR_LOSTARB, 0, ["error_frames"]),
        (CAN_ERR_TRX | CAN_ERR_BUSERROR | CAN_ERR_CNT, 0, ["error_frames"]),
    ],
)
def test_an_error_frame_in_words(classes: int, controller: int, kinds: list[Kind]) -> None:
    data = bytes((0, controller, 0, 0, 0, 0, 130, 7))
    expected = [BusError(kind, "can0", "transmit errors 130, receive errors 7") for kind in kinds]
    assert decode_error_frame(CAN_ERR_FLAG | classes, data, "can0") == expected


@given(st.integers(0, 0x1FFFFFFF), st.binary(min_size=8, max_size=8))
def test_every_error_frame_says_something(classes: int, data: bytes) -> None:
    found = decode_error_frame(CAN_ERR_FLAG | classes, data, "can0")
    assert found
    assert len({error.kind for error in found}) == len(found)


# --- frames through a socket -------------------------------------------------------------------------------


class CanLike(socket.socket):
    """A socket of another driver type that keeps what only CAN sockets take, and whose errors a test may choose."""

    filters = b""
    fails: OSError | None = None
    bound_to: tuple[str] | None = None

    def setsockopt(self, level: int, option: int, value: object, *_more: object) -> None:  # pyright: ignore
        if level == socket.SOL_CAN_RAW:
            assert option == socket.CAN_RAW_FILTER
            assert isinstance(value, bytes)
            self.filters = value

    def bind(self, address: tuple[str]) -> None:  # pyright: ignore
        self.bound_to = address

    def send(self, data: bytes, *_flags: int) -> int:  # pyright: ignore
        if self.fails is not None:
            raise self.fails
        return super().send(data)

    def recv_into(self, buffer: bytearray, *_more: int) -> int:  # pyright: ignore
        if self.fails is not None:
            raise self.fails
        return super().recv_into(buffer)


class Rig:
    """A SocketCanWire whose kernel is the other end of a pair of sockets."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, only: frozenset[Opcode] | None = None
    ) -> None:
        near, self.kernel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.kernel.settimeout(2.0)
        self.socket = CanLike(fileno=near.detach())
        self.up = True
        self.opened_with: dict[str, object] = {}

        def opened(**how: object) -> SimpleNamespace:
            """Instead of python-can's bus."""
            self.opened_with = how
            return SimpleNamespace(socket=self.socket, shutdown=self.socket.close)

        monkeypatch.setattr(wire_module, "SocketcanBus", opened)
        monkeypatch.setattr(wire_module, "validate_interface", lambda _channel: None)
        monkeypatch.setattr(wire_module, "is_up", lambda _channel: self.up)
        self.wire = SocketCanWire("can7", only)

    def kinds(self) -> list[Kind]:
        return [error.kind for error in self.wire.errors()]


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    made = Rig(monkeypatch)
    yield made
    made.wire.close()
    made.kernel.close()


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=20))
def test_drain_takes_everything_in_its_order(frames: list[tuple[int, bytes]]) -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        near.setblocking(False)
        errors: list[tuple[int, bytes]] = []
        taken: list[CanFrame] = []
        for identifier, data in frames:
            far.send(can_frame(identifier, data))
        far.send(can_frame(CAN_ERR_FLAG | CAN_ERR_BUSOFF, bytes(range(8))))
        drain_socket(
            near, bytearray(16), taken, lambda identifier, data: errors.append((identifier, data))
        )
        assert taken == [CanFrame(*frame) for frame in frames]
        assert all(type(frame) is CanFrame for frame in taken)
        assert errors == [(CAN_ERR_FLAG | CAN_ERR_BUSOFF, bytes(range(8)))]
        drain_socket(near, bytearray(16), taken, lambda *_: None)
        assert len(taken) == len(frames)


def test_a_bus_that_babbles_does_not_keep_its_reader() -> None:
    class Babbling:
        def recv_into(self, buffer: bytearray) -> int:
            buffer[:] = can_frame(0x101, bytes(8))
            return 16

    taken: list[CanFrame] = []
    drain_socket(Babbling(), bytearray(16), taken, lambda *_: None)  # pyright: ignore[reportArgumentType]
    assert len(taken) == MAX_AT_ONCE


def test_a_frame_goes_out_as_the_kernel_wants_it(rig: Rig) -> None:
    assert rig.wire.send(CanFrame(0x0C5, bytes.fromhex("3178EC581BF4")))
    assert rig.kernel.recv(64) == bytes.fromhex("C5000000 06000000 3178EC581BF40000")
    assert rig.wire.fileno() == rig.socket.fileno()
    assert rig.wire.idle() == math.inf
    assert rig.opened_with == {"channel": "can7", "ignore_rx_error_frames": False}


def test_frames_and_errors_come_in(rig: Rig) -> None:
    rig.kernel.send(can_frame(0x105, b"\x01\x02"))
    rig.kernel.send(can_frame(CAN_ERR_FLAG | CAN_ERR_BUSOFF, bytes(8)))
    rig.kernel.send(can_frame(0x080, bytes(5)))
    assert rig.wire.receive() == [CanFrame(0x105, b"\x01\x02"), CanFrame(0x080, bytes(5))]
    assert rig.kinds() == ["bus_off"]
    assert rig.kinds() == []
    assert rig.wire.receive() == []


def test_wire_full_queue_is_reported_and_nothing_kept(rig: Rig) -> None:
    sent = 0
    while rig.wire.send(CanFrame(0x101, bytes(8))):
        sent += 1
    assert rig.kinds() == ["queue_full"]
    for _ in range(sent):
        rig.kernel.recv(64)
    rig.kernel.settimeout(0.01)
    with pytest.raises(TimeoutError):
        rig.kernel.recv(64)
    assert rig.wire.send(CanFrame(0x102, b""))
    assert rig.kinds() == []


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EAGAIN])
def test_the_kernels_ways_to_say_full(rig: Rig, number: int) -> None:
    rig.socket.fails = OSError(number, "full")
    assert not rig.wire.send(CanFrame(0x101, b""))
    assert rig.wire.errors() == [BusError("queue_full", "can7", "the transmit queue is full")]


@pytest.mark.parametrize(
    ("number", "word"), [(errno.ENETDOWN, "down"), (errno.ENODEV, "gone"), (errno.ENXIO, "gone")]
)
def test_wire_lost_interface_is_reported_once_per_loss(rig: Rig, number: int, word: str) -> None:
    rig.socket.fails, rig.up = OSError(number, ""), False
    for _ in range(3):
        assert not rig.wire.send(CanFrame(0x101, b""))
        assert rig.wire.receive() == []
    assert rig.wire.errors() == [BusError("interface_down", "can7", f"the interface is {word}")]
    assert rig.kinds() == []
    rig.socket.fails, rig.up = None, True
    assert rig.wire.errors() == [BusError("interface_up", "can7", "the interface is up again")]
    assert rig.socket.bound_to == (("can7",) if word == "gone" else None)
    assert rig.kinds() == []
    assert rig.wire.send(CanFrame(0x101, b""))


def test_wire_sent_frame_proves_interface_is_back(rig: Rig) -> None:
    rig.socket.fails, rig.up = OSError(errno.ENETDOWN, ""), False
    rig.wire.receive()
    rig.socket.fails = None
    assert rig.wire.send(CanFrame(0x101, b""))
    assert rig.kinds() == ["interface_down", "interface_up"]


def test_what_came_before_an_error_is_not_lost(rig: Rig) -> None:
    rig.kernel.send(can_frame(0x105, b"\x01"))
    left = [1, 0]
    receive = rig.socket.recv_into

    def then_down(buffer: bytearray, *_more: int) -> int:
        if not left.pop(0):
            raise OSError(errno.ENETDOWN, "down")
        return receive(buffer)

    rig.socket.recv_into, rig.up = then_down, False
    assert rig.wire.receive() == [CanFrame(0x105, b"\x01")]
    assert rig.kinds() == ["interface_down"]


def test_anything_else_ends_the_run(rig: Rig) -> None:
    rig.kernel.close()
    with raises_error(BackendError, code="bus/io-failed"):
        rig.wire.send(CanFrame(0x101, b""))


@pytest.mark.parametrize("only", [None, FROM_HOST])
def test_the_kernel_filters(
    monkeypatch: pytest.MonkeyPatch, only: frozenset[Opcode] | None
) -> None:
    rig = Rig(monkeypatch, only)
    pairs = list(struct.iter_unpack("=II", rig.socket.filters))
    rig.wire.close()
    rig.kernel.close()

    def passes(identifier: int) -> bool:
        return any(identifier & mask == wanted & mask for wanted, mask in pairs)

    for identifier in range(0x800):
        assert passes(identifier) is (only is None or identifier >> 6 in only)
        assert not passes(0x80000000 | identifier) and not passes(0x40000000 | identifier), (
            "extended, remote"
        )
    assert rig.socket.fileno() == -1, "closed"


def test_dropped_frames_are_told_with_their_number(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    drops = iter([3, 3, 10])

    def meminfo(_level: int, option: int, length: int) -> bytes:
        assert option == 55
        assert length == 36  # SO_MEMINFO, nine numbers of which the last is the drops
        return struct.pack("=9I", *range(8), next(drops))

    monkeypatch.setattr(rig.socket, "getsockopt", meminfo)
    reported = [rig.wire.errors() for _ in range(3)]
    assert [[t.kind for t in found] for found in reported] == [
        ["receive_overflow"],
        [],
        ["receive_overflow"],
    ]
    assert "dropped 3 frames" in reported[0][0].detail
    assert "dropped 7 frames" in reported[2][0].detail


# --- interfaces --------------------------------------------------------------------------------------------


def test_an_interface_must_be_there_and_up(monkeypatch: pytest.MonkeyPatch) -> None:
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
