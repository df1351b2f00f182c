"""Who may move the robot: leases, and which command counts."""

from typing import Any

import pytest

from snakesim_hal.safety.authority import COMMANDS_KEPT
from snakesim_hal.wire.messages import Mode
from snakesim_testing.hal.authority_rig import CLEAR, ESTOP, JOINTS, armed, modes
from snakesim_testing.hal.small_robots import LEASE_NS, PERIOD_NS

# --- lockstep: what counts is told by ticks --------------------------------------------------------------------


def test_in_lockstep_a_command_waits_for_its_tick() -> None:
    rig = armed()
    rig.send(0.11, tick=0)
    rig.tick = 1
    rig.send(0.12, tick=1)
    assert rig.authority.decide(0).setpoints.target == pytest.approx([0.11] * JOINTS)
    assert rig.authority.decide(1).setpoints.target == pytest.approx([0.12] * JOINTS)


def test_in_lockstep_the_last_command_goes_on_when_a_flood_has_pushed_it_out() -> None:
    """Falling back to the pose at arming would be a jump that no limiter has limited."""
    rig = armed()
    before = rig.authority.decide(0)
    for tick in range(5):
        rig.tick = tick
        rig.send(0.3)
        before = rig.authority.decide(tick)
    rig.tick = 5
    for _ in range(COMMANDS_KEPT + 1):
        rig.send(0.1)
    decision = rig.authority.decide(4)
    assert decision.sequence == before.sequence and decision.setpoints.target == pytest.approx([0.3] * JOINTS)


# --- the lease -------------------------------------------------------------------------------------------------


def test_commands_keep_the_lease_and_silence_ends_it_with_a_fault() -> None:
    rig = armed()
    for _ in range(20):
        assert rig.send(0.1) is None
        assert rig.pass_tick().sequence == rig.sequence
    for _ in range(LEASE_NS // PERIOD_NS - 1):  # the last command goes on for one term
        assert rig.pass_tick().sequence == rig.sequence
    decision = rig.pass_tick()
    assert rig.authority.state == "fault" and decision.sequence is None
    assert modes(decision) == {Mode.VELOCITY} and decision.setpoints.target == [0.0] * JOINTS
    (fault,) = rig.authority.faults
    assert (fault.what, fault.tick) == ("lease_expired", rig.tick)
    assert fault.cause == "lease of control expired: no accepted command for 50 ms"
    assert rig.authority.lease.holder is None


@pytest.mark.parametrize(
    "wrong",
    [{"lease_epoch": 0}, {"layout": "other"}, {"sequence": 1}, {"target": [float("nan")] * JOINTS}, {"tick": 10**6}],
)
def test_refused_commands_neither_keep_the_lease_nor_reach_a_motor(wrong: dict[str, Any]) -> None:
    rig = armed()
    rig.tick_with(0.1)
    good = rig.sequence
    for _ in range(4):
        assert rig.send(**{"target": 0.2, **wrong}) is not None
        decision = rig.pass_tick()
        assert decision.sequence == good and decision.setpoints.target == pytest.approx([0.1] * JOINTS)
    rig.tick_with(**{"target": 0.2, **wrong})
    assert rig.authority.state == "fault"
    assert sum(rig.authority.rejected_counts.values()) == 5


def test_preemption_stops_the_robot_and_voids_what_the_old_holder_sends() -> None:
    rig = armed()
    rig.tick_with(0.1)
    assert not rig.acquire("teleop").ok and rig.authority.state == "armed"
    answer = rig.acquire("teleop", priority=200)
    assert answer.ok and answer.epoch == 2 and answer.lifecycle == "disarmed"
    assert modes(rig.pass_tick()) == {Mode.PASSIVE}
    assert rig.send(0.1, lease_epoch=1) == "wrong_epoch"
    assert rig.arm().reason == "no commands from teleop yet"
    rig.send(0.1, sequence=1)  # a new holder counts from its own beginning
    assert rig.arm().ok


def test_a_holder_that_is_gone_frees_the_lease_but_explains_nothing_away() -> None:
    rig = armed()
    rig.authority.on_estop(ESTOP, 3)
    rig.authority.on_holder_gone("control is gone")
    assert rig.authority.lease.holder is None and "a person" in rig.authority.reason
    rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.authority.on_holder_gone("control is gone")
    assert rig.authority.reason == "control is gone"
    rig = armed()
    rig.authority.on_holder_gone("control is gone")  # armed, only the lease decides
    assert rig.authority.lease.holder == "control" and rig.authority.state == "armed"
