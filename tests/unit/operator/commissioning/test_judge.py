"""Checks the verdicts of the start check on measurements with known faults."""

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
    LinkMotions,
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
SWING_RAD = 0.06  # amplitude of the check motion
SMALL_SWING_RAD = 0.006
REST_TICKS = 20
SWING_TICKS = 40
SMALL_SWING_TICKS = 60
JOINTS = 3  # yaw, pitch, yaw
GRAVITY_M_S2 = 9.81
MOTOR = JointMotor(
    stiffness_nm_per_rad=60.0,
    damping_nm_s_per_rad=1.5,
    velocity_gain_nm_s_per_rad=1.5,
    response_time_s=0.01,
    armature_kg_m2=0.005,
)
SWING_AND_REST_RAD = np.concatenate(
    (SWING_RAD * np.sin(np.linspace(0, np.pi, SWING_TICKS)), np.zeros(REST_TICKS))
)
SMALL_SWING_AND_REST_RAD = np.concatenate(
    (SMALL_SWING_RAD * np.sin(np.linspace(0, np.pi, SMALL_SWING_TICKS)), np.zeros(REST_TICKS))
)
# Of one joint.
LARGE_MOTION_RAD = np.concatenate((SWING_AND_REST_RAD, -SWING_AND_REST_RAD))
SMALL_CYCLE_RAD = np.concatenate((SMALL_SWING_AND_REST_RAD, -SMALL_SWING_AND_REST_RAD))
BOTH_MOTIONS_RAD = np.concatenate((LARGE_MOTION_RAD, SMALL_CYCLE_RAD, SMALL_CYCLE_RAD))


def make_measurements(
    backlash_rad: float = 0.0,
    gear: float = 1.0,
    pitch_rad: float = 0.0,
    held_slip_rad: float = 0.0,
    *,
    has_small_motion: bool = False,
) -> CheckMeasurements:
    """Make the measurements of joints that swing one after the other to both sides.

    Every link has an IMU with a sample in every tick, and the tail link does not move.

    Args:
        backlash_rad: true backlash of joint_1.
        gear: true gear ratio of joint_1.
        pitch_rad: true angle of joint_2 when its encoder measures 0.
        held_slip_rad: angle by which the coupling of joint_1 slips to either side while joint_3 moves.
        has_small_motion: whether each joint makes the small motion after the large one.
    """
    motion_rad = BOTH_MOTIONS_RAD if has_small_motion else LARGE_MOTION_RAD
    tick_count = REST_TICKS + JOINTS * len(motion_rad)
    angle = np.zeros((tick_count, JOINTS))
    for joint in range(JOINTS):
        start_tick = REST_TICKS + joint * len(motion_rad)
        angle[start_tick : start_tick + len(motion_rad), joint] = motion_rad
    true_angle = angle.copy()
    true_angle[:, 0] = add_backlash(angle[:, 0], backlash_rad) / gear
    true_angle[:, 0] += held_slip_rad / SWING_RAD * angle[:, 2]
    true_rate: Floats = np.diff(true_angle, axis=0, append=0.0) / PERIOD_S
    # Each joint turns all links after it, about the z axis (yaw) or the y axis (pitch).
    link_rates = np.zeros((tick_count, JOINTS + 1, 3))
    link_rates[:, 1:, 2] += true_rate[:, :1]
    link_rates[:, 2:, 1] += true_rate[:, 1:2]
    link_rates[:, 3:, 2] += true_rate[:, 2:3]
    specific_force = np.zeros((tick_count, JOINTS + 1, 3))
    specific_force[:, :, 2] = GRAVITY_M_S2
    up_in_pitched_link = np.array((-np.sin(pitch_rad), 0.0, np.cos(pitch_rad)))
    specific_force[:, 2:] = GRAVITY_M_S2 * up_in_pitched_link
    velocity: Floats = np.diff(angle, axis=0, append=0.0) / PERIOD_S
    return CheckMeasurements(
        period_s=PERIOD_S,
        joint_names=["joint_1", "joint_2", "joint_3"],
        axes=["yaw", "pitch", "yaw"],
        drives=[JointDrive(), JointDrive(sign=-1, zero_rad=0.3), JointDrive()],
        motors=[MOTOR] * JOINTS,
        link_lengths_m=[0.1] * (JOINTS + 1),
        link_masses_kg=[0.3] * (JOINTS + 1),
        angle_rad=angle,
        velocity_rad_s=velocity,
        torque_nm=0.5 * np.sign(velocity),
        target_rad=angle,
        link_rate_rad_s=link_rates,
        link_force_m_s2=specific_force,
        base_rotation_rad=np.full((tick_count, 3), np.nan),
    )


