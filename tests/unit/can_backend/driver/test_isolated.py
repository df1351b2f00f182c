"""If a robot may isolate a joint, its driver disables the module that fails, and the other joints continue.

Driver, emulators and the safety authority of the HAL are the real ones, in lockstep.
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

FAILING_JOINT = 2  # index of joint_3
OTHER_JOINTS = [i for i in range(JOINT_COUNT) if i != FAILING_JOINT]
DEADLINE_PERIODS = 5  # 50 ms


class IsolatingRobot(BackendRig):
    """The rig of the contract suite, with access to the joint modules."""

    @property
    def can(self) -> CanBackend:
        assert isinstance(self.backend, CanBackend)
        return self.backend

    def states(self) -> list[ModuleState]:
        return [module.state for module in self.can.modules.module_reports.modules]

    def inject(self, text: str, *, begins: bool = True) -> None:
        assert self.can.inject(parse_injection(f"{text}@0"), begins=begins)

    def request(self, action: Literal["disarm", "reset"]) -> None:
        """Send a lifecycle request, which must be accepted."""
        answer = self.authority.handle_lifecycle_request(
            LifecycleRequest(action=action), self._now_ns
        )
        assert answer.ok, answer.reason

    def swing_other_joints(self, periods: int) -> None:
        """Swing the other joints at a steady speed, in alternating directions."""
        for _ in range(periods):
            velocity_rad_s = 0.5 if self.tick // 50 % 2 else -0.5
            self.command_joints(dict.fromkeys(OTHER_JOINTS, (JointMode.VELOCITY, velocity_rad_s)))

    def are_other_joints_moving(self) -> list[bool]:
        """Return for each of the other joints whether it moves."""
        return [abs(self.newest_joints.velocity_rad_s[i]) > 0.2 for i in OTHER_JOINTS]


@contextmanager
def open_swinging_robot(max_isolated: int = 1) -> Iterator[IsolatingRobot]:
    """Open a robot that is armed, and whose other joints swing."""
    run = make_can_config(robot__safety__max_isolated_joints=max_isolated)
    backend = CanBackend(run, CanSettings(physics_model="inertia"))
    try:
        robot = IsolatingRobot(backend, "lockstep", run.period_ns)
        robot.arm()
        robot.swing_other_joints(30)
        yield robot
    finally:
        backend.close()


@pytest.mark.parametrize(
    ("kind", "fault_kind", "max_periods"), MODULE_FAULTS, ids=[row[0] for row in MODULE_FAULTS]
)
def test_failed_module_stops_alone_unless_fault_concerns_robot(
    kind: str, fault_kind: str, max_periods: int
) -> None:
    with open_swinging_robot() as robot:
        assert robot.states() == [ModuleState.ARMED] * JOINT_COUNT
        assert all(robot.are_other_joints_moving())
        robot.inject(f"{kind}:joint_{FAILING_JOINT + 1}")
        robot.swing_other_joints(max_periods + 1)
        if fault_kind in ROBOT_FAULT_KINDS:
            assert robot.authority.state == "fault"
            assert robot.authority.isolated_joints == []
            return
        assert robot.authority.isolated_joints == [f"joint_{FAILING_JOINT + 1}"], (
            robot.authority.reason
        )
        robot.swing_other_joints(30)
        robot.assert_armed()
        assert all(robot.are_other_joints_moving())
        assert {fault.joint for fault in robot.faults} == {f"joint_{FAILING_JOINT + 1}"}
        assert [robot.states()[i] for i in OTHER_JOINTS] == [ModuleState.ARMED] * (JOINT_COUNT - 1)


@pytest.mark.parametrize("kind", ["mute", "reboot", "checksum"])
def test_isolated_joint_follows_again_after_a_reset(kind: str) -> None:
    with open_swinging_robot() as robot:
        robot.inject(f"{kind}:joint_{FAILING_JOINT + 1}")
        robot.swing_other_joints(30)
        assert robot.authority.isolated_joints == [f"joint_{FAILING_JOINT + 1}"], (
            robot.authority.reason
        )
        robot.inject(f"{kind}:joint_{FAILING_JOINT + 1}", begins=False)
        robot.swing_other_joints(40)
        robot.assert_armed()
        assert robot.states()[FAILING_JOINT] != ModuleState.ARMED, "its motor must be off"
        fault_count = len(robot.faults)
        robot.request("disarm")
        robot.wait_periods(5)
        robot.request("reset")
        robot.wait_periods(20)
        robot.arm()
        robot.swing_other_joints(30)
        robot.assert_armed()
        assert robot.states() == [ModuleState.ARMED] * JOINT_COUNT
        assert robot.authority.isolated_joints == []
        assert len(robot.faults) == fault_count, robot.faults[fault_count:]


def test_robot_with_isolated_joint_can_be_armed_again() -> None:
    with open_swinging_robot() as robot:
        robot.inject(f"reboot:joint_{FAILING_JOINT + 1}")
        robot.swing_other_joints(60)
        robot.disarm()
        robot.wait_periods(10)
        robot.arm()
        robot.swing_other_joints(30)
        robot.assert_armed()
        assert all(robot.are_other_joints_moving())
        assert robot.states()[FAILING_JOINT] == ModuleState.DISARMED
        assert [robot.states()[i] for i in OTHER_JOINTS] == [ModuleState.ARMED] * (JOINT_COUNT - 1)


def test_failed_joints_beyond_the_allowed_number_stop_the_robot() -> None:
    with open_swinging_robot() as robot:
        robot.inject(f"mute:joint_{FAILING_JOINT + 1}")
        robot.swing_other_joints(30)
        robot.assert_armed()
        robot.inject("mute:joint_1")
        robot.swing_other_joints(DEADLINE_PERIODS)
        assert robot.authority.state == "fault"
        robot.wait_periods(30)
        assert robot.states()[1] == robot.states()[3] == ModuleState.DISARMED


def fail_and_reset_within_a_period(robot: IsolatingRobot, *joints: int) -> None:
    """Let modules fail with a latched fault, and reset the robot within one period."""
    chain = find_chain(robot.can)
    for joint in joints:
        chain.slots[joint].module._fail(ModuleFault.SENSOR, chain.now_us)
    for _ in range(20):
        if robot.authority.isolated_joints or robot.authority.state == "fault":
            break
        if robot.authority.state == "armed":
            robot.swing_other_joints(1)
        else:
            robot.wait_periods(1)
    if robot.authority.state == "armed":
        robot.request("disarm")
    robot.request("reset")
    robot.wait_periods(20)


@pytest.mark.parametrize(
    ("is_armed", "joints", "max_isolated"),
    [(True, [2], 0), (True, [2], 1), (True, [2, 3], 1), (True, [2, 3], 2), (False, [2], 1)],
)
def test_isolated_joint_reset_within_one_period_can_be_armed(
    is_armed: bool, joints: list[int], max_isolated: int
) -> None:
    with open_swinging_robot(max_isolated) as robot:
        if not is_armed:
            robot.request("disarm")
            robot.wait_periods(20)
        fail_and_reset_within_a_period(robot, *joints)
        assert robot.authority.state == "disarmed"
        assert robot.states() == [ModuleState.DISARMED] * JOINT_COUNT
        robot.arm()
        robot.swing_other_joints(30)
        robot.assert_armed()
        assert robot.states() == [ModuleState.ARMED] * JOINT_COUNT
        assert robot.authority.isolated_joints == []


@pytest.mark.parametrize("event", ["reset", "estop", "fault"])
def test_stop_is_sent_before_frames_for_a_lost_module(
    monkeypatch: pytest.MonkeyPatch, event: str
) -> None:
    """Send the stop first, although a lost module delays the driver by a second.

    It needs its parameters again, and does not accept them.
    """
    sent: list[CanFrame] = []
    send = VirtualWire.send

    def record_frame(wire: VirtualWire, frame: CanFrame) -> bool:
        sent.append(frame)
        return send(wire, frame)

    with open_swinging_robot() as robot:
        robot.inject(f"reboot:joint_{FAILING_JOINT + 1}")
        robot.swing_other_joints(60)
        robot.inject(f"mute:joint_{FAILING_JOINT + 1}")
        robot.swing_other_joints(10)
        robot.assert_armed()
        if event == "fault":
            robot.isolate_joint(0)
        else:
            robot.request("disarm")
        robot.request("reset")
        if event == "estop":
            robot.trigger_estop()
        monkeypatch.setattr(VirtualWire, "send", record_frame)
        robot.wait_periods()
    stops = [make_command(CommandAction.DISARM), make_command(CommandAction.STOP), make_emergency()]
    assert sent[0] == (make_emergency() if event == "estop" else stops[0])
    assert sent[0] in stops


def test_lost_module_is_disabled_immediately() -> None:
    """Do not brake it, because its own sensor may have failed."""
    with open_swinging_robot() as robot:
        robot.arm()
        robot.command_joints({FAILING_JOINT: (JointMode.VELOCITY, 0.5)}, 30)
        robot.isolate_joint(FAILING_JOINT)
        robot.swing_other_joints(3)
        robot.assert_armed()
        assert robot.states()[FAILING_JOINT] == ModuleState.DISARMED
        assert find_chain(robot.can).slots[FAILING_JOINT].module.demand == PASSIVE
