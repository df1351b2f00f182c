"""What the start check finds in measurements that are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.checked import PROPERTIES
from snakesim_hal.model.robot_file.joints import JointDrive, JointMotor
from snakesim_operator.features.commissioning.joint_check.check import format_report
from snakesim_operator.features.commissioning.joint_check.gear_play import GearPlay
from snakesim_operator.features.commissioning.joint_check.gear_rules import (
    IS_LOOSE,
    judge_gear_by_links,
    judge_gear_by_torque,
)
from snakesim_operator.features.commissioning.joint_check.joint_verdict import (
    MATCHES_FILE,
    JointVerdict,
)
from snakesim_operator.features.commissioning.joint_check.judge import judge_joints
from snakesim_operator.features.commissioning.joint_check.measurements import (
    CheckMeasurements,
    remove_clamped_targets,
)

PERIOD_S = 0.01
WAY_RAD = 0.06
REST, LEG = 20, 40  # ticks
MOTION = 2 * (LEG + REST)
JOINTS = 3  # yaw, pitch, yaw
TICKS = REST + JOINTS * MOTION
MOTOR = JointMotor(
    stiffness_nm_per_rad=60.0,
    damping_nm_s_per_rad=1.5,
    velocity_gain_nm_s_per_rad=1.5,
    response_time_s=0.01,
    armature_kg_m2=0.005,
)
SWING = np.concatenate((WAY_RAD * np.sin(np.linspace(0, np.pi, LEG)), np.zeros(REST)))
TO_AND_FRO = np.concatenate((SWING, -SWING))


def measurements(
    backlash_rad: float = 0.0, gear: float = 1.0, pitched_rad: float = 0.0
) -> CheckMeasurements:
    """Joints that move one after the other to both sides, on IMUs at every tick; the tail link stays where it is.

    backlash_rad, gear: of joint_1, in truth; pitched_rad: of joint_2 in truth, while its encoder says 0.
    """
    angle = np.zeros((TICKS, JOINTS))
    for joint in range(JOINTS):
        begin = REST + joint * MOTION
        angle[begin : begin + MOTION, joint] = TO_AND_FRO
    by_links = angle.copy()
    by_links[:, 0] = behind_backlash(angle[:, 0], backlash_rad) / gear
    rate: Floats = np.diff(by_links, axis=0, append=0.0) / PERIOD_S
    link_rates = np.zeros((TICKS, JOINTS + 1, 3))
    link_rates[:, 1:, 2] += rate[:, :1]
    link_rates[:, 2:, 1] += rate[:, 1:2]
    link_rates[:, 3:, 2] += rate[:, 2:3]
    force = np.zeros((TICKS, JOINTS + 1, 3))
    force[:, :, 2] = 9.81
    force[:, 2:] = 9.81 * np.array((-np.sin(pitched_rad), 0.0, np.cos(pitched_rad)))
    velocity: Floats = np.diff(angle, axis=0, append=0.0) / PERIOD_S
    return CheckMeasurements(
        period_s=PERIOD_S,
        joint_names=["joint_1", "joint_2", "joint_3"],
        axes=["yaw", "pitch", "yaw"],
        drives=[JointDrive(), JointDrive(sign=-1, zero_rad=0.3), JointDrive()],
        motors=[MOTOR] * JOINTS,
        angle_rad=angle,
        velocity_rad_s=velocity,
        torque_nm=0.5 * np.sign(velocity),
        target_rad=angle,
        link_rate_rad_s=link_rates,
        link_force_m_s2=force,
        base_rotation_rad=np.full((TICKS, 3), np.nan),
    )


def behind_backlash(drive_rad: Floats, backlash_rad: float) -> Floats:
    """The link that a drive moves once it has crossed the backlash."""
    link_rad = np.zeros_like(drive_rad)
    now_rad = 0.0
    for tick, angle_rad in enumerate(drive_rad):
        now_rad = min(max(now_rad, angle_rad - backlash_rad / 2), angle_rad + backlash_rad / 2)
        link_rad[tick] = now_rad
    return link_rad


def verdicts(run: CheckMeasurements) -> list[str]:
    return [row.summary for row in judge_joints(run, was_laid_straight=True)]


def states(row: JointVerdict) -> dict[str, str]:
    return {
        name: row.findings[name].state
        for name in PROPERTIES
        if row.findings[name].state != "confirmed"
    }


def without_imus(run: CheckMeasurements, *links: int) -> CheckMeasurements:
    rates = run.link_rate_rad_s.copy()
    forces = run.link_force_m_s2.copy()
    rates[:, links] = np.nan
    forces[:, links] = np.nan
    return replace(run, link_rate_rad_s=rates, link_force_m_s2=forces)


def test_a_sound_robot_is_as_its_file_says() -> None:
    assert verdicts(measurements()) == [MATCHES_FILE] * JOINTS


def test_judge_without_imus_confirms_only_encoders_and_detects_wrong_zero() -> None:
    run = without_imus(measurements(), *range(JOINTS + 1))
    run = replace(run, angle_rad=run.angle_rad + np.array((0.15, 0.0, 0.0)))
    rows = [
        row.confirm_by_hand(["order", "sign"]) for row in judge_joints(run, was_laid_straight=True)
    ]
    assert states(rows[0]) == {"gear": "unknown", "zero": "wrong"}
    assert rows[0].summary == "its zero is off by +0.150 rad: zero_rad = 0.150"
    assert states(rows[1]) == {"gear": "unknown"}
    assert not rows[1].all_confirmed
    lines = format_report(rows)
    assert "0 of 3 joints match the robot file; 1 wrong; 2 unknown" in lines[JOINTS]
    assert lines[JOINTS + 1].startswith("unknown: gear of every joint: ")
    assert "`snakesim robot calibrate gear`" in lines[JOINTS + 1]


def test_judge_zeros_are_unknown_until_straight_or_measured_by_gravity() -> None:
    first, second, third = judge_joints(measurements())
    assert states(first) == states(third) == {"zero": "unknown"}
    assert "--straight" in first.findings["zero"].reason
    assert second.all_confirmed  # a pitch joint


@pytest.mark.parametrize("allowed", [False, True])
def test_backlash_is_named_and_is_no_gear(allowed: bool) -> None:
    run = measurements(backlash_rad=0.035)
    rows = judge_joints(run, was_laid_straight=True, allowed_backlash_rad=0.04 if allowed else 0.01)
    assert [row.all_confirmed for row in rows[1:]] == [True, True]
    verdict = rows[0].summary
    if allowed:
        assert "backlash" not in verdict
    else:
        assert verdict.startswith("backlash of 0.03")
        assert "gear =" not in verdict
        assert "--allow-backlash" in verdict


def test_a_gear_of_another_ratio_is_no_backlash() -> None:
    assert verdicts(measurements(gear=1.5)) == [
        "turns 0.67 as far as its drive measures: gear = 1.5",
        MATCHES_FILE,
        MATCHES_FILE,
    ]


def test_joint_whose_links_never_turn_slips_or_has_wide_backlash() -> None:
    """Only a torque that passes through the gear tells a coupling that slips from backlash."""
    summary = verdicts(measurements(backlash_rad=4 * WAY_RAD))[0]
    assert summary.startswith(IS_LOOSE)
    assert "the coupling slips, or the backlash" in summary
    assert "its coupling slips" not in summary


@pytest.mark.parametrize("is_load_passed_on", [True, False])
def test_only_a_load_that_is_passed_on_names_the_coupling(is_load_passed_on: bool) -> None:
    finding = judge_gear_by_links(
        0.02, None, None, JointDrive(), 0.01, is_load_passed_on=is_load_passed_on
    )
    assert finding.state == "wrong"
    assert finding.reason.startswith("its coupling slips" if is_load_passed_on else IS_LOOSE)


def test_judge_gravity_reveals_zero_of_a_bent_pitch_joint() -> None:
    run = measurements(pitched_rad=0.2)  # the encoder says 0
    assert verdicts(run) == [
        MATCHES_FILE,
        "its zero is off by -0.200 rad: zero_rad = 0.500",
        MATCHES_FILE,
    ]
    assert (
        verdicts(replace(run, angle_rad=run.angle_rad + np.array((0.0, 0.2, 0.0))))
        == [MATCHES_FILE] * JOINTS
    )


def test_judge_torque_against_its_motion_has_wrong_sign() -> None:
    run = measurements()
    wrong = replace(run, torque_nm=run.torque_nm * np.array((-1.0, 1.0, 1.0)))
    assert verdicts(wrong)[0].startswith("its torque has the wrong sign")
    assert verdicts(wrong)[1:] == [MATCHES_FILE, MATCHES_FILE]


@pytest.mark.parametrize("link", [0, 1])
def test_a_joint_beside_a_link_without_an_imu_is_unknown(link: int) -> None:
    row = judge_joints(without_imus(measurements(), link), was_laid_straight=True)[0]
    assert row.turned is None
    assert not row.all_confirmed
    assert states(row) == {"sign": "unknown", "gear": "unknown"}


def with_dead_zone(angle_rad: Floats, dead_zone_rad: float) -> Floats:
    """The angles of an encoder that sticks, and then jumps to the shaft."""
    measured_rad = np.zeros_like(angle_rad)
    now_rad = 0.0
    for tick, shaft_rad in enumerate(angle_rad):
        if abs(shaft_rad - now_rad) >= dead_zone_rad:
            now_rad = shaft_rad
        measured_rad[tick] = now_rad
    return measured_rad


@pytest.mark.parametrize("has_imus", [True, False])
def test_encoder_with_dead_zone_is_named_and_its_gear_is_not_judged(has_imus: bool) -> None:
    run = measurements()
    angle_rad = run.angle_rad.copy()
    angle_rad[:, 1] = with_dead_zone(run.target_rad[:, 1], 0.02)
    run = replace(run, angle_rad=angle_rad)
    if not has_imus:
        run = without_imus(run, *range(JOINTS + 1))
    rows = judge_joints(run, was_laid_straight=True)
    assert rows[1].summary.startswith("its encoder has a dead zone: its angle sticks")
    assert "jumps by 0.02" in rows[1].summary
    assert states(rows[1]) == {
        "drive": "wrong",
        "order": "unknown",
        "sign": "unknown",
        "gear": "unknown",
    }
    assert [rows[joint].findings["drive"].state for joint in (0, 2)] == ["confirmed"] * 2


@pytest.mark.parametrize("ticks", [(3,), (3, 5), (3, 5, 7, 9)])
def test_motion_of_a_single_tick_does_not_end_the_judgment(ticks: tuple[int, ...]) -> None:
    """A dead zone may jump as far as a small motion goes, so that the target turns back at once."""
    run = measurements()
    target_rad = run.target_rad.copy()
    for tick in ticks:
        target_rad[REST + MOTION - tick, 0] = 0.001
    rows = judge_joints(replace(run, target_rad=target_rad), was_laid_straight=True)
    assert rows[0].findings["drive"].state == "confirmed"


def test_few_late_samples_are_no_dead_zone() -> None:
    run = measurements()
    angle_rad = run.angle_rad.copy()
    for tick in (REST + 5, REST + 30):
        angle_rad[tick : tick + 4, 0] = angle_rad[tick, 0]
    rows = judge_joints(replace(run, angle_rad=angle_rad), was_laid_straight=True)
    assert rows[0].findings["drive"].state == "confirmed"


def test_drawn_shapes_do_not_confirm_a_gear_whose_backlash_is_unknown() -> None:
    run = without_imus(measurements(), *range(JOINTS + 1))
    row = judge_joints(run, was_laid_straight=True)[0]
    assert "backlash and ratio unknown, as it made no small motion" in row.findings["gear"].reason
    seen = row.confirm_by_shape(["order", "sign", "gear", "zero"], was_shaken=False)
    assert states(seen) == {"gear": "unknown"}
    assert seen.confirm_by_hand(["gear"]).all_confirmed
    assert row.confirm_by_shape(["order", "sign", "gear", "zero"], was_shaken=True).all_confirmed


@pytest.mark.parametrize(
    ("play", "state", "excludes_backlash"),
    [
        (GearPlay("tight", max_backlash_rad=0.006), "unknown", True),
        (GearPlay("tight", max_backlash_rad=0.012), "unknown", False),
        (GearPlay("backlash", min_backlash_rad=0.012), "wrong", False),
        (GearPlay("backlash", min_backlash_rad=0.008), "unknown", False),
        (GearPlay("unknown", "the floor hardly loads the joints"), "unknown", False),
    ],
)
def test_only_a_computed_bound_within_the_allowed_backlash_lets_shapes_confirm_a_gear(
    play: GearPlay, state: str, excludes_backlash: bool
) -> None:
    finding = judge_gear_by_torque(play, allowed_backlash_rad=0.01)
    assert finding.state == state
    assert finding.excludes_backlash == excludes_backlash
    verdict = JointVerdict("joint_1", {"gear": finding})
    seen = verdict.confirm_by_shape(["gear"], was_shaken=False).findings["gear"]
    assert (seen.state == "confirmed") == excludes_backlash


def test_shaking_does_not_confirm_a_gear_that_was_found_wrong() -> None:
    finding = judge_gear_by_torque(
        GearPlay("backlash", min_backlash_rad=0.012), allowed_backlash_rad=0.01
    )
    verdict = JointVerdict("joint_1", {"gear": finding})
    assert verdict.confirm_by_shape(["gear"], was_shaken=True).findings["gear"].state == "wrong"


def test_judge_two_imus_cannot_separate_joints_of_equal_effect() -> None:
    run = replace(measurements(), axes=["yaw", "yaw", "yaw"])
    row = judge_joints(without_imus(run, 2, 3), was_laid_straight=True)[0]
    assert states(row) == {"order": "unknown"}
    assert "joint_2, joint_3" in row.findings["order"].reason


def test_judge_joint_without_its_motion_is_not_confirmed() -> None:
    run = measurements()
    ended = replace(run, target_rad=run.target_rad * np.array((1.0, 1.0, 0.0)))
    unmoved = judge_joints(ended, was_laid_straight=True)[2]
    assert states(unmoved) == dict.fromkeys(("drive", "order", "sign", "gear"), "unknown")
    dead = judge_joints(
        replace(run, angle_rad=run.angle_rad * 0, velocity_rad_s=run.velocity_rad_s * 0),
        was_laid_straight=True,
    )[0]
    assert dead.summary.startswith("did not move")
    assert not dead.confirm_by_hand(["order", "sign", "gear"]).all_confirmed


def test_judge_dead_joint_swung_by_others_affects_no_verdict() -> None:
    run = measurements()
    angle_rad = run.angle_rad.copy()
    angle_rad[:, 2] = np.linspace(0.0, 0.6, TICKS)
    target_rad = run.target_rad.copy()
    target_rad[:, 2] = np.maximum(angle_rad[:, 2] - 0.35, 0.0)
    target_rad = remove_clamped_targets(target_rad, angle_rad, max_step_rad=0.35)
    assert target_rad[:, 2] == pytest.approx(0.0)
    swung = replace(
        run, angle_rad=angle_rad, target_rad=target_rad, link_rate_rad_s=run.link_rate_rad_s
    )
    rows = judge_joints(swung, was_laid_straight=True)
    assert [row.findings["zero"].state for row in rows] == ["confirmed"] * JOINTS
    assert rows[0].all_confirmed
    assert not rows[2].all_confirmed


def test_motion_capture_of_the_base_stands_for_its_imu() -> None:
    run = without_imus(measurements(), 0)
    # The tail link turned, and the body stayed.
    run.link_rate_rad_s[:, 1:, 2] -= run.velocity_rad_s[:, :1]
    turn = np.zeros((TICKS, 3))
    turn[:, 2] = -run.angle_rad[:, 0]
    assert verdicts(replace(run, base_rotation_rad=turn))[0] == MATCHES_FILE
    assert "the other way" in verdicts(replace(run, base_rotation_rad=-turn))[0]
