"""The driver kit controls holding brakes, and reacts to limit switches and safe torque off."""

import numpy as np
import pytest

from snakesim_drivers.kit.drive_states import DriveStates
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.holding_brakes import BrakePlan, HoldingBrakes
from snakesim_drivers.kit.limit_switches import LimitSwitches
from snakesim_hal.wire.messages import JointMode

PERIOD_NS = 10_000_000
ANGLE_RAD = np.array([0.5])


def make_command(
    *,
    is_enabled: bool,
    mode: JointMode = JointMode.POSITION,
    target: float = 0.9,
    emergency: bool = False,
) -> BusCommand:
    """Return the command of one drive."""
    following = frozenset({0}) if is_enabled else frozenset[int]()
    return BusCommand(
        following,
        [mode],
        np.array([target]),
        np.array([2.0]),
        may_enable=is_enabled,
        emergency=emergency,
    )


class BrakedDrive:
    """One drive with a brake that opens in 50 ms and closes in 30 ms. The drive follows each command immediately."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.is_enabled = False
        self.brakes = HoldingBrakes(1, release_s=0.05, engage_s=0.03, clock_ns=lambda: self.now_ns)

    def step(self, requested: BusCommand) -> BrakePlan:
        """Update the brake with a command, and let one period pass."""
        plan = self.brakes.update_brakes(requested, [0] if self.is_enabled else [], ANGLE_RAD)
        self.is_enabled = 0 in plan.command.enabled_drives
        self.now_ns += PERIOD_NS
        return plan


def test_brake_of_enabled_drive_opens_before_the_joint_moves() -> None:
    brake = BrakedDrive()
    plans = [brake.step(make_command(is_enabled=True)) for _ in range(8)]
    assert [bool(plan.released) for plan in plans] == [False] + [True] * 7
    assert [plan.command.targets[0] for plan in plans] == [0.5] * 6 + [0.9] * 2


def test_torque_is_held_until_the_brake_has_closed() -> None:
    brake = BrakedDrive()
    for _ in range(8):
        brake.step(make_command(is_enabled=True))
    plans = [
        brake.step(make_command(is_enabled=False, mode=JointMode.PASSIVE, target=0.0))
        for _ in range(5)
    ]
    assert not any(plan.released for plan in plans)
    assert [bool(plan.command.enabled_drives) for plan in plans] == [True] * 3 + [False] * 2
    assert plans[0].command.modes == [JointMode.POSITION]
    assert plans[0].command.targets[0] == 0.5
    assert plans[0].command.limits_nm[0] == 2.0


def test_emergency_stop_closes_brake_and_disables_torque_immediately() -> None:
    brake = BrakedDrive()
    for _ in range(8):
        brake.step(make_command(is_enabled=True))
    plan = brake.step(make_command(is_enabled=False, emergency=True))
    assert not plan.released
    assert not plan.command.enabled_drives


def test_drive_that_was_never_enabled_stays_off_when_disarmed() -> None:
    assert not BrakedDrive().step(make_command(is_enabled=False)).command.enabled_drives


@pytest.mark.parametrize(
    ("mode", "towards", "expected_towards", "away"),
    [
        (JointMode.POSITION, 0.9, 0.5, 0.1),
        (JointMode.VELOCITY, 1.0, 0.0, -1.0),
        (JointMode.TORQUE, 1.0, 0.0, -1.0),
    ],
)
def test_closed_limit_switch_allows_only_motion_away(
    mode: JointMode, towards: float, expected_towards: float, away: float
) -> None:
    switches = LimitSwitches(["joint_1"])
    switches.record_switches(0, lower=False, upper=True)
    for target, expected in ((towards, expected_towards), (away, away)):
        restricted = switches.restrict_command(
            make_command(is_enabled=True, mode=mode, target=target), ANGLE_RAD
        )
        assert restricted.targets[0] == expected


def test_closed_limit_switch_is_reported_once_until_reset() -> None:
    switches = LimitSwitches(["joint_1"])
    switches.record_switches(0, lower=True, upper=False)
    [finding] = switches.list_findings()
    assert (finding.what, finding.joint, finding.affects_only_joint) == ("limit_switch", 0, True)
    assert "lower limit switch" in finding.cause
    switches.reset(frozenset({0}))
    switches.record_switches(0, lower=True, upper=False)
    assert switches.list_findings() == []
    switches.record_switches(0, lower=False, upper=False)
    switches.record_switches(0, lower=True, upper=False)
    assert len(switches.list_findings()) == 1, "the switch has closed again"


def test_safe_torque_off_is_a_fault_that_stops_the_robot() -> None:
    states = DriveStates(["joint_1"], PERIOD_NS, lambda: 0)
    states.drives[0].safe_torque_off = True
    states.drives[0].errors = "something else, which is its consequence"
    [finding] = states.list_findings()
    assert (finding.what, finding.joint, finding.affects_only_joint) == (
        "safe_torque_off",
        0,
        False,
    )
