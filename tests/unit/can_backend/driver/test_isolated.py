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

FAILING_JOINT = 2
FAILING_NAME = f"joint_{FAILING_JOINT + 1}"
OTHER_JOINTS = [i for i in range(JOINT_COUNT) if i != FAILING_JOINT]
ALL_ARMED = [ModuleState.ARMED] * JOINT_COUNT
ALL_DISARMED = [ModuleState.DISARMED] * JOINT_COUNT
OTHERS_ARMED = [ModuleState.ARMED] * len(OTHER_JOINTS)

# Speeds of the joints that swing.
SWING_SPEED_RAD_S = 0.5
MOVING_SPEED_RAD_S = 0.2  # a joint that is faster follows its command
SWING_PERIODS = 50  # in one direction

# Waiting times, in control periods of 10 ms. Those without a limit of their own are generous.
DEADLINE_PERIODS = 5  # until a second lost joint stops the robot
SETTLE_PERIODS = (
    30  # until a fault is detected or a joint follows its command; `MODULE_FAULTS` needs at most 14
)
REBOOT_PERIODS = 60  # until a module has restarted and has its parameters again
RECOVERY_PERIODS = 40  # after the end of a fault, until the module answers again
STOP_PERIODS = 5  # until the modules have stopped
RESET_PERIODS = 20  # until a reset has reached every module


class IsolatingRobot(BackendRig):
    """The rig of the contract suite, with access to the joint modules."""

    @property
    def can(self) -> CanBackend:
        assert isinstance(self.backend, CanBackend)
        return self.backend

    def states(self) -> list[ModuleState]:
        """Return the state that each module has reported last."""
        return [module.state for module in self.can.modules.module_reports.modules]

    def other_states(self) -> list[ModuleState]:
        """Return the state of each module except for the failing one."""
        states = self.states()
        return [states[i] for i in OTHER_JOINTS]

    def inject(self, text: str, *, begins: bool = True) -> None:
        """Begin or end a fault, such as `mute:joint_3`."""
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
            goes_forward = self.tick // SWING_PERIODS % 2
            velocity_rad_s = SWING_SPEED_RAD_S if goes_forward else -SWING_SPEED_RAD_S
            self.command_joints(dict.fromkeys(OTHER_JOINTS, (JointMode.VELOCITY, velocity_rad_s)))

    def are_other_joints_moving(self) -> list[bool]:
        """Return for each of the other joints whether it moves."""
        speeds_rad_s = [abs(self.newest_joints.velocity_rad_s[i]) for i in OTHER_JOINTS]
        return [speed_rad_s > MOVING_SPEED_RAD_S for speed_rad_s in speeds_rad_s]

    def assert_only_failing_joint_is_isolated(self) -> None:
        assert self.authority.isolated_joints == [FAILING_NAME], self.authority.reason


@contextmanager
def open_swinging_robot(max_isolated: int = 1) -> Iterator[IsolatingRobot]:
    """Open a robot that is armed, and whose other joints swing."""
    run = make_can_config(robot__safety__max_isolated_joints=max_isolated)
    backend = CanBackend(run, CanSettings(physics_model="inertia"))
    try:
        robot = IsolatingRobot(backend, "lockstep", run.period_ns)
        robot.arm()
        robot.swing_other_joints(SETTLE_PERIODS)
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
        assert robot.states() == ALL_ARMED
        assert all(robot.are_other_joints_moving())

        robot.inject(f"{kind}:{FAILING_NAME}")
        robot.swing_other_joints(max_periods + 1)

        if fault_kind in ROBOT_FAULT_KINDS:
            assert robot.authority.state == "fault"
            assert robot.authority.isolated_joints == []
            return

        robot.assert_only_failing_joint_is_isolated()
        robot.swing_other_joints(SETTLE_PERIODS)
        robot.assert_armed()
        assert all(robot.are_other_joints_moving())
        assert {fault.joint for fault in robot.faults} == {FAILING_NAME}
        assert robot.other_states() == OTHERS_ARMED


# Faults of a module that end: it sent nothing, has restarted, or sent frames with a wrong checksum.
PASSING_FAULTS = ["mute", "reboot", "checksum"]


def isolate_failing_joint_for_a_time(robot: IsolatingRobot, kind: str) -> None:
    """Begin a fault of the failing joint, which isolates it, and end the fault while the others swing on."""
    robot.inject(f"{kind}:{FAILING_NAME}")
    robot.swing_other_joints(SETTLE_PERIODS)
    robot.assert_only_failing_joint_is_isolated()

    robot.inject(f"{kind}:{FAILING_NAME}", begins=False)
    robot.swing_other_joints(RECOVERY_PERIODS)
    robot.assert_armed()


@pytest.mark.parametrize("kind", PASSING_FAULTS)
def test_isolated_joint_whose_fault_has_ended_stays_off(kind: str) -> None:
    """A joint that moved again by itself would surprise a person who is near the robot."""
    with open_swinging_robot() as robot:
        isolate_failing_joint_for_a_time(robot, kind)

        assert robot.states()[FAILING_JOINT] != ModuleState.ARMED, "its motor must be off"


