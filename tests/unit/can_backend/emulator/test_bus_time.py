"""The emulated bus: arbitration and duration of frames. Its measured load equals the computed load."""

import pytest

from snakesim_can_backend.bus.load import ReportSchedule, compute_bus_load, compute_max_frame_bits
from snakesim_can_backend.emulator.bus_time import MAX_AHEAD_US, BusTime, traffic_by_opcode
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_sync
from snakesim_can_backend.protocol.definitions import CanFrame, Opcode, frame_id, parse_opcode
from snakesim_testing.can.module_rig import make_setpoint, measure_bus_traffic

MAX_BITS_OF_8_BYTES = compute_max_frame_bits(8)


def make_frame(opcode: Opcode, node: int, mark: int = 0) -> CanFrame:
    """Return a frame of a node, whose first byte is a mark."""
    return CanFrame(
        frame_id(opcode, node), bytes((mark,)) + bytes(load_layouts()[opcode].length - 1)
    )


def test_bus_frame_arrives_after_its_last_bit():
    bus = BusTime()
    bus.enqueue(1, make_frame(Opcode.JOINT_STATE, 1), 100.0)
    assert bus.pop_sent_frames(100.0 + MAX_BITS_OF_8_BYTES - 1) == []
    assert bus.next_us() == 100.0 + MAX_BITS_OF_8_BYTES
    assert len(bus.pop_sent_frames(100.0 + MAX_BITS_OF_8_BYTES)) == 1


def test_bus_lowest_id_is_sent_first_without_interruption():
    bus = BusTime()
    bus.enqueue(9, make_frame(Opcode.HEARTBEAT, 9), 0.0)
    for node in (3, 2, 1):
        bus.enqueue(node, make_frame(Opcode.JOINT_STATE, node), 10.0)
    order = [sent_frame.id for sent_frame in bus.pop_sent_frames(1e6)]
    assert order == [frame_id(Opcode.HEARTBEAT, 9)] + [
        frame_id(Opcode.JOINT_STATE, node_id) for node_id in (1, 2, 3)
    ]


def test_bus_frames_of_one_module_keep_their_order():
    bus = BusTime()
    sent = [
        make_frame(Opcode.HEALTH, 1),
        make_frame(Opcode.JOINT_STATE, 1),
        make_frame(Opcode.GYRO, 1),
    ]
    for queued in sent:
        bus.enqueue(1, queued, 0.0)
    assert bus.pop_sent_frames(1e6) == sent


def test_bus_frames_of_the_host_delay_answers():
    bus = BusTime()
    for node in range(10):
        bus.record_host_frame(make_setpoint(0, node_id=node + 1), 0.0)
    bus.enqueue(1, make_frame(Opcode.JOINT_STATE, 1), 0.0)
    assert bus.next_us() == 10 * compute_max_frame_bits(6) + MAX_BITS_OF_8_BYTES
    for _ in range(10_000):
        bus.record_host_frame(make_setpoint(0), 0.0)
    assert bus.next_us() <= MAX_AHEAD_US + MAX_BITS_OF_8_BYTES


def test_bus_newer_setpoint_replaces_unsent_one_but_answers_are_kept():
    bus = BusTime()
    bus.record_host_frame(make_sync(0, 0), 0.0)
    for mark in range(5):
        bus.enqueue(1, make_frame(Opcode.JOINT_STATE, 1, mark), 1.0 + mark)
        bus.enqueue(1, make_frame(Opcode.PARAMETER_ANSWER, 1, mark), 1.0 + mark)
    sent = bus.pop_sent_frames(1e6)
    assert [
        sent_frame.data[0]
        for sent_frame in sent
        if parse_opcode(sent_frame.id) == Opcode.JOINT_STATE
    ] == [4]
    assert [
        sent_frame.data[0]
        for sent_frame in sent
        if parse_opcode(sent_frame.id) == Opcode.PARAMETER_ANSWER
    ] == list(range(5))
    assert bus.traffic(1e6).replaced == 4


def test_bus_babbling_module_uses_only_the_remaining_time():
    bus = BusTime()
    bus.set_babbling(5, make_frame(Opcode.HEARTBEAT, 5), 0.0)
    for mark in range(100):
        bus.enqueue(1, make_frame(Opcode.JOINT_STATE, 1, mark), 1000.0 * mark)
        bus.enqueue(2, make_frame(Opcode.GYRO, 2, mark), 1000.0 * mark)
    sent = bus.pop_sent_frames(100_000.0)
    assert sum(parse_opcode(sent_frame.id) == Opcode.JOINT_STATE for sent_frame in sent) == 100, (
        "a frame with a lower id is still sent"
    )
    assert sum(parse_opcode(sent_frame.id) == Opcode.GYRO for sent_frame in sent) == 0
    assert bus.traffic(100_000.0).load_since(BusTime().traffic(0.0)) == pytest.approx(1.0, abs=0.01)
    bus.set_babbling(5, None, 100_000.0)
    bus.pop_sent_frames(101_000.0)
    assert bus.pop_sent_frames(110_000.0) == []


@pytest.mark.parametrize(("joints", "rate_hz"), [(13, 50), (18, 100), (30, 50)])
def test_bus_measured_load_equals_computed_and_no_answer_is_late(joints: int, rate_hz: int):
    late, before, after, _ = measure_bus_traffic(joints, rate_hz)
    assert after.load_since(before) == pytest.approx(
        compute_bus_load(joints, ReportSchedule(rate_hz)), rel=0.05
    )
    assert set(late) == {0}
    assert after.replaced == 0


@pytest.mark.parametrize("joints", [13, 30])
def test_bus_overload_delays_frames_with_bounded_backlog(joints: int):
    _, before, after, backlog = measure_bus_traffic(joints, 200)
    assert after.load_since(before) == pytest.approx(1.0, abs=0.03)
    assert after.replaced > 0
    assert backlog <= 9 * joints
    assert after.late_us > 5000


def test_bus_traffic_is_counted_by_opcode():
    _, before, after, _ = measure_bus_traffic(4, 100, 1.0)
    frame_counts = {opcode: frames for opcode, frames, _ in traffic_by_opcode(before, after)}
    assert frame_counts[Opcode.SYNC] == 100
    assert frame_counts[Opcode.SET_POINT] == 400
    assert frame_counts[Opcode.JOINT_STATE] == pytest.approx(400, abs=4)
