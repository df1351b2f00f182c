"""Turns by hand, from rest to rest."""

from collections.abc import Iterator

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.capture import (
    MAX_REST_MOTION_RAD,
    HandTurn,
    HandTurnDetector,
)

JOINTS, RATE_HZ = 4, 50.0


def samples(
    seconds: float, from_rad: float, to_rad: float, shake_rad: float = 0.0
) -> Iterator[Floats]:
    """joint_2 while a hand turns it steadily, and shakes a little."""
    ticks = round(seconds * RATE_HZ)
    for tick in range(ticks):
        angle_rad = np.zeros(JOINTS)
        angle_rad[1] = from_rad + (to_rad - from_rad) * tick / ticks + shake_rad * (-1) ** tick
        yield angle_rad


def turns(*parts: Iterator[Floats]) -> list[HandTurn]:
    """Every turn that is found, as joint after joint is asked for."""
    found: list[HandTurn] = []
    watch = HandTurnDetector()
    tick = 0
    for part in parts:
        for angle_rad in part:
            turn = watch.add_sample(tick / RATE_HZ, angle_rad)
            tick += 1
            if turn is not None:
                found.append(turn)
                watch = HandTurnDetector()  # the next joint
    return found


def test_capture_slow_turn_is_one_turn_with_its_size() -> None:
    (turn,) = turns(samples(1, 0, 0), samples(3, 0, 0.6), samples(2, 0.6, 0.6))
    assert turn.joint_index == 1
    assert turn.is_single_joint
    assert abs(turn.angle_rad - 0.6) < 1e-6


def test_a_pause_within_a_turn_is_no_end_of_it() -> None:
    (turn,) = turns(
        samples(1, 0, 0),
        samples(1, 0, 0.2),
        samples(0.3, 0.2, 0.2),
        samples(1, 0.2, 0.5),
        samples(2, 0.5, 0.5),
    )
    assert abs(turn.angle_rad - 0.5) < 1e-6


def test_a_turn_begins_at_rest_and_a_shaking_hand_rests() -> None:
    # It moved already when its joint was asked for.
    assert turns(samples(1, 0, 0.4), samples(2, 0.4, 0.4)) == []
    assert (
        len(
            turns(
                samples(1, 0, 0),
                samples(1, 0, 0.4),
                samples(1, 0.4, 0.4, shake_rad=MAX_REST_MOTION_RAD / 3),
            )
        )
        == 1
    )
    assert (
        turns(
            samples(1, 0, 0),
            samples(1, 0, 0.4),
            samples(1, 0.4, 0.4, shake_rad=MAX_REST_MOTION_RAD),
        )
        == []
    )


def test_a_joint_that_is_turned_back_was_not_turned() -> None:
    assert turns(samples(1, 0, 0), samples(1, 0, 0.3), samples(1, 0.3, 0), samples(1, 0, 0)) == []
