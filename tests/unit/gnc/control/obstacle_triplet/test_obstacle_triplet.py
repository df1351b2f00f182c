"""Tests the commands and telemetry of `obstacle_triplet` for synthetic observations, without physics."""

import numpy as np
import pytest

from snakesim_gnc.control.obstacle_triplet import ObstacleTriplet, TripletParameters
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import PERIOD_S, make_contact, make_stage, require_value

TAIL_S_M = 0.3
JOINT_COUNT = 13
DEFAULT_PROPULSION_N = 35.0


def make_controller(stage, **parameters) -> ObstacleTriplet:
    return ObstacleTriplet(stage.robot, TripletParameters(**parameters))


def list_torque_joints(command) -> list[int]:
    """Return the joints that the command puts into torque mode."""
    return [i for i, mode in enumerate(command.setpoints.mode) if mode == JointMode.TORQUE]


def list_other_joints(propulsion_joint) -> list[int]:
    return [i for i in range(JOINT_COUNT) if i != propulsion_joint]


def command_standing_body(controller, stage, ticks, **changes):
    """Return the last of several commands for a body that does not move."""
    return [
        controller.update(stage.make_observation(tick, TAIL_S_M, **changes))
        for tick in range(ticks)
    ][-1]


STEADY_TICKS = 100  # until the controller of a body that does not move has settled


def make_settled_command():
    """Return the command of a controller with default parameters for a body that does not move."""
    stage = make_stage()
    return command_standing_body(make_controller(stage), stage, STEADY_TICKS)


def test_triplet_one_joint_pushes_while_all_others_hold_shape():
    command = make_settled_command()
    report = command.telemetry
    assert list_torque_joints(command) == [report.propulsion_joint]
    others = list_other_joints(report.propulsion_joint)
    targets_rad = np.array(command.setpoints.target)
    reference_rad = np.array(report.reference_rad)
    assert targets_rad[others] == pytest.approx(reference_rad[others], abs=1e-3)


def test_triplet_report_has_path_position_and_propulsion():
    report = make_settled_command().telemetry
    assert report.reason == ""
    assert report.usable_push_points == 4
    assert report.propulsion_n == pytest.approx(35.0, rel=0.01)
    assert report.path_s_m == pytest.approx(TAIL_S_M, abs=1e-3)
    assert len(report.bending_torque_nm) == len(report.reference_rad) == 13
    assert 1 < require_value(report.condition) < 20


def test_triplet_push_point_forces_add_up_to_propulsion_along_tail():
    report = make_settled_command().telemetry
    forces_n = np.array([point.force_w for point in report.push_points])[:, :2]
    tail_tangent = np.array(report.push_points[0].tangent_w)[:2]
    assert forces_n.sum(axis=0) == pytest.approx(report.propulsion_n * tail_tangent, abs=1e-6)
    assert np.hypot(*forces_n.T) == pytest.approx(report.desired_force_n)
    assert min(report.desired_force_n) > 0


def test_triplet_push_points_are_listed_from_tail_to_head():
    report = make_settled_command().telemetry
    places_m = [point.body_s_m for point in report.push_points]
    assert places_m == sorted(places_m)


def test_triplet_propulsion_torque_is_bending_torque_of_its_joint():
    report = make_settled_command().telemetry
    torque_nm = report.bending_torque_nm[require_value(report.propulsion_joint)]
    assert report.propulsion_torque_nm == pytest.approx(torque_nm, rel=1e-6)
    rated_nm = 7.0
    assert report.torque_headroom_nm == pytest.approx(rated_nm - abs(torque_nm), abs=0.05)