@pytest.mark.parametrize("kind", PASSING_FAULTS)
def test_isolated_joint_follows_again_after_a_reset(kind: str) -> None:
    with open_swinging_robot() as robot:
        isolate_failing_joint_for_a_time(robot, kind)
        fault_count_before_reset = len(robot.faults)

        robot.request("disarm")
        robot.wait_periods(STOP_PERIODS)
        robot.request("reset")
        robot.wait_periods(RESET_PERIODS)
        robot.arm()
        robot.swing_other_joints(SETTLE_PERIODS)

        robot.assert_armed()
        assert robot.states() == ALL_ARMED, "the reset joint has a motor that is off"
        assert robot.authority.isolated_joints == []
        new_faults = robot.faults[fault_count_before_reset:]
        assert not new_faults, new_faults


def test_robot_with_isolated_joint_can_be_armed_again() -> None:
    """Without a reset, the isolated joint stays off, and the others move again."""
    with open_swinging_robot() as robot:
        robot.inject(f"reboot:{FAILING_NAME}")
        robot.swing_other_joints(REBOOT_PERIODS)

        robot.disarm()
        robot.wait_periods(10)
        robot.arm()
        robot.swing_other_joints(SETTLE_PERIODS)

        robot.assert_armed()
        assert all(robot.are_other_joints_moving())
        assert robot.states()[FAILING_JOINT] == ModuleState.DISARMED
        assert robot.other_states() == OTHERS_ARMED


def test_failed_joints_beyond_the_allowed_number_stop_the_robot() -> None:
    """One joint may be isolated. The second one that fails stops the two that still work, joint_2 and joint_4."""
    with open_swinging_robot(max_isolated=1) as robot:
        robot.inject(f"mute:{FAILING_NAME}")
        robot.swing_other_joints(SETTLE_PERIODS)
        robot.assert_armed()

        robot.inject("mute:joint_1")
        robot.swing_other_joints(DEADLINE_PERIODS)
        assert robot.authority.state == "fault"

        robot.wait_periods(SETTLE_PERIODS)
        assert robot.states()[1] == ModuleState.DISARMED
        assert robot.states()[3] == ModuleState.DISARMED


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
    robot.wait_periods(RESET_PERIODS)


@pytest.mark.parametrize(
    ("is_armed", "joints", "max_isolated"),
    [(True, [2], 0), (True, [2], 1), (True, [2, 3], 1), (True, [2, 3], 2), (False, [2], 1)],
    ids=[
        "armed, one fails of none allowed",
        "armed, one fails of one allowed",
        "armed, two fail of one allowed",
        "armed, two fail of two allowed",
        "disarmed, one fails of one allowed",
    ],
)
def test_isolated_joint_reset_within_one_period_can_be_armed(
    is_armed: bool, joints: list[int], max_isolated: int
) -> None:
    with open_swinging_robot(max_isolated) as robot:
        if not is_armed:
            robot.request("disarm")
            robot.wait_periods(RESET_PERIODS)

        fail_and_reset_within_a_period(robot, *joints)
        assert robot.authority.state == "disarmed"
        assert robot.states() == ALL_DISARMED

        robot.arm()
        robot.swing_other_joints(SETTLE_PERIODS)
        robot.assert_armed()
        assert robot.states() == ALL_ARMED
        assert robot.authority.isolated_joints == []


@pytest.mark.parametrize("event", ["reset", "estop", "fault"])
def test_stop_is_sent_before_frames_for_a_lost_module(
    monkeypatch: pytest.MonkeyPatch, event: str
) -> None:
    """Send the stop first, although a lost module delays the driver by a second."""
    sent: list[CanFrame] = []
    send = VirtualWire.send

    def record_frame(wire: VirtualWire, frame: CanFrame) -> bool:
        sent.append(frame)
        return send(wire, frame)

    with open_swinging_robot() as robot:
        # The module restarts and so needs its parameters again. Then it becomes silent and does not accept them.
        robot.inject(f"reboot:{FAILING_NAME}")
        robot.swing_other_joints(REBOOT_PERIODS)
        robot.inject(f"mute:{FAILING_NAME}")
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

    expected = make_emergency() if event == "estop" else make_command(CommandAction.DISARM)
    assert sent[0] == expected, "another frame was sent before the stop"


def test_lost_module_is_disabled_immediately() -> None:
    """Do not brake it, because its own sensor may have failed."""
    with open_swinging_robot() as robot:
        robot.arm()
        moving = {FAILING_JOINT: (JointMode.VELOCITY, SWING_SPEED_RAD_S)}
        robot.command_joints(moving, SETTLE_PERIODS)

        robot.isolate_joint(FAILING_JOINT)
        robot.swing_other_joints(3)

        robot.assert_armed()
        assert robot.states()[FAILING_JOINT] == ModuleState.DISARMED
        assert find_chain(robot.can).slots[FAILING_JOINT].module.demand == PASSIVE
