"""Buses are opened by python-can, and an adapter ignores frames that are not of the joint modules' protocol."""

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
    """Provide the name of a new virtual channel."""
    return f"virtual:{uuid.uuid4().hex}"


@pytest.fixture
def other_bus(channel: str) -> Iterator[can.BusABC]:
    """Provide the bus of another program on the same channel."""
    with can.Bus(interface="virtual", channel=channel.partition(":")[2]) as bus:
        yield bus


def test_adapter_exchanges_frames_and_ignores_unknown_ones(
    channel: str, other_bus: can.BusABC
) -> None:
    wire = open_wire(channel)
    assert isinstance(wire, AdapterWire)
    assert wire.send(STATE)
    received = other_bus.recv(1.0)
    assert received is not None
    assert received.arbitration_id == STATE.id
    assert bytes(received.data) == STATE.data
    assert not received.is_extended_id
    other_bus.send(can.Message(arbitration_id=STATE.id, data=bytes(8), is_extended_id=True))
    other_bus.send(can.Message(arbitration_id=STATE.id, is_remote_frame=True, is_extended_id=False))
    other_bus.send(can.Message(arbitration_id=0, is_error_frame=True))
    other_bus.send(can.Message(arbitration_id=STATE.id, data=b"12345678", is_extended_id=False))
    assert wire.receive() == [CanFrame(STATE.id, b"12345678")]
    assert [error.kind for error in wire.errors()] == ["error_frames"]
    assert wire.errors() == []
    wire.close()


def test_adapter_receives_only_requested_frames_and_leaves_nothing(
    channel: str, other_bus: can.BusABC
) -> None:
    wire = open_wire(channel, [Opcode.SYNC])
    sync = CanFrame(frame_id(Opcode.SYNC, 0), bytes(6))
    for frame in (STATE, sync, STATE, sync):
        other_bus.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))
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
def test_validate_channel_invalid_channel_is_refused(channel: str) -> None:
    with raises_error(ConfigError, code=("bus/invalid-channel", "bus/not-available")):
        validate_channel(channel)


def test_open_wire_of_missing_adapter_names_it() -> None:
    with raises_error(BackendError, code="bus/cannot-open"):
        open_wire("slcan:/dev/none")


# Without the interfaces that need no adapter, and the one that would connect to a network.
@pytest.mark.parametrize("interface", sorted(can.VALID_INTERFACES - {"virtual", "udp_multicast"}))
@pytest.mark.parametrize("data_bit_rate", [None, 5_000_000])
def test_adapter_with_missing_library_or_device_explains_what_to_do(
    interface: str, data_bit_rate: int | None
) -> None:
    """Each of python-can's interfaces raises another type of error, one of them a NameError."""
    with pytest.raises(SnakesimError) as raised:
        open_bus(f"{interface}:/dev/none", 1_000_000, data_bit_rate)
    message = str(raised.value)
    assert message.startswith(f"{interface}:/dev/none: cannot be opened: ")
    assert REQUIREMENT_BY_INTERFACE[interface] in message
    assert "Traceback" not in message, message
    assert len(message) < 700, message


def test_validate_channels_refuses_repeated_channel() -> None:
    with raises_error(ConfigError, code="bus/invalid-channel", field="virtual:a"):
        validate_channels(["virtual:a", "virtual:b", "virtual:a"])
    validate_channels(["virtual:a", "virtual:b"])


def test_is_emulated_only_for_channels_without_hardware() -> None:
    assert is_emulated("vcan0")
    assert is_emulated("udp_multicast:239.74.163.2")
    assert not is_emulated("can0")
    assert not is_emulated("slcan:/dev/ttyACM0")
    assert not is_emulated("socketcan:can0")


def test_bus_load_at_half_bit_rate_is_doubled() -> None:
    schedule = ReportSchedule(100.0)
    slow_schedule = ReportSchedule(100.0, bit_rate=500_000)
    load = compute_bus_load(5, schedule)
    assert compute_bus_load(5, slow_schedule) == pytest.approx(2 * load)
    busiest_period_s = compute_busiest_period_s(5, schedule)
    assert compute_busiest_period_s(5, slow_schedule) == pytest.approx(2 * busiest_period_s)
    bus_time = BusTime()
    slow_bus_time = BusTime(500_000)
    bus_time.enqueue(1, STATE, 0.0)
    slow_bus_time.enqueue(1, STATE, 0.0)
    assert slow_bus_time.next_us() == 2 * bus_time.next_us()
