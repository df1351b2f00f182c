"""Buses through python-can: which wire a channel is, and what an adapter makes of frames that are not the modules'."""

import uuid
from collections.abc import Iterator

import can
import pytest

from snakesim_can_backend.bus.adapter import (
    REQUIREMENT_BY_INTERFACE,
    AdapterWire,
    is_emulated,
    open_bus,
    open_wire,
    validate_channel,
    validate_channels,
)
from snakesim_can_backend.bus.load import ReportSchedule, compute_bus_load, compute_busiest_period_s
from snakesim_can_backend.emulator.bus_time import BusTime
from snakesim_can_backend.protocol.definitions import CanFrame, Opcode, frame_id
from snakesim_hal.base.errors import BackendError, ConfigError, SnakesimError
from snakesim_testing.messages import raises_error

STATE = CanFrame(frame_id(Opcode.JOINT_STATE, 3), bytes(8))


@pytest.fixture
def channel() -> str:
    return f"virtual:{uuid.uuid4().hex}"


@pytest.fixture
def other(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel.partition(":")[2]) as bus:
        yield bus


def test_frames_go_both_ways_and_foreign_ones_are_left_out(channel: str, other: can.BusABC) -> None:
    wire = open_wire(channel)
    assert isinstance(wire, AdapterWire)
    assert wire.send(STATE)
    got = other.recv(1.0)
    assert got is not None
    assert (got.arbitration_id, bytes(got.data), got.is_extended_id) == (*STATE, False)
    other.send(can.Message(arbitration_id=STATE.id, data=bytes(8), is_extended_id=True))
    other.send(can.Message(arbitration_id=STATE.id, is_remote_frame=True, is_extended_id=False))
    other.send(can.Message(arbitration_id=0, is_error_frame=True))
    other.send(can.Message(arbitration_id=STATE.id, data=b"12345678", is_extended_id=False))
    assert wire.receive() == [CanFrame(STATE.id, b"12345678")]
    assert [error.kind for error in wire.errors()] == ["error_frames"]
    assert wire.errors() == []
    wire.close()


def test_adapter_receives_only_requested_frames_and_leaves_nothing(
    channel: str, other: can.BusABC
) -> None:
    wire = open_wire(channel, [Opcode.SYNC])
    sync = CanFrame(frame_id(Opcode.SYNC, 0), bytes(6))
    for frame in (STATE, sync, STATE, sync):
        other.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))
    assert wire.receive() == [sync, sync]
    wire.close()


@pytest.mark.parametrize(
    "channel",
    [
        "slacn:/dev/ttyACM0",
        "slcan:",
        "can7",
    ],
)
def test_a_wrong_channel_is_wrong_input(channel: str) -> None:
    with raises_error(ConfigError, code=("bus/invalid-channel", "bus/not-available")):
        validate_channel(channel)


def test_an_adapter_that_is_not_there_is_named() -> None:
    with raises_error(BackendError, code="bus/cannot-open"):
        open_wire("slcan:/dev/none")


# Left out: those that are there without an adapter, and one that would connect to a network.
@pytest.mark.parametrize("interface", sorted(can.VALID_INTERFACES - {"virtual", "udp_multicast"}))
@pytest.mark.parametrize("data_bit_rate", [None, 5_000_000])
def test_adapter_with_missing_library_or_device_explains_what_to_do(
    interface: str, data_bit_rate: int | None
) -> None:
    """Each of python-can's interfaces fails in its own way, one of them by a NameError."""
    with pytest.raises(SnakesimError) as raised:
        open_bus(f"{interface}:/dev/none", 1_000_000, data_bit_rate)
    words = str(raised.value)
    assert words.startswith(f"{interface}:/dev/none: cannot be opened: ")
    assert REQUIREMENT_BY_INTERFACE[interface] in words
    assert "Traceback" not in words and len(words) < 700, words


def test_a_bus_is_named_once() -> None:
    with raises_error(ConfigError, code="bus/invalid-channel", field="virtual:a"):
        validate_channels(["virtual:a", "virtual:b", "virtual:a"])
    validate_channels(["virtual:a", "virtual:b"])


def test_modules_are_emulated_where_no_real_ones_can_be() -> None:
    assert is_emulated("vcan0")
    assert is_emulated("udp_multicast:239.74.163.2")
    assert not is_emulated("can0")
    assert not is_emulated("slcan:/dev/ttyACM0")
    assert not is_emulated("socketcan:can0")


def test_half_the_bit_rate_takes_twice_as_long() -> None:
    slow = ReportSchedule(100.0, bit_rate=500_000)
    assert compute_bus_load(5, slow) == pytest.approx(
        2 * compute_bus_load(5, ReportSchedule(100.0))
    )
    assert compute_busiest_period_s(5, slow) == pytest.approx(
        2 * compute_busiest_period_s(5, ReportSchedule(100.0))
    )
    bus, slow_bus = BusTime(), BusTime(500_000)
    for one in (bus, slow_bus):
        one.enqueue(1, STATE, 0.0)
    assert slow_bus.next_us() == 2 * bus.next_us()