def test_triplet_servo_targets_lead_by_load_when_requested():
    stage = make_stage()
    controller = make_controller(stage, load_ratio=1.0, load_filter_s=0.05)
    command = command_standing_body(controller, stage, 99)
    others = list_other_joints(command.telemetry.propulsion_joint)
    stiffness = np.array([joint.stiffness_nm_per_rad for joint in stage.robot.joints])
    targets_rad = np.array(command.setpoints.target)
    lead_rad = targets_rad - np.array(command.telemetry.reference_rad)
    deflection_rad = np.array(command.telemetry.bending_torque_nm) / stiffness
    assert lead_rad[others] == pytest.approx(deflection_rad[others], abs=2e-3)
    assert np.abs(deflection_rad[others]).max() > 0.03
    # Without a world model, the lead fades, and does not disappear at once.
    blind_command = controller.update(stage.make_observation(99, TAIL_S_M, without="world"))
    blind_targets_rad = np.array(blind_command.setpoints.target)
    assert blind_targets_rad[others] == pytest.approx(targets_rad[others], abs=5e-3)


def test_triplet_pushes_less_the_faster_the_body_moves():
    stage = make_stage()
    controller = make_controller(stage)
    forces_n = [
        controller.update(
            stage.make_observation(tick, 0.1 + 0.1 * tick * PERIOD_S)
        ).telemetry.propulsion_n
        for tick in range(60)
    ]
    assert forces_n[-1] == pytest.approx(DEFAULT_PROPULSION_N * 0.5, rel=0.1)


def test_triplet_propulsion_joint_that_swings_out_pushes_less():
    stage = make_stage()
    controller = make_controller(stage)
    settled = command_standing_body(controller, stage, 50).telemetry
    joint = require_value(settled.propulsion_joint)
    direction = np.sign(require_value(settled.propulsion_torque_nm))
    # The joint swings first with its torque, then against it.
    for first_tick, turned_rad, fraction in (
        (50, 0.3 * direction, 0.5),
        (60, -0.3 * direction, 1.0),
    ):
        observations = [
            stage.make_observation(
                tick, TAIL_S_M, world_age_ticks=tick - 49, turned={joint: turned_rad}
            )
            for tick in range(first_tick, first_tick + 10)
        ]
        propulsions_n = [
            controller.update(observation).telemetry.propulsion_n for observation in observations
        ]
        assert propulsions_n[-1] == pytest.approx(fraction * DEFAULT_PROPULSION_N, rel=0.05)


def test_triplet_joint_off_its_reference_returns_to_position_mode():
    stage = make_stage()
    stage.pegs = stage.pegs[1:4]
    controller = make_controller(stage, guard_s=0.5)
    joint = require_value(command_standing_body(controller, stage, 10).telemetry.propulsion_joint)
    command = controller.update(
        stage.make_observation(10, TAIL_S_M, world_age_ticks=1, turned={joint: 0.9})
    )
    assert list_torque_joints(command) == []
    assert f"joint_{joint + 1} left its reference" in command.telemetry.reason
    guarded_joints = [
        controller.update(stage.make_observation(tick, TAIL_S_M)).telemetry.propulsion_joint
        for tick in range(11, 40)
    ]
    assert joint not in guarded_joints
    later_joints = [
        controller.update(stage.make_observation(tick, TAIL_S_M)).telemetry.propulsion_joint
        for tick in range(60, 80)
    ]
    assert joint in later_joints


def test_triplet_saturated_joint_is_reported_with_reduced_force():
    limit_nm = 1.0
    stage = make_stage(torque_nm=limit_nm)
    command = command_standing_body(make_controller(stage), stage, 100)
    report = command.telemetry
    assert report.saturated
    assert require_value(report.torque_headroom_nm) < 0
    assert require_value(report.propulsion_n) < DEFAULT_PROPULSION_N
    joint = require_value(report.propulsion_joint)
    assert abs(command.setpoints.target[joint]) == pytest.approx(limit_nm, rel=1e-3)
    assert abs(report.bending_torque_nm[joint]) == pytest.approx(limit_nm, rel=1e-2)


