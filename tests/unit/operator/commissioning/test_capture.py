"""Detects joints that a person turns by hand, from rest to rest."""

import itertools
from collections.abc import Iterator

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.capture import (
    MAX_REST_MOTION_RAD,
    HandTurn,
    HandTurnDetector,
)

JOINTS = 4
TURNED_JOINT = 1
RATE_HZ = 50.0


def make_samples(
    duration_s: float, start_rad: float, end_rad: float, shake_rad: float = 0.0
) -> Iterator[Floats]:
    """Yield the joint angles in each tick while a hand turns joint_2 at a constant speed.

    Args:
        duration_s: of the motion.
        start_rad: angle of joint_2 at the start.
        end_rad: angle of joint_2 at the end.
        shake_rad: amplitude by which the hand shakes.
    """
    tick_count = round(duration_s * RATE_HZ)
    for tick in range(tick_count):
        angle_rad = np.zeros(JOINTS)
        turned_rad = (end_rad - start_rad) * tick / tick_count
        angle_rad[TURNED_JOINT] = start_rad + turned_rad + shake_rad * (-1) ** tick
        yield angle_rad


def detect_turns(*motions: Iterator[Floats]) -> list[HandTurn]:
    """Return every turn in these motions; a new detector starts after each turn."""
    turns: list[HandTurn] = []
    detector = HandTurnDetector()
    for tick, angle_rad in enumerate(itertools.chain(*motions)):
        turn = detector.add_sample(tick / RATE_HZ, angle_rad)
        if turn is not None:
            turns.append(turn)
            detector = HandTurnDetector()
    return turns


def test_capture_slow_turn_is_one_turn_with_its_size() -> None:
    (turn,) = detect_turns(
        make_samples(1, 0, 0), make_samples(3, 0, 0.6), make_samples(2, 0.6, 0.6)
    )
    assert turn.joint_index == TURNED_JOINT
    assert turn.is_single_joint
    assert abs(turn.angle_rad - 0.6) < 1e-6


def test_capture_turn_with_short_pause_is_one_turn() -> None:
    (turn,) = detect_turns(
        make_samples(1, 0, 0),
        make_samples(1, 0, 0.2),
        make_samples(0.3, 0.2, 0.2),
        make_samples(1, 0.2, 0.5),
        make_samples(2, 0.5, 0.5),
    )
    assert abs(turn.angle_rad - 0.5) < 1e-6


def test_capture_turn_starts_at_rest_and_ends_within_rest_limit() -> None:
    assert detect_turns(make_samples(1, 0, 0.4), make_samples(2, 0.4, 0.4)) == [], (
        "it moves from the first sample"
    )
    small_shake = detect_turns(
        make_samples(1, 0, 0),
        make_samples(1, 0, 0.4),
        make_samples(1, 0.4, 0.4, shake_rad=MAX_REST_MOTION_RAD / 3),
    )
    assert len(small_shake) == 1
    large_shake = detect_turns(
        make_samples(1, 0, 0),
        make_samples(1, 0, 0.4),
        make_samples(1, 0.4, 0.4, shake_rad=MAX_REST_MOTION_RAD),
    )
    assert large_shake == []


def test_capture_joint_that_is_turned_back_is_no_turn() -> None:
    assert (
        detect_turns(
            make_samples(1, 0, 0),
            make_samples(1, 0, 0.3),
            make_samples(1, 0.3, 0),
            make_samples(1, 0, 0),
        )
        == []
    )