def add_backlash(drive_rad: Floats, backlash_rad: float) -> Floats:
    """Return the angles of a link that its drive moves only after it has crossed the backlash."""
    link_rad = np.zeros_like(drive_rad)
    link_angle_rad = 0.0
    for tick, drive_angle_rad in enumerate(drive_rad):
        lower_rad = drive_angle_rad - backlash_rad / 2
        upper_rad = drive_angle_rad + backlash_rad / 2
        link_angle_rad = min(max(link_angle_rad, lower_rad), upper_rad)
        link_rad[tick] = link_angle_rad
    return link_rad


def summarize_verdicts(measured: CheckMeasurements) -> list[str]:
    """Judge a robot that was laid straight, and return the summary of each joint."""
    return [verdict.summary for verdict in judge_joints(measured, was_laid_straight=True)]


def list_unconfirmed(verdict: JointVerdict) -> dict[str, str]:
    """Return the state of each property of a joint that is not confirmed."""
    return {
        name: verdict.findings[name].state
        for name in PROPERTIES
        if verdict.findings[name].state != "confirmed"
    }


def remove_imus(measured: CheckMeasurements, *links: int) -> CheckMeasurements:
    """Return the measurements without the IMUs of these links."""
    rates = measured.link_rate_rad_s.copy()
    forces = measured.link_force_m_s2.copy()
    rates[:, links] = np.nan
    forces[:, links] = np.nan
    return replace(measured, link_rate_rad_s=rates, link_force_m_s2=forces)


def test_judge_robot_without_faults_matches_its_file() -> None:
    assert summarize_verdicts(make_measurements()) == [MATCHES_FILE] * JOINTS


def test_judge_without_imus_confirms_only_encoders_and_detects_wrong_zero() -> None:
    measured = remove_imus(make_measurements(), *range(JOINTS + 1))
    measured = replace(measured, angle_rad=measured.angle_rad + np.array((0.15, 0.0, 0.0)))
    verdicts = [
        verdict.confirm_by_hand(["order", "sign"])
        for verdict in judge_joints(measured, was_laid_straight=True)
    ]
    assert list_unconfirmed(verdicts[0]) == {"gear": "unknown", "zero": "wrong"}
    assert verdicts[0].summary == "its zero is off by +0.150 rad: zero_rad = 0.150"
    assert list_unconfirmed(verdicts[1]) == {"gear": "unknown"}
    assert not verdicts[1].all_confirmed
    lines = format_report(verdicts)
    assert "0 of 3 joints match the robot file; 1 wrong; 2 unknown" in lines[JOINTS]
    assert lines[JOINTS + 1].startswith("unknown: gear of every joint: ")
    assert "`snakesim robot calibrate gear`" in lines[JOINTS + 1]


def test_judge_zeros_are_unknown_until_straight_or_measured_by_gravity() -> None:
    first, second, third = judge_joints(make_measurements())
    assert list_unconfirmed(first) == list_unconfirmed(third) == {"zero": "unknown"}
    assert "--straight" in first.findings["zero"].reason
    assert second.all_confirmed  # a pitch joint


@pytest.mark.parametrize("allowed", [False, True])
def test_judge_backlash_is_named_and_is_no_gear_ratio(allowed: bool) -> None:
    measured = make_measurements(backlash_rad=0.035, has_small_motion=True)
    verdicts = judge_joints(
        measured, was_laid_straight=True, allowed_backlash_rad=0.04 if allowed else 0.01
    )
    assert [verdict.all_confirmed for verdict in verdicts[1:]] == [True, True]
    summary = verdicts[0].summary
    if allowed:
        assert "backlash" not in summary
    else:
        assert summary.startswith("backlash of 0.03")
        assert "gear =" not in summary
        assert "--allow-backlash" in summary