def test_triplet_hand_over_to_same_joint_keeps_torque_continuous():
    stage = make_stage()
    stage.pegs = stage.pegs[:5]
    controller = make_controller(stage, stall_s=5.0)
    reports = []
    torque_nm = 0.0
    for tick in range(200):
        if tick == 100:
            stage.pegs = [peg for peg in stage.pegs if peg.name != "peg_2"]
        observation = stage.make_observation(tick, 0.2, torque_nm=torque_nm)
        reports.append(controller.update(observation).telemetry)
        torque_nm = require_value(reports[-1].propulsion_torque_nm)
    before = reports[99]
    after = reports[199]
    assert [point.obstacle for point in before.push_points] == ["peg_0", "peg_1", "peg_2"]
    assert [point.obstacle for point in after.push_points] == ["peg_0", "peg_1", "peg_4"]
    assert before.propulsion_joint == after.propulsion_joint
    torques_nm = np.array([require_value(report.propulsion_torque_nm) for report in reports[99:]])
    change_nm = abs(torques_nm[-1] - torques_nm[0])
    assert change_nm > 1.0
    assert np.abs(np.diff(torques_nm)).max() < 0.1 * change_nm


def test_triplet_without_requested_speed_does_not_push():
    stage = make_stage()
    controller = make_controller(stage)
    assert list_torque_joints(command_standing_body(controller, stage, 10))
    stage.speed_m_s = 0.0
    command = controller.update(stage.make_observation(11, TAIL_S_M, world_age_ticks=1))
    assert list_torque_joints(command) == []
    assert command.telemetry.reason == ""
    assert command.telemetry.usable_push_points == 4


@pytest.mark.parametrize("peg_count", [0, 2])
def test_triplet_with_fewer_than_three_push_points_does_not_push(peg_count):
    stage = make_stage()
    stage.pegs = stage.pegs[1 : 1 + peg_count]
    command = command_standing_body(make_controller(stage), stage, 5)
    assert list_torque_joints(command) == []
    assert command.telemetry.usable_push_points == peg_count
    assert command.telemetry.reason


def test_triplet_standing_still_is_reported_and_jam_released():
    stage = make_stage()
    controller = make_controller(stage, stall_s=0.5, release_s=0.2)
    contacts = [make_contact("peg_1", (400.0, 0.0, 0.0)), make_contact("peg_2", (-390.0, 0.0, 0.0))]
    reports = [
        controller.update(stage.make_observation(tick, TAIL_S_M, contacts=contacts)).telemetry
        for tick in range(200)
    ]
    jammed_reports = [report for report in reports if report.jammed]
    assert jammed_reports[0].reason.startswith("jammed: standing still")
    assert jammed_reports[0].reason.endswith("peg_2 most")
    # The controller alternately pushes and releases the body.
    assert any(report.propulsion_joint is not None for report in jammed_reports)
    assert any(report.propulsion_joint is None for report in jammed_reports)

    # The jam ends only when the body advances.
    assert command_standing_body(controller, stage, 3).telemetry.jammed
    moving_report = [
        controller.update(stage.make_observation(200 + tick, TAIL_S_M + 0.002 * tick)).telemetry
        for tick in range(40)
    ][-1]
    assert not moving_report.jammed
    assert moving_report.reason == ""


def test_triplet_keeps_pitch_joints_straight():
    stage = make_stage(26, ("yaw", "pitch"))
    command = command_standing_body(make_controller(stage), stage, 100)
    assert require_value(command.telemetry.propulsion_joint) % 2 == 0
    assert command.telemetry.reason == ""
    pitch_targets_rad = np.array(command.setpoints.target)[1::2]
    assert np.abs(pitch_targets_rad).max() < 1e-6
    assert len(command.telemetry.bending_torque_nm) == 26


def test_triplet_on_new_path_moves_no_target_at_once():
    stage = make_stage()
    controller = make_controller(stage)
    before = command_standing_body(controller, stage, 50).setpoints
    stage.path_id = 1
    after = controller.update(stage.make_observation(50, TAIL_S_M + 0.05)).setpoints
    position_joints = [
        i for i in range(JOINT_COUNT) if before.mode[i] == after.mode[i] == JointMode.POSITION
    ]
    assert len(position_joints) >= 11
    for i in position_joints:
        assert after.target[i] == pytest.approx(before.target[i], abs=0.03)
