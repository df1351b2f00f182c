"""A robot that may lose a joint, through the driver: the module that fails is switched off, and the others go on.

Driver, emulators and the HAL's authority are the real ones, stepped.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import pytest

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.driver.module_monitor import ROBOT_FAULT_KINDS
from snakesim_can_backend.emulator.firmware import PASSIVE
from snakesim_can_backend.protocol.commands import make_command, make_emergency
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleFault,
    ModuleState,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.wire.messages import JointMode, LifecycleRequest
from snakesim_testing.can.driver_loop import JOINT_COUNT, find_chain, make_can_config
from snakesim_testing.can.module_faults import MODULE_FAULTS
from snakesim_testing.contract.rig import BackendRig

FAILS = 2  # joint_3
OTHERS = [i for i in range(JOINT_COUNT) if i != FAILS]
DEADLINE = 5  # periods: 50 ms


class Lame(BackendRig):
    """What the contract's tests drive, and what there is to see of its modules."""

    @property
    def can(self) -> CanBackend:
        assert isinstance(self.backend, CanBackend)
        return self.backend

    def states(self) -> list[ModuleState]:
        return [module.state for module in self.can.modules.module_reports.modules]

    def inject(self, text: str, *, begins: bool = True) -> None:
        assert self.can.inject(parse_injection(f"{text}@0"), begins=begins)

    def ask(self, action: Literal["disarm", "reset"]) -> None:
        answer = self.authority.handle_lifecycle_request(
            LifecycleRequest(action=action), self._now_ns
        )
        assert answer.ok, answer.reason

    def wave(self, periods: int) -> None:
        """The others turn at a steady speed, and back."""
        for _ in range(periods):
            there = 0.5 if self.tick // 50 % 2 else -0.5
            self.command_joints(dict.fromkeys(OTHERS, (JointMode.VELOCITY, there)))

    def turning(self) -> list[bool]:
        return [abs(self.newest_joints.velocity_rad_s[i]) > 0.2 for i in OTHERS]


@contextmanager
def lame_robot(max_isolated: int = 1) -> Iterator[Lame]:
    """Armed, and its other joints swing."""
    run = make_can_config(robot__safety__max_isolated_joints=max_isolated)
    backend = CanBackend(run, CanSettings(physics_model="inertia"))
    try:
        robot = Lame(backend, "lockstep", run.period_ns)
        robot.arm()
        robot.wave(30)
        yield robot
    finally:
        backend.close()


@pytest.mark.parametrize(
    ("kind", "what", "within"), MODULE_FAULTS, ids=[row[0] for row in MODULE_FAULTS]
)
def test_a_module_that_fails_stops_alone_if_it_can(kind: str, what: str, within: int) -> None:
    with lame_robot() as robot:
        assert robot.states() == [ModuleState.ARMED] * JOINT_COUNT
        assert all(robot.turning())
        robot.inject(f"{kind}:joint_{FAILS + 1}")
        robot.wave(within + 1)
        if what in ROBOT_FAULT_KINDS:
            assert robot.authority.state == "fault"
            assert robot.authority.isolated_joints == []
            return
        assert robot.authority.isolated_joints == [f"joint_{FAILS + 1}"], robot.authority.reason
        robot.wave(30)
        robot.assert_armed()
        assert all(robot.turning())
        assert {fault.joint for fault in robot.faults} == {f"joint_{FAILS + 1}"}
        assert [robot.states()[i] for i in OTHERS] == [ModuleState.ARMED] * (JOINT_COUNT - 1)


@pytest.mark.parametrize("kind", ["mute", "reboot", "checksum"])
def test_the_joint_is_taken_back_by_a_clear(kind: str) -> None:
    with lame_robot() as robot:
        robot.inject(f"{kind}:joint_{FAILS + 1}")
        robot.wave(30)
        assert robot.authority.isolated_joints == [f"joint_{FAILS + 1}"], robot.authority.reason
        robot.inject(f"{kind}:joint_{FAILS + 1}", begins=False)
        robot.wave(40)
        robot.assert_armed()
        assert robot.states()[FAILS] != ModuleState.ARMED, "its motor is on"
        reported = len(robot.faults)
        robot.ask("disarm")
        robot.wait_periods(5)
        robot.ask("reset")
        robot.wait_periods(20)
        robot.arm()
        robot.wave(30)
        robot.assert_armed()
        assert robot.states() == [ModuleState.ARMED] * JOINT_COUNT
        assert robot.authority.isolated_joints == []
        assert len(robot.faults) == reported, robot.faults[reported:]