def test_judge_wrong_gear_ratio_is_no_backlash() -> None:
    assert summarize_verdicts(make_measurements(gear=1.5)) == [
        "turns 0.67 as far as its drive measures: gear = 1.5",
        MATCHES_FILE,
        MATCHES_FILE,
    ]


def test_judge_joint_whose_links_never_turn_is_loose() -> None:
    """Only a torque through the gear distinguishes a slipping coupling from wide backlash."""
    summary = summarize_verdicts(make_measurements(backlash_rad=4 * SWING_RAD))[0]
    assert summary.startswith(IS_LOOSE)
    assert "the coupling slips, or the backlash" in summary
    assert "its coupling slips" not in summary


def test_judge_link_that_turns_while_its_drive_holds_is_loose() -> None:
    """While the joint itself moves, its link follows, so only the motion of another joint shows the fault."""
    summary, *others = summarize_verdicts(make_measurements(held_slip_rad=0.03))
    assert summary.startswith(f"{IS_LOOSE}: its links turned against each other by 0.05")
    assert "while its drive held still" in summary
    assert others == [MATCHES_FILE] * (JOINTS - 1)


def test_judge_gyro_that_falls_silent_leaves_backlash_unknown() -> None:
    measured = make_measurements()
    rates = measured.link_rate_rad_s.copy()
    rates[-100:, 1] = np.nan
    verdict = judge_joints(replace(measured, link_rate_rad_s=rates), was_laid_straight=True)[0]
    assert list_unconfirmed(verdict) == {"gear": "unknown"}
    assert "silent" in verdict.findings["gear"].reason


@pytest.mark.parametrize("passes_torque_on", [True, False])
def test_judge_gear_names_slipping_coupling_only_with_passed_load(passes_torque_on: bool) -> None:
    motions = LinkMotions(
        motion_ratio=0.02,
        lost_motion=None,
        held_motions=[],
        small_motion_ratio=None,
        passes_torque_on=passes_torque_on,
    )
    finding = judge_gear_by_links(motions, JointDrive(), 0.01)
    assert finding.state == "wrong"
    assert finding.reason.startswith("its coupling slips" if passes_torque_on else IS_LOOSE)


def test_judge_gravity_reveals_zero_of_a_bent_pitch_joint() -> None:
    measured = make_measurements(pitch_rad=0.2)  # the encoder measures 0
    assert summarize_verdicts(measured) == [
        MATCHES_FILE,
        "its zero is off by -0.200 rad: zero_rad = 0.500",
        MATCHES_FILE,
    ]
    corrected = replace(measured, angle_rad=measured.angle_rad + np.array((0.0, 0.2, 0.0)))
    assert summarize_verdicts(corrected) == [MATCHES_FILE] * JOINTS


@pytest.mark.parametrize(
    ("torque_nm", "cause"),
    [(0.0, "did not move: motor, brake, power"), (2.5, "its motor pushed with up to 2.50 N·m")],
    ids=["no torque", "torque towards the target"],
)
def test_judge_joint_that_does_not_move_is_described_by_its_torque(
    torque_nm: float, cause: str
) -> None:
    measured = make_measurements()
    angle_rad = measured.angle_rad.copy()
    angle_rad[:, 0] = 0.0
    torques_nm = measured.torque_nm.copy()
    torques_nm[:, 0] = torque_nm * np.sign(measured.target_rad[:, 0])
    stuck = replace(
        measured,
        angle_rad=angle_rad,
        velocity_rad_s=np.where([True, False, False], 0.0, measured.velocity_rad_s),
        torque_nm=torques_nm,
    )
    drive = judge_joints(stuck, was_laid_straight=True)[0].findings["drive"]
    assert drive.state == "wrong"
    assert cause in drive.reason


@pytest.mark.parametrize(
    ("lag_sign", "state"),
    [(-1.0, "confirmed"), (1.0, "wrong")],
    ids=["a load pushes it away from its target", "it moves towards its target"],
)
def test_judge_torque_against_motion_is_wrong_only_towards_target(
    lag_sign: float, state: str
) -> None:
    measured = make_measurements()
    directions = np.sign(measured.velocity_rad_s[:, 0])
    torque_nm = measured.torque_nm.copy()
    torque_nm[:, 0] = -0.5 * directions
    target_rad = measured.target_rad.copy()
    target_rad[:, 0] += 0.01 * lag_sign * directions
    verdicts = judge_joints(
        replace(measured, torque_nm=torque_nm, target_rad=target_rad), was_laid_straight=True
    )
    assert verdicts[0].findings["drive"].state == state


