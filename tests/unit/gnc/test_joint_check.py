"""How the joint check moves each joint: to both sides, back, and within its limits."""

import pytest

from snakesim_gnc.control.joint_check import JointCheck, JointCheckParameters
from snakesim_hal.controller import Observation
from snakesim_testing.hal.small_robots import make_description, make_joint_state

PERIOD_S = 0.01
SECONDS = 4.0  # for each joint
ROBOT = make_description()
LIMIT_RAD = ROBOT.joints[0].angle_max_rad


def targets(start_rad: float, seconds: float, dead: int | None = None) -> list[list[float]]:
    """Those of every tick; joints follow at once, but for a dead one."""
    check = JointCheck(ROBOT, JointCheckParameters())
    angles = [start_rad] * len(ROBOT.joints)
    made: list[list[float]] = []
    for tick in range(round(seconds / PERIOD_S)):
        observation = Observation(
            tick, tick * PERIOD_S, PERIOD_S, make_joint_state(ROBOT, angles), None, None
        )
        made.append(list(check.update(observation).setpoints.target))
        angles = [angle if joint == dead else made[-1][joint] for joint, angle in enumerate(angles)]
    return made


def test_every_joint_moves_alone_to_both_sides_and_back() -> None:
    made = targets(0.1, SECONDS * len(ROBOT.joints))
    for tick in made:
        assert sum(abs(target - 0.1) > 1e-9 for target in tick) <= 1
    for column in zip(*made, strict=True):
        assert max(column) > 0.1 + 0.055
        assert min(column) < 0.1 - 0.055
        assert column[-1] == 0.1


def test_a_joint_beside_its_limit_moves_away_from_it_only() -> None:
    start_rad = LIMIT_RAD - 0.03
    for column in zip(*targets(start_rad, SECONDS * len(ROBOT.joints)), strict=True):
        assert max(column) == start_rad
        assert min(column) < start_rad - 0.055


def test_small_motions_follow_large_ones_and_are_slow() -> None:
    column = [tick[0] - 0.1 for tick in targets(0.1, SECONDS)]
    last_large = max(tick for tick, offset in enumerate(column) if abs(offset) > 0.03)
    small = column[last_large + 40 :]
    assert max(small) == pytest.approx(0.006, abs=0.001) == -min(small)
    assert max(abs(small[i + 1] - small[i]) for i in range(len(small) - 1)) < 0.0007
    turns = [i for i in range(1, len(small) - 1) if small[i - 1] < small[i] > small[i + 1]]
    assert len(turns) == 2


def test_a_joint_that_does_not_follow_is_asked_once() -> None:
    column = [tick[1] for tick in targets(0.0, SECONDS * len(ROBOT.joints), dead=1)]
    assert max(column) > 0.14
    assert min(column) == 0.0
