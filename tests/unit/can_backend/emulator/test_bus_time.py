"""The bus: who goes first, how long it takes, and that the measured load is the computed one."""

import pytest

from snakesim_can_backend.bus.load import ReportSchedule, compute_bus_load, compute_max_frame_bits
from snakesim_can_backend.emulator.bus_time import MAX_AHEAD_US, BusTime, traffic_by_opcode
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_sync
from snakesim_can_backend.protocol.definitions import CanFrame, Opcode, frame_id, parse_opcode
from snakesim_testing.can.module_rig import make_setpoint, measure_bus_traffic

FULL = compute_max_frame_bits(8)


def frame(opcode: Opcode, node: int, mark: int = 0) -> CanFrame:
    return CanFrame(
        frame_id(opcode, node), bytes((mark,)) + bytes(load_layouts()[opcode].length - 1)
    )


def test_a_frame_is_there_when_its_last_bit_is():
    bus = BusTime()
    bus.enqueue(1, frame(Opcode.JOINT_STATE, 1), 100.0)
    assert bus.pop_sent_frames(100.0 + FULL - 1) == []
    assert bus.next_us() == 100.0 + FULL
    assert len(bus.pop_sent_frames(100.0 + FULL)) == 1


def test_the_lowest_id_wins_but_nobody_is_interrupted():
    bus = BusTime()
    bus.enqueue(9, frame(Opcode.HEARTBEAT, 9), 0.0)
    for node in (3, 2, 1):
        bus.enqueue(node, frame(Opcode.JOINT_STATE, node), 10.0)
    order = [f.id for f in bus.pop_sent_frames(1e6)]
    assert order == [frame_id(Opcode.HEARTBEAT, 9)] + [
        frame_id(Opcode.JOINT_STATE, n) for n in (1, 2, 3)
    ]


def test_a_module_keeps_its_own_order():
    bus = BusTime()
    sent = [frame(Opcode.HEALTH, 1), frame(Opcode.JOINT_STATE, 1), frame(Opcode.GYRO, 1)]
    for one in sent:
        bus.enqueue(1, one, 0.0)
    assert bus.pop_sent_frames(1e6) == sent


def test_the_host_s_frames_take_their_time():
    bus = BusTime()
    for node in range(10):
        bus.record_host_frame(make_setpoint(0, node_id=node + 1), 0.0)
    bus.enqueue(1, frame(Opcode.JOINT_STATE, 1), 0.0)
    assert bus.next_us() == 10 * compute_max_frame_bits(6) + FULL
    for _ in range(10_000):
        bus.record_host_frame(make_setpoint(0), 0.0)
    assert bus.next_us() <= MAX_AHEAD_US + FULL


def test_bus_newer_setpoint_replaces_unsent_one_but_answers_are_kept():
    bus = BusTime()
    bus.record_host_frame(make_sync(0, 0), 0.0)
    for mark in range(5):
        bus.enqueue(1, frame(Opcode.JOINT_STATE, 1, mark), 1.0 + mark)
        bus.enqueue(1, frame(Opcode.PARAMETER_ANSWER, 1, mark), 1.0 + mark)
    sent = bus.pop_sent_frames(1e6)
    assert [f.data[0] for f in sent if parse_opcode(f.id) == Opcode.JOINT_STATE] == [4]
    assert [f.data[0] for f in sent if parse_opcode(f.id) == Opcode.PARAMETER_ANSWER] == list(
        range(5)
    )
    assert bus.traffic(1e6).replaced == 4


def test_a_babbler_fills_what_the_others_leave():
    bus = BusTime()
    bus.set_babbling(5, frame(Opcode.HEARTBEAT, 5), 0.0)
    for k in range(100):
        bus.enqueue(1, frame(Opcode.JOINT_STATE, 1, k), 1000.0 * k)
        bus.enqueue(2, frame(Opcode.GYRO, 2, k), 1000.0 * k)
    sent = bus.pop_sent_frames(100_000.0)
    assert sum(parse_opcode(f.id) == Opcode.JOINT_STATE for f in sent) == 100, (
        "a lower id still gets through"
    )
    assert sum(parse_opcode(f.id) == Opcode.GYRO for f in sent) == 0
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
def test_too_much_traffic_is_late_and_the_backlog_is_bounded(joints: int):
    _, before, after, backlog = measure_bus_traffic(joints, 200)
    assert after.load_since(before) == pytest.approx(1.0, abs=0.03)
    assert after.replaced > 0
    assert backlog <= 9 * joints
    assert after.late_us > 5000


def test_every_opcode_is_counted():
    _, before, after, _ = measure_bus_traffic(4, 100, 1.0)
    rows = {opcode: frames for opcode, frames, _ in traffic_by_opcode(before, after)}
    assert rows[Opcode.SYNC] == 100
    assert rows[Opcode.SET_POINT] == 400
    assert rows[Opcode.JOINT_STATE] == pytest.approx(400, abs=4)
