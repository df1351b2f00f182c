"""Tests that hidden faults of emulated robots are reported, with one or a few robots of each kind.

`commissioning_trials` and `torque_constant_trials` run the same trials with many robots.
"""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.model.robot_file.joints import JointDrive, JointMotor
from snakesim_operator.features.commissioning.joint_check.gear_rules import IS_LOOSE
from snakesim_operator.features.commissioning.joint_check.judge import judge_joints
from snakesim_operator.features.commissioning.joint_check.measurements import CheckMeasurements
from verification.identification_trials import identify_hidden_robot
from verification.recorded_trials import append_result, read_results, run_missing_trials
from verification.start_check_results import RobotResult, append_trial, judge_again
from verification.start_check_signals import load_signals, save_signals
from verification.start_check_trials import NONE, LinkWeights, check_trial, run_start_check
from verification.torque_constant_results import TorqueConstantResult
from verification.torque_constant_trials import draw_fault, identify_torque_constants


@pytest.mark.parametrize("fault", ["backlash", NONE])
def test_hidden_fault_is_named_without_blaming_sound_joints(tmp_path: Path, fault: str) -> None:
    trial = check_trial(4, fault, joint_count=4)
    results_path = tmp_path / "trials.jsonl"
    append_trial(results_path, trial)
    recorded = read_results(results_path, RobotResult)
    assert list(judge_again(results_path, recorded)) == recorded
    assert not trial.blamed and not trial.unsure, (trial.blamed, trial.unsure)
    assert fault == NONE or trial.found, [row.summary for row in trial.rows]


@pytest.mark.parametrize(
    ("number", "reason"),
    [(9042, "while its drive held still"), (9102, "it passes a torque on")],
    ids=["it carries only its own link", "its large motion proves the torque"],
)
def test_coupling_whose_own_small_motion_shows_no_slip_is_named(number: int, reason: str) -> None:
    trial = check_trial(number, "coupling")
    (row,) = (trial.rows[joint] for joint in trial.joints)
    assert trial.found, row.summary
    assert reason in row.findings["gear"].reason
    assert not trial.blamed, trial.blamed


@pytest.mark.parametrize(
    ("number", "fault"), [(32, "backlash"), (6, "coupling"), (29, "dead zone")]
)
def test_weights_make_faults_of_end_joints_known_and_blame_no_sound_joint(
    tmp_path: Path, number: int, fault: str
) -> None:
    """The faults are in joint_1 and joint_5. The sound joint_1 of robot 29 slides on a slippery floor."""
    trial = check_trial(number, fault, backend="odrive", weights=LinkWeights(ends_kg=1.0))
    assert trial.found, [row.summary for row in trial.rows]
    assert not trial.blamed, trial.blamed
    results_path = tmp_path / "trials.jsonl"
    append_trial(results_path, trial)
    recorded = read_results(results_path, RobotResult)
    assert list(judge_again(results_path, recorded)) == recorded


def test_sound_joint_beside_a_jerking_drive_is_not_reported() -> None:
    """Joint_4 sticks and jumps by its dead zone, faster than the gyros of the links sample."""
    trial = check_trial(9137, "dead zone")
    assert trial.found, [row.summary for row in trial.rows]
    assert not trial.blamed, trial.blamed


@pytest.mark.slow
def test_no_sound_joint_of_a_long_robot_is_loose_at_a_low_rate() -> None:
    """At 50 Hz, the rates of links and drives give an inaccurate ratio, and heavy loads push some joints back."""
    measurements = run_start_check(
        *("backend=can", "robot=mamba", "seed=3", "duration_s=80", "scene.ground.friction=0.3"),
        *("rate_hz=50", "backends.can.imu_rate_hz=50"),
    )
    rows = judge_joints(measurements, was_laid_straight=True)
    assert len(rows) == 18
    assert [row.summary for row in rows if row.list_properties("wrong")] == []