def test_it_may_be_armed_again_without_the_joint() -> None:
    with lame_robot() as robot:
        robot.inject(f"reboot:joint_{FAILS + 1}")
        robot.wave(60)
        robot.disarm()
        robot.wait_periods(10)
        robot.arm()
        robot.wave(30)
        robot.assert_armed()
        assert all(robot.turning())
        assert robot.states()[FAILS] == ModuleState.DISARMED
        assert [robot.states()[i] for i in OTHERS] == [ModuleState.ARMED] * (JOINT_COUNT - 1)


def test_one_joint_too_many_stops_all() -> None:
    with lame_robot() as robot:
        robot.inject(f"mute:joint_{FAILS + 1}")
        robot.wave(30)
        robot.assert_armed()
        robot.inject("mute:joint_1")
        robot.wave(DEADLINE)
        assert robot.authority.state == "fault"
        robot.wait_periods(30)
        assert robot.states()[1] == robot.states()[3] == ModuleState.DISARMED


def swallowed(robot: Lame, *joints: int) -> None:
    """Modules fail with a fault that lasts until they are reset, and a person resets before a period has passed."""
    chain = find_chain(robot.can)
    for joint in joints:
        chain.slots[joint].module._fail(ModuleFault.SENSOR, chain.now_us)
    for _ in range(20):
        if robot.authority.isolated_joints or robot.authority.state == "fault":
            break
        (robot.wave if robot.authority.state == "armed" else robot.wait_periods)(1)
    if robot.authority.state == "armed":
        robot.ask("disarm")
    robot.ask("reset")
    robot.wait_periods(20)


@pytest.mark.parametrize(
    ("driven", "joints", "max_isolated"),
    [(True, [2], 0), (True, [2], 1), (True, [2, 3], 1), (True, [2, 3], 2), (False, [2], 1)],
)
def test_isolated_joint_reset_within_one_period_still_clears(
    driven: bool, joints: list[int], max_isolated: int
) -> None:
    with lame_robot(max_isolated) as robot:
        if not driven:
            robot.ask("disarm")
            robot.wait_periods(20)
        swallowed(robot, *joints)
        assert robot.authority.state == "disarmed"
        assert robot.states() == [ModuleState.DISARMED] * JOINT_COUNT
        robot.arm()
        robot.wave(30)
        robot.assert_armed()
        assert robot.states() == [ModuleState.ARMED] * JOINT_COUNT
        assert robot.authority.isolated_joints == []


@pytest.mark.parametrize("then", ["reset", "estop", "fault"])
def test_what_stops_the_motors_waits_for_nothing(
    monkeypatch: pytest.MonkeyPatch, then: str
) -> None:
    """A module that is lost needs its parameters again and does not take them: that takes a second."""
    sent: list[CanFrame] = []
    send = VirtualWire.send

    def overheard(wire: VirtualWire, frame: CanFrame) -> bool:
        sent.append(frame)
        return send(wire, frame)

    with lame_robot() as robot:
        robot.inject(f"reboot:joint_{FAILS + 1}")
        robot.wave(60)
        robot.inject(f"mute:joint_{FAILS + 1}")
        robot.wave(10)
        robot.assert_armed()
        if then == "fault":
            robot.isolate_joint(0)
        else:
            robot.ask("disarm")
        robot.ask("reset")
        if then == "estop":
            robot.trigger_estop()
        monkeypatch.setattr(VirtualWire, "send", overheard)
        robot.wait_periods()
    stops = [make_command(CommandAction.DISARM), make_command(CommandAction.STOP), make_emergency()]
    assert sent[0] == (make_emergency() if then == "estop" else stops[0])
    assert sent[0] in stops


def test_a_lost_module_is_switched_off_at_once() -> None:
    """Not braked: its own sensor may be what is wrong."""
    with lame_robot() as robot:
        robot.arm()
        robot.command_joints({FAILS: (JointMode.VELOCITY, 0.5)}, 30)
        robot.isolate_joint(FAILS)
        robot.wave(3)
        robot.assert_armed()
        assert robot.states()[FAILS] == ModuleState.DISARMED
        assert find_chain(robot.can).slots[FAILS].module.demand == PASSIVE