def test_judge_torque_against_its_motion_has_wrong_sign() -> None:
    measured = make_measurements()
    wrong = replace(measured, torque_nm=measured.torque_nm * np.array((-1.0, 1.0, 1.0)))
    assert summarize_verdicts(wrong)[0].startswith("its torque has the wrong sign")
    assert summarize_verdicts(wrong)[1:] == [MATCHES_FILE, MATCHES_FILE]


@pytest.mark.parametrize("link", [0, 1])
def test_judge_joint_beside_link_without_imu_is_unknown(link: int) -> None:
    verdict = judge_joints(remove_imus(make_measurements(), link), was_laid_straight=True)[0]
    assert verdict.turned is None
    assert not verdict.all_confirmed
    assert list_unconfirmed(verdict) == {"sign": "unknown", "gear": "unknown"}


def add_dead_zone(shaft_rad: Floats, dead_zone_rad: float) -> Floats:
    """Return the angles of an encoder that sticks, and then jumps to the angle of the shaft."""
    encoder_rad = np.zeros_like(shaft_rad)
    encoder_angle_rad = 0.0
    for tick, shaft_angle_rad in enumerate(shaft_rad):
        if abs(shaft_angle_rad - encoder_angle_rad) >= dead_zone_rad:
            encoder_angle_rad = shaft_angle_rad
        encoder_rad[tick] = encoder_angle_rad
    return encoder_rad


@pytest.mark.parametrize("has_imus", [True, False])
def test_judge_encoder_with_dead_zone_leaves_gear_unknown(has_imus: bool) -> None:
    measured = make_measurements()
    angle_rad = measured.angle_rad.copy()
    angle_rad[:, 1] = add_dead_zone(measured.target_rad[:, 1], 0.02)
    measured = replace(measured, angle_rad=angle_rad)
    if not has_imus:
        measured = remove_imus(measured, *range(JOINTS + 1))
    verdicts = judge_joints(measured, was_laid_straight=True)
    assert verdicts[1].summary.startswith("its encoder has a dead zone: its angle sticks")
    assert "jumps by 0.02" in verdicts[1].summary
    assert list_unconfirmed(verdicts[1]) == {
        "drive": "wrong",
        "order": "unknown",
        "sign": "unknown",
        "gear": "unknown",
    }
    assert [verdicts[joint].findings["drive"].state for joint in (0, 2)] == ["confirmed"] * 2


@pytest.mark.parametrize("ticks", [(3,), (3, 5), (3, 5, 7, 9)])
def test_judge_accepts_motion_of_a_single_tick(ticks: tuple[int, ...]) -> None:
    """After a jump over a dead zone, a small motion may end in the tick in which it starts."""
    measured = make_measurements()
    target_rad = measured.target_rad.copy()
    for tick in ticks:
        target_rad[REST_TICKS + len(LARGE_MOTION_RAD) - tick, 0] = 0.001
    verdicts = judge_joints(replace(measured, target_rad=target_rad), was_laid_straight=True)
    assert verdicts[0].findings["drive"].state == "confirmed"


def test_judge_few_late_samples_are_no_dead_zone() -> None:
    measured = make_measurements()
    angle_rad = measured.angle_rad.copy()
    for tick in (REST_TICKS + 5, REST_TICKS + 30):
        angle_rad[tick : tick + 4, 0] = angle_rad[tick, 0]
    verdicts = judge_joints(replace(measured, angle_rad=angle_rad), was_laid_straight=True)
    assert verdicts[0].findings["drive"].state == "confirmed"