def test_recorded_signals_are_read_without_a_rounding_error(tmp_path: Path) -> None:
    random = np.random.default_rng(1).standard_normal
    motor = JointMotor(
        stiffness_nm_per_rad=60.0,
        damping_nm_s_per_rad=1.5,
        velocity_gain_nm_s_per_rad=1.5,
        response_time_s=0.01,
        armature_kg_m2=0.005,
    )
    written = CheckMeasurements(
        period_s=0.01,
        joint_names=["joint_1", "joint_2"],
        axes=["yaw", "pitch"],
        drives=[JointDrive(gear=1 / 3), JointDrive(sign=-1)],
        motors=[motor, motor],
        link_lengths_m=[0.05, 0.1, 1 / 3],
        link_masses_kg=[0.1, 0.3, 0.2],
        angle_rad=random((9, 2)),
        velocity_rad_s=random((9, 2)),
        torque_nm=random((9, 2)),
        target_rad=random((9, 2)),
        link_rate_rad_s=np.full((9, 3, 3), np.nan),
        link_force_m_s2=random((9, 3, 3)),
        base_rotation_rad=np.full((9, 3), np.nan),
    )
    save_signals(tmp_path / "signals" / "robot.npz", written)
    read = load_signals(tmp_path / "signals" / "robot.npz")
    for field in fields(CheckMeasurements):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(written, field.name))


@pytest.mark.slow
def test_wrong_torque_constants_are_reported_and_no_right_one() -> None:
    for trial in identify_hidden_robot(4, "duration_s=12", backlash=False):
        assert trial.reported_constant_count == trial.wrong_constant_count == 4
        assert not trial.falsely_reported_constant_count


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["odrive", "dynamixel", "can"])
def test_wrong_torque_constant_of_whole_chain_is_named(tmp_path: Path, backend: str) -> None:
    result = identify_torque_constants(1, backend)
    append_result(tmp_path / "trials.jsonl", result)
    assert read_results(tmp_path / "trials.jsonl", TorqueConstantResult) == [result]
    assert result.faulty_joint == "joint_2"
    assert result.is_named, result
    assert not result.falsely_reported
    assert not result.unknown
    assert all(abs(joint.relative_error or 0.0) < 0.05 for joint in result.joints)


def make_torque_constant_result(number: int, backend: str = "odrive") -> TorqueConstantResult:
    return TorqueConstantResult(
        backend=backend, number=number, file_nm_per_a=0.5, faulty_joint=None, joints=[]
    )


def test_only_missing_trials_of_the_backend_are_run(tmp_path: Path) -> None:
    record = tmp_path / "trials.jsonl"
    append_result(record, make_torque_constant_result(1))
    append_result(record, make_torque_constant_result(2, "moteus"))
    run_numbers: list[int] = []

    def run_trial(number: int) -> TorqueConstantResult:
        run_numbers.append(number)
        return make_torque_constant_result(number)

    results = run_missing_trials(range(1, 4), "odrive", record, TorqueConstantResult, run_trial)
    assert run_numbers == [2, 3]
    assert [result.number for result in results] == [1, 2, 3]


def test_servos_without_torque_have_unknown_constants() -> None:
    result = identify_torque_constants(1, "feetech")
    assert "needs the measured torque of every joint" in result.refusal
    assert len(result.unknown) == len(result.joints)
    assert not result.is_named
    assert not result.falsely_reported


def test_every_fourth_robot_has_no_wrong_torque_constant() -> None:
    faults = [draw_fault(number) for number in range(400)]
    assert [fault is None for fault in faults] == [number % 4 == 3 for number in range(400)]
    ratios = [fault[1] for fault in faults if fault is not None]
    assert all(0.15 <= abs(ratio - 1) <= 0.40 for ratio in ratios)
    assert min(ratios) < 1 < max(ratios)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "number", "fault"),
    [
        ("feetech", 30, "backlash"),  # which do not measure their torque
        ("odrive", 112, "backlash"),  # whose teeth touch at one end of the small motion
        ("odrive", 6, "dead zone"),
        ("odrive", 40, "coupling"),
    ],
)
def test_hidden_fault_of_robot_without_imus_is_named(backend: str, number: int, fault: str) -> None:
    trial = check_trial(number, fault, backend=backend)
    assert trial.found, [row.summary for row in trial.rows]
    assert not trial.blamed


@pytest.mark.slow
def test_backlash_wider_than_the_motion_is_not_called_a_coupling() -> None:
    wide = "backends.odrive.mounted.joint_4.backlash_rad=0.3"
    trial = check_trial(5003, NONE, wide, backend="odrive")
    gear = trial.rows[3].findings["gear"]
    assert gear.state == "wrong"
    assert gear.reason.startswith(IS_LOOSE)
    assert "backlash" in gear.reason


@pytest.mark.slow
def test_backlash_spoils_no_values_of_other_joints() -> None:
    with_imus, without_imus = identify_hidden_robot(4, "duration_s=12", backlash=True)
    assert with_imus.named_joints == [with_imus.loose_joint]
    for trial in (with_imus, without_imus):
        assert trial.covered_count == trial.written_count
        assert trial.inaccurate_constant_count == 0
