"""Checks the targets of a joint that the operator jogs with keys."""

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.commissioning.jog import (
    KEY_HOLD_S,
    MAX_LEAD_RAD,
    JogRequest,
    JogTarget,
)
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.messages import raises_error

PERIOD_S = 0.01
JOINT = make_description().joints[0]


def hold_key(
    jog: JogTarget, key: str, duration_s: float, *, blocked_rad: float | None = None
) -> float:
    """Hold a key, which repeats in every third tick, and return the target of the joint.

    Args:
        jog: the targets.
        key: its name.
        duration_s: how long the key is held.
        blocked_rad: the angle at which the joint is blocked; None: it follows its target.
    """
    for tick in range(round(duration_s / PERIOD_S)):
        if tick % 3 == 0:
            jog.on_key(key)
        jog.advance(PERIOD_S, jog.target_rad if blocked_rad is None else blocked_rad)
    return jog.target_rad


def test_jog_moves_at_its_speed_only_while_key_repeats() -> None:
    jog = JogTarget(JogRequest(joint="joint_1", speed_rad_s=0.1), JOINT, 0.0)
    assert hold_key(jog, "up", 1.0) == pytest.approx(0.1)
    for _ in range(100):
        jog.advance(PERIOD_S, jog.target_rad)
    assert not jog.is_moving
    assert 0.1 < jog.target_rad <= 0.1 + 0.1 * KEY_HOLD_S
    assert hold_key(jog, "down", 0.5) < 0.07
    target_rad = jog.target_rad
    jog.on_key("x")
    assert jog.advance(PERIOD_S, target_rad) == target_rad


def test_jog_stays_within_travel_and_near_a_blocked_joint() -> None:
    jog = JogTarget(JogRequest(joint="joint_1"), JOINT, 0.0)
    assert hold_key(jog, "left", 10.0) == pytest.approx(-0.2)
    wide_jog = JogTarget(JogRequest(joint="joint_1", travel_rad=3.0), JOINT, 0.0)
    assert wide_jog.lower_rad == JOINT.angle_min_rad
    assert wide_jog.upper_rad == JOINT.angle_max_rad
    blocked_jog = JogTarget(JogRequest(joint="joint_1"), JOINT, 0.0)
    assert hold_key(blocked_jog, "up", 5.0, blocked_rad=0.0) == pytest.approx(MAX_LEAD_RAD)


def test_jog_speed_above_limit_is_refused() -> None:
    with raises_error(ConfigError, code="command/invalid-option", field="--speed"):
        JogRequest(joint="joint_1", speed_rad_s=2.0)