def test_judge_shapes_never_confirm_gear_with_unknown_backlash() -> None:
    measured = remove_imus(make_measurements(), *range(JOINTS + 1))
    verdict = judge_joints(measured, was_laid_straight=True)[0]
    assert (
        "backlash and ratio unknown, as it made no small motion" in verdict.findings["gear"].reason
    )
    seen = verdict.confirm_by_shape(["order", "sign", "gear", "zero"], was_shaken=False)
    assert list_unconfirmed(seen) == {"gear": "unknown"}
    assert seen.confirm_by_hand(["gear"]).all_confirmed
    shaken = verdict.confirm_by_shape(["order", "sign", "gear", "zero"], was_shaken=True)
    assert shaken.all_confirmed


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
def test_judge_shapes_confirm_gear_only_with_computed_backlash_bound(
    play: GearPlay, state: str, excludes_backlash: bool
) -> None:
    finding = judge_gear_by_torque(play, allowed_backlash_rad=0.01)
    assert finding.state == state
    assert finding.excludes_backlash == excludes_backlash
    verdict = JointVerdict("joint_1", {"gear": finding})
    seen = verdict.confirm_by_shape(["gear"], was_shaken=False).findings["gear"]
    assert (seen.state == "confirmed") == excludes_backlash


def test_judge_shaking_never_confirms_gear_found_wrong() -> None:
    finding = judge_gear_by_torque(
        GearPlay("backlash", min_backlash_rad=0.012), allowed_backlash_rad=0.01
    )
    verdict = JointVerdict("joint_1", {"gear": finding})
    assert verdict.confirm_by_shape(["gear"], was_shaken=True).findings["gear"].state == "wrong"


def test_judge_two_imus_cannot_separate_joints_of_equal_effect() -> None:
    measured = replace(make_measurements(), axes=["yaw", "yaw", "yaw"])
    verdict = judge_joints(remove_imus(measured, 2, 3), was_laid_straight=True)[0]
    assert list_unconfirmed(verdict) == {"order": "unknown"}
    assert "joint_2, joint_3" in verdict.findings["order"].reason


def test_judge_joint_without_its_motion_is_not_confirmed() -> None:
    measured = make_measurements()
    unmoved = replace(measured, target_rad=measured.target_rad * np.array((1.0, 1.0, 0.0)))
    unmoved_verdict = judge_joints(unmoved, was_laid_straight=True)[2]
    assert list_unconfirmed(unmoved_verdict) == dict.fromkeys(
        ("drive", "order", "sign", "gear"), "unknown"
    )
    dead = replace(
        measured, angle_rad=measured.angle_rad * 0, velocity_rad_s=measured.velocity_rad_s * 0
    )
    dead_verdict = judge_joints(dead, was_laid_straight=True)[0]
    assert dead_verdict.summary.startswith("did not move")
    assert not dead_verdict.confirm_by_hand(["order", "sign", "gear"]).all_confirmed


def test_judge_dead_joint_swung_by_others_affects_no_verdict() -> None:
    measured = make_measurements()
    angle_rad = measured.angle_rad.copy()
    angle_rad[:, 2] = np.linspace(0.0, 0.6, len(angle_rad))
    target_rad = measured.target_rad.copy()
    target_rad[:, 2] = np.maximum(angle_rad[:, 2] - 0.35, 0.0)
    target_rad = remove_clamped_targets(target_rad, angle_rad, max_step_rad=0.35)
    assert target_rad[:, 2] == pytest.approx(0.0)
    measured = replace(
        measured,
        angle_rad=angle_rad,
        target_rad=target_rad,
        link_rate_rad_s=measured.link_rate_rad_s,
    )
    verdicts = judge_joints(measured, was_laid_straight=True)
    assert [verdict.findings["zero"].state for verdict in verdicts] == ["confirmed"] * JOINTS
    assert verdicts[0].all_confirmed
    assert not verdicts[2].all_confirmed


def test_judge_motion_capture_of_base_replaces_its_imu() -> None:
    measured = remove_imus(make_measurements(), 0)
    # Joint 1 turns the tail link, and the rest of the body does not move.
    measured.link_rate_rad_s[:, 1:, 2] -= measured.velocity_rad_s[:, :1]
    base_rotation_rad = np.zeros((len(measured.angle_rad), 3))
    base_rotation_rad[:, 2] = -measured.angle_rad[:, 0]
    assert (
        summarize_verdicts(replace(measured, base_rotation_rad=base_rotation_rad))[0]
        == MATCHES_FILE
    )
    assert (
        "the other way"
        in summarize_verdicts(replace(measured, base_rotation_rad=-base_rotation_rad))[0]
    )
