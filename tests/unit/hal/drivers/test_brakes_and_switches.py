"""Holding brakes, limit switches and the safe-torque-off input of drives."""

import numpy as np
import pytest

from snakesim_drivers.kit.drive_states import DriveStates
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.holding_brakes import BrakePlan, HoldingBrakes
from snakesim_drivers.kit.limit_switches import LimitSwitches
from snakesim_hal.wire.messages import JointMode

PERIOD_NS = 10_000_000
ANGLE_RAD = np.array([0.5])


def command(
    *,
    follow: bool,
    mode: JointMode = JointMode.POSITION,
    target: float = 0.9,
    emergency: bool = False,
) -> BusCommand:
    following = frozenset({0}) if follow else frozenset[int]()
    return BusCommand(
        following,
        [mode],
        np.array([target]),
        np.array([2.0]),
        may_enable=follow,
        emergency=emergency,
    )


class Brake:
    """One drive with a brake that opens in 50 ms and closes in 30 ms; the drive obeys at once."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.is_enabled = False
        self.brakes = HoldingBrakes(1, release_s=0.05, engage_s=0.03, clock_ns=lambda: self.now_ns)

    def step(self, asked: BusCommand) -> BrakePlan:
        plan = self.brakes.update_brakes(asked, [0] if self.is_enabled else [], ANGLE_RAD)
        self.is_enabled = 0 in plan.command.enabled_drives
        self.now_ns += PERIOD_NS
        return plan


def test_brake_opens_after_enabling_and_the_joint_holds_until_it_is_open() -> None:
    brake = Brake()
    plans = [brake.step(command(follow=True)) for _ in range(8)]
    assert [bool(plan.released) for plan in plans] == [False] + [True] * 7
    assert [plan.command.targets[0] for plan in plans] == [0.5] * 6 + [0.9] * 2


def test_torque_is_held_until_the_brake_has_closed() -> None:
    brake = Brake()
    for _ in range(8):
        brake.step(command(follow=True))
    plans = [
        brake.step(command(follow=False, mode=JointMode.PASSIVE, target=0.0)) for _ in range(5)
    ]
    assert not any(plan.released for plan in plans)
    assert [bool(plan.command.enabled_drives) for plan in plans] == [True] * 3 + [False] * 2
    assert plans[0].command.modes == [JointMode.POSITION]
    assert plans[0].command.targets[0] == 0.5
    assert plans[0].command.limits_nm[0] == 2.0


def test_emergency_stop_closes_the_brake_and_switches_torque_off_at_once() -> None:
    brake = Brake()
    for _ in range(8):
        brake.step(command(follow=True))
    plan = brake.step(command(follow=False, emergency=True))
    assert not plan.released and not plan.command.enabled_drives


def test_drive_that_was_never_enabled_holds_nothing_when_disarmed() -> None:
    assert not Brake().step(command(follow=False)).command.enabled_drives


@pytest.mark.parametrize(
    ("mode", "into", "kept_at", "away"),
    [
        (JointMode.POSITION, 0.9, 0.5, 0.1),
        (JointMode.VELOCITY, 1.0, 0.0, -1.0),
        (JointMode.TORQUE, 1.0, 0.0, -1.0),
    ],
)
def test_closed_switch_allows_motion_away_from_it_alone(
    mode: JointMode, into: float, kept_at: float, away: float
) -> None:
    switches = LimitSwitches(["joint_1"])
    switches.record_switches(0, lower=False, upper=True)
    for target, expected in ((into, kept_at), (away, away)):
        restricted = switches.restrict_command(
            command(follow=True, mode=mode, target=target), ANGLE_RAD
        )
        assert restricted.targets[0] == expected


def test_switch_is_a_fault_once_and_a_reset_allows_to_leave_it() -> None:
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
    assert len(switches.list_findings()) == 1, "it has closed again"


def test_safe_torque_off_has_a_fault_of_its_own_that_stops_the_robot() -> None:
    states = DriveStates(["joint_1"], PERIOD_NS, lambda: 0)
    states.drives[0].safe_torque_off = True
    states.drives[0].errors = "something else, which is its consequence"
    [finding] = states.list_findings()
    assert (finding.what, finding.joint, finding.affects_only_joint) == (
        "safe_torque_off",
        0,
        False,
    )
