"""The bus: who goes first, how long it takes, and that the measured load is the computed one."""

import pytest

from snakesim_can_backend.bus.load import Reports, load, worst_bits
from snakesim_can_backend.emulator.bus_time import MAX_AHEAD_US, BusTime, by_opcode
from snakesim_can_backend.protocol.codec import codec
from snakesim_can_backend.protocol.commands import sync
from snakesim_can_backend.protocol.definitions import Frame, Opcode, frame_id, opcode_of
from tests.unit.can_backend.emulator.rig import run_at, setpoint

FULL = worst_bits(8)


def frame(opcode: Opcode, node: int, mark: int = 0) -> Frame:
    return Frame(frame_id(opcode, node), bytes((mark,)) + bytes(codec()[opcode].length - 1))


def test_a_frame_is_there_when_its_last_bit_is():
    bus = BusTime()
    bus.offer(1, frame(Opcode.JOINT_STATE, 1), 100.0)
    assert bus.released(100.0 + FULL - 1) == [] and bus.next_us() == 100.0 + FULL
    assert len(bus.released(100.0 + FULL)) == 1


def test_the_lowest_id_wins_but_nobody_is_interrupted():
    bus = BusTime()
    bus.offer(9, frame(Opcode.HEARTBEAT, 9), 0.0)
    for node in (3, 2, 1):
        bus.offer(node, frame(Opcode.JOINT_STATE, node), 10.0)
    order = [f.id for f in bus.released(1e6)]
    assert order == [frame_id(Opcode.HEARTBEAT, 9)] + [frame_id(Opcode.JOINT_STATE, n) for n in (1, 2, 3)]


def test_a_module_keeps_its_own_order():
    bus = BusTime()
    sent = [frame(Opcode.HEALTH, 1), frame(Opcode.JOINT_STATE, 1), frame(Opcode.GYRO, 1)]
    for one in sent:
        bus.offer(1, one, 0.0)
    assert bus.released(1e6) == sent


def test_the_host_s_frames_take_their_time():
    bus = BusTime()
    for node in range(10):
        bus.heard(setpoint(0, node=node + 1), 0.0)
    bus.offer(1, frame(Opcode.JOINT_STATE, 1), 0.0)
    assert bus.next_us() == 10 * worst_bits(6) + FULL
    for _ in range(10_000):
        bus.heard(setpoint(0), 0.0)
    assert bus.next_us() <= MAX_AHEAD_US + FULL


def test_a_newer_frame_takes_the_place_of_an_unsent_one_but_answers_are_all_sent():
    bus = BusTime()
    bus.heard(sync(0, 0), 0.0)
    for mark in range(5):
        bus.offer(1, frame(Opcode.JOINT_STATE, 1, mark), 1.0 + mark)
        bus.offer(1, frame(Opcode.PARAMETER_ANSWER, 1, mark), 1.0 + mark)
    sent = bus.released(1e6)
    assert [f.data[0] for f in sent if opcode_of(f.id) == Opcode.JOINT_STATE] == [4]
    assert [f.data[0] for f in sent if opcode_of(f.id) == Opcode.PARAMETER_ANSWER] == list(range(5))
    assert bus.traffic(1e6).replaced == 4


def test_a_babbler_fills_what_the_others_leave():
    bus = BusTime()
    bus.babble(5, frame(Opcode.HEARTBEAT, 5), 0.0)
    for k in range(100):
        bus.offer(1, frame(Opcode.JOINT_STATE, 1, k), 1000.0 * k)
        bus.offer(2, frame(Opcode.GYRO, 2, k), 1000.0 * k)
    sent = bus.released(100_000.0)
    assert sum(opcode_of(f.id) == Opcode.JOINT_STATE for f in sent) == 100, "a lower id still gets through"
    assert sum(opcode_of(f.id) == Opcode.GYRO for f in sent) == 0
    assert bus.traffic(100_000.0).load_since(BusTime().traffic(0.0)) == pytest.approx(1.0, abs=0.01)
    bus.babble(5, None, 100_000.0)
    bus.released(101_000.0)
    assert bus.released(110_000.0) == []


@pytest.mark.parametrize(("joints", "rate_hz"), [(13, 50), (18, 100), (30, 50)])
def test_measured_load_is_the_computed_one_and_every_answer_comes_in_its_period(joints: int, rate_hz: int):
    late, before, after, _ = run_at(joints, rate_hz)
    assert after.load_since(before) == pytest.approx(load(joints, Reports(rate_hz)), rel=0.05)
    assert set(late) == {0} and after.replaced == 0


@pytest.mark.parametrize("joints", [13, 30])
def test_too_much_traffic_is_late_and_the_backlog_is_bounded(joints: int):
    _, before, after, backlog = run_at(joints, 200)
    assert after.load_since(before) == pytest.approx(1.0, abs=0.03)
    assert after.replaced > 0 and backlog <= 9 * joints and after.late_us > 5000


def test_every_opcode_is_counted():
    _, before, after, _ = run_at(4, 100, 1.0)
    rows = {opcode: frames for opcode, frames, _ in by_opcode(before, after)}
    assert rows[Opcode.SYNC] == 100 and rows[Opcode.SET_POINT] == 400
    assert rows[Opcode.JOINT_STATE] == pytest.approx(400, abs=4)
