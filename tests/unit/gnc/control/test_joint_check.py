"""Tests how the joint check moves each joint: to both sides, back, and within its limits."""

import itertools

import pytest

from snakesim_gnc.control.joint_check import JointCheck, JointCheckParameters
from snakesim_hal.controller import Observation
from snakesim_testing.hal.small_robots import make_description, make_joint_state

PERIOD_S = 0.01
SECONDS_PER_JOINT = 4.0
LARGE_MOTION_RAD = 0.055  # the large motions to each side are at least this large
ROBOT = make_description()
LIMIT_RAD = ROBOT.joints[0].angle_max_rad


def run_joint_check(
    start_rad: float, seconds: float, blocked_joint: int | None = None
) -> list[list[float]]:
    """Return the targets of every tick and joint. All joints but a blocked one follow at once."""
    check = JointCheck(ROBOT, JointCheckParameters())
    angles_rad = [start_rad] * len(ROBOT.joints)
    targets_rad: list[list[float]] = []
    for tick in range(round(seconds / PERIOD_S)):
        joints = make_joint_state(ROBOT, angles_rad)
        observation = Observation(tick, tick * PERIOD_S, PERIOD_S, joints, None, None)
        targets_rad.append(list(check.update(observation).setpoints.target))
        angles_rad = [
            angle_rad if joint == blocked_joint else targets_rad[-1][joint]
            for joint, angle_rad in enumerate(angles_rad)
        ]
    return targets_rad


def test_joint_check_moves_each_joint_alone_to_both_sides() -> None:
    start_rad = 0.1
    targets_rad = run_joint_check(start_rad, SECONDS_PER_JOINT * len(ROBOT.joints))
    for targets_of_tick in targets_rad:
        assert sum(abs(target_rad - start_rad) > 1e-9 for target_rad in targets_of_tick) <= 1
    for targets_of_joint in zip(*targets_rad, strict=True):
        assert max(targets_of_joint) > start_rad + LARGE_MOTION_RAD
        assert min(targets_of_joint) < start_rad - LARGE_MOTION_RAD
        assert targets_of_joint[-1] == start_rad


def test_joint_check_beside_limit_moves_only_away_from_it() -> None:
    start_rad = LIMIT_RAD - 0.03
    targets_rad = run_joint_check(start_rad, SECONDS_PER_JOINT * len(ROBOT.joints))
    for targets_of_joint in zip(*targets_rad, strict=True):
        assert max(targets_of_joint) == start_rad
        assert min(targets_of_joint) < start_rad - LARGE_MOTION_RAD


def test_joint_check_slow_small_motions_follow_the_large_ones() -> None:
    start_rad = 0.1
    targets_rad = run_joint_check(start_rad, SECONDS_PER_JOINT)
    offsets_rad = [targets_of_tick[0] - start_rad for targets_of_tick in targets_rad]
    last_large_tick = max(tick for tick, offset in enumerate(offsets_rad) if abs(offset) > 0.03)
    small_rad = offsets_rad[last_large_tick + 40 :]
    assert max(small_rad) == pytest.approx(0.006, abs=0.001) == -min(small_rad)
    assert max(abs(after - before) for before, after in itertools.pairwise(small_rad)) < 0.0007
    peaks = [
        i
        for i in range(1, len(small_rad) - 1)
        if small_rad[i - 1] < small_rad[i] > small_rad[i + 1]
    ]
    assert len(peaks) == 2


def test_joint_check_moves_a_blocked_joint_to_one_side_only() -> None:
    targets_rad = run_joint_check(0.0, SECONDS_PER_JOINT * len(ROBOT.joints), blocked_joint=1)
    targets_of_joint = [targets_of_tick[1] for targets_of_tick in targets_rad]
    # The check moves the target to one side, and does not try the other.
    assert max(targets_of_joint) > 0.14
    assert min(targets_of_joint) == 0.0
