"""The steering intents that follow from keys and joystick."""

import math

import pytest

from snakesim_operator.cli import main
from snakesim_operator.robot_commands.teleop.keyboard import _split_keys  # pyright: ignore[reportPrivateUsage]
from snakesim_operator.robot_commands.teleop.steering import (
    INTENT_VALIDITY_NS,
    MAX_HEADING_OFFSET_RAD,
    SteeringState,
)


def test_steering_speed_changes_by_steps_within_its_maximum() -> None:
    steering = SteeringState("anna", 0.12)
    for _ in range(5):
        steering.change_speed(1, 0.0)
    assert steering.make_intent(7).speed_m_s == 0.12
    for _ in range(9):
        steering.change_speed(-1, 0.0)
    intent = steering.make_intent(8)
    assert intent.speed_m_s == -0.12
    assert intent.go is True
    assert intent.timestamp_ns == 8
    assert intent.valid_for_ns == INTENT_VALIDITY_NS
    steering.stop(1.0)
    assert not steering.make_intent(9).go


def test_steering_direction_starts_at_body_and_stays_near_it() -> None:
    steering = SteeringState("anna", 0.3)
    assert steering.make_intent(0).heading_w_rad is None, "the mission chooses the direction"
    steering.rotate_heading(0.2, 3.1, 0.0)
    assert steering.make_intent(0).heading_w_rad == pytest.approx(3.3 - 2 * math.pi)
    for _ in range(50):
        steering.rotate_heading(0.2, 0.0, 0.0)
    assert steering.heading_w_rad == pytest.approx(MAX_HEADING_OFFSET_RAD)


def test_keys_of_one_read_are_split() -> None:
    assert _split_keys(b"\x1b[A\x1bOD q") == ["up", "left", " ", "q"]
    assert _split_keys(b"\x1b[Z\x1b\xff") == ["\x1b", "\xff"], "unknown keys do nothing"


def test_steering_without_terminal_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with open("/dev/null") as null_device:  # noqa: PTH123
        monkeypatch.setattr("sys.stdin", null_device)
        assert main(["teleop"]) == 2
    assert "stdin is no terminal" in capsys.readouterr().err
