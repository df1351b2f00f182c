"""What the start check says of measurements that emulated modules cannot give."""

from dataclasses import replace

import numpy as np
import pytest

from snakesim_hal.arrays import Floats
from snakesim_hal.model.joints import Drive
from snakesim_operator.commissioning.judge import Measured, judged

TICKS, WAY = 200, 0.04
AS_TOLD = "as the robot file says"


def two_joints(pitched_rad: float = 0.0) -> Measured:
    """A yaw joint and a pitch joint that move one after the other, 100 ticks each; the tail link stays where it is."""
    angle = np.zeros((TICKS, 2))
    stroke = WAY * np.sin(np.linspace(0, np.pi, 60))
    angle[20:80, 0], angle[120:180, 1] = stroke, stroke
    speed: Floats = np.diff(angle, axis=0, append=0.0) / 0.01
    rates = np.zeros((TICKS, 3, 3))
    rates[:, 1:, 2] = speed[:, :1]
    rates[:, 2, 1] = speed[:, 1]
    force = np.zeros((TICKS, 3, 3))
    force[:, :, 2] = 9.81
    force[:, 2] = 9.81 * np.array((-np.sin(pitched_rad), 0.0, np.cos(pitched_rad)))
    return Measured(
        names=["joint_1", "joint_2"],
        axes=["yaw", "pitch"],
        drives=[Drive(), Drive(sign=-1, zero_rad=0.3)],
        angle_rad=angle,
        velocity_rad_s=speed,
        torque_nm=0.5 * np.sign(speed),
        target_rad=angle,
        link_rate_rad_s=rates,
        link_force_m_s2=force,
        base_turn_rad=np.full((TICKS, 3), np.nan),
    )


def verdicts(run: Measured) -> list[str]:
    return [row.verdict for row in judged(run)]


def test_a_sound_robot_is_as_its_file_says() -> None:
    assert verdicts(two_joints()) == [AS_TOLD, AS_TOLD]


def test_gravity_tells_the_zero_of_a_pitch_joint_that_is_not_straight() -> None:
    run = two_joints(pitched_rad=0.2)  # the encoder says 0
    first, second = verdicts(run)
    assert first == AS_TOLD
    assert second == "its zero is off by -0.200 rad: zero_rad = 0.500"
    assert verdicts(replace(run, angle_rad=run.angle_rad + np.array((0.0, 0.2)))) == [AS_TOLD, AS_TOLD]


def test_a_torque_against_the_motion_that_it_drives_has_the_wrong_sign() -> None:
    run = two_joints()
    wrong = replace(run, torque_nm=run.torque_nm * np.array((-1.0, 1.0)))
    assert verdicts(wrong)[0].startswith("its torque has the wrong sign")
    assert verdicts(wrong)[1] == AS_TOLD


@pytest.mark.parametrize("link", [0, 1])
def test_a_joint_beside_a_link_without_an_imu_is_unknown(link: int) -> None:
    run = two_joints()
    run.link_rate_rad_s[:, link] = np.nan
    rows = judged(run)
    assert rows[0].turned is None and not rows[0].as_told and rows[0].verdict.startswith("unknown")


def test_motion_capture_of_the_base_stands_for_its_imu() -> None:
    run = two_joints()
    run.link_rate_rad_s[:, 0] = np.nan
    run.link_rate_rad_s[:, 1:, 2] = 0.0  # the tail link turned, and the body stayed
    turn = np.zeros((TICKS, 3))
    turn[:, 2] = -run.angle_rad[:, 0]
    assert verdicts(replace(run, base_turn_rad=turn)) == [AS_TOLD, AS_TOLD]
    assert "the other way" in verdicts(replace(run, base_turn_rad=-turn))[0]
