"""The controller on observations made by hand: what it commands and reports, without physics."""

import numpy as np
import pytest

from snakesim_gnc.control.obstacle_triplet import ObstacleTriplet, TripletParameters
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import PERIOD_S, make_contact, make_stage, require_value

TAIL_S_M = 0.3


def make_controller(stage, **parameters) -> ObstacleTriplet:
    return ObstacleTriplet(stage.robot, TripletParameters(**parameters))


def torque_joints(command) -> list[int]:
    return [i for i, mode in enumerate(command.setpoints.mode) if mode == JointMode.TORQUE]


def stay(controller, stage, ticks, **more):
    """The last of many updates of a body that does not move."""
    return [
        controller.update(stage.make_observation(tick, TAIL_S_M, **more)) for tick in range(ticks)
    ][-1]


STEADY_TICKS = 100  # until the controller of a body that does not move has settled


def make_settled_command():
    """Return the command of a controller with default parameters for a body that does not move."""
    stage = make_stage()
    return stay(make_controller(stage), stage, STEADY_TICKS)


def test_triplet_one_joint_pushes_while_all_others_hold_shape():
    command = make_settled_command()
    report = command.telemetry
    assert torque_joints(command) == [report.propulsion_joint]
    others = [i for i in range(13) if i != report.propulsion_joint]
    targets_rad = np.array(command.setpoints.target)
    reference_rad = np.array(report.reference_rad)
    assert targets_rad[others] == pytest.approx(reference_rad[others], abs=1e-3)


def test_triplet_report_has_place_and_propulsion_on_path():
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
    command = stay(controller, stage, 99)
    others = [i for i in range(13) if i != command.telemetry.propulsion_joint]
    stiffness = np.array([joint.stiffness_nm_per_rad for joint in stage.robot.joints])
    lead = np.array(command.setpoints.target) - np.array(command.telemetry.reference_rad)
    load = np.array(command.telemetry.bending_torque_nm) / stiffness
    assert lead[others] == pytest.approx(load[others], abs=2e-3)
    assert np.abs(load[others]).max() > 0.03
    blind = controller.update(stage.make_observation(99, TAIL_S_M, without="world"))
    targets = np.array(blind.setpoints.target)
    # And fades.
    assert targets[others] == pytest.approx(np.array(command.setpoints.target)[others], abs=5e-3)


def test_the_faster_it_moves_the_less_it_pushes():
    stage = make_stage()
    controller = make_controller(stage)
    forces = [
        controller.update(
            stage.make_observation(t, 0.1 + 0.1 * t * PERIOD_S)
        ).telemetry.propulsion_n
        for t in range(60)
    ]
    assert forces[-1] == pytest.approx(35.0 * 0.5, rel=0.1)


def test_a_joint_that_has_swung_out_pushes_less():
    stage = make_stage()
    controller = make_controller(stage)
    settled = stay(controller, stage, 50).telemetry
    joint, way = (
        require_value(settled.propulsion_joint),
        np.sign(require_value(settled.propulsion_torque_nm)),
    )
    for first, turned_rad, share in ((50, 0.3 * way, 0.5), (60, -0.3 * way, 1.0)):
        observations = [
            stage.make_observation(
                tick, TAIL_S_M, world_age_ticks=tick - 49, turned={joint: turned_rad}
            )
            for tick in range(first, first + 10)
        ]
        pushed = [
            controller.update(observation).telemetry.propulsion_n for observation in observations
        ]
        assert pushed[-1] == pytest.approx(share * 35.0, rel=0.05)


def test_triplet_joint_off_its_reference_returns_to_position_mode():
    stage = make_stage()
    stage.pegs = stage.pegs[1:4]
    controller = make_controller(stage, guard_s=0.5)
    joint = require_value(stay(controller, stage, 10).telemetry.propulsion_joint)
    command = controller.update(
        stage.make_observation(10, TAIL_S_M, world_age_ticks=1, turned={joint: 0.9})
    )
    assert torque_joints(command) == []
    assert f"joint_{joint + 1} left its reference" in command.telemetry.reason
    turns = [
        controller.update(stage.make_observation(t, TAIL_S_M)).telemetry.propulsion_joint
        for t in range(11, 40)
    ]
    assert joint not in turns
    assert joint in [
        controller.update(stage.make_observation(t, TAIL_S_M)).telemetry.propulsion_joint
        for t in range(60, 80)
    ]


def test_triplet_saturated_joint_is_reported_with_reduced_force():
    stage = make_stage(torque_nm=1.0)
    command = stay(make_controller(stage), stage, 100)
    report = command.telemetry
    assert report.saturated
    assert require_value(report.torque_headroom_nm) < 0
    assert require_value(report.propulsion_n) < 35.0
    assert abs(command.setpoints.target[require_value(report.propulsion_joint)]) == pytest.approx(
        1.0, rel=1e-3
    )
    assert abs(report.bending_torque_nm[require_value(report.propulsion_joint)]) == pytest.approx(
        1.0, rel=1e-2
    )


def test_triplet_hand_over_to_same_joint_keeps_torque_continuous():
    stage = make_stage()
    stage.pegs, tail_s_m = stage.pegs[:5], 0.2
    controller = make_controller(stage, stall_s=5.0)
    reports, torque_nm = [], 0.0
    for tick in range(200):
        if tick == 100:
            stage.pegs = [peg for peg in stage.pegs if peg.name != "peg_2"]
        reports.append(
            controller.update(stage.make_observation(tick, tail_s_m, torque_nm=torque_nm)).telemetry
        )
        torque_nm = require_value(reports[-1].propulsion_torque_nm)
    before, after = reports[99], reports[199]
    assert [[p.obstacle for p in report.push_points] for report in (before, after)] == [
        ["peg_0", "peg_1", "peg_2"],
        ["peg_0", "peg_1", "peg_4"],
    ]
    assert before.propulsion_joint == after.propulsion_joint
    torques = np.array([require_value(report.propulsion_torque_nm) for report in reports[99:]])
    assert abs(torques[-1] - torques[0]) > 1.0
    assert np.abs(np.diff(torques)).max() < 0.1 * abs(torques[-1] - torques[0])


def test_triplet_without_requested_speed_does_not_push():
    stage = make_stage()
    controller = make_controller(stage)
    assert torque_joints(stay(controller, stage, 10))
    stage.speed_m_s = 0.0
    command = controller.update(stage.make_observation(11, TAIL_S_M, world_age_ticks=1))
    assert torque_joints(command) == []
    assert command.telemetry.reason == ""
    assert command.telemetry.usable_push_points == 4


@pytest.mark.parametrize("pegs", [0, 2])
def test_fewer_than_three_push_points_do_not_push(pegs):
    stage = make_stage()
    stage.pegs = stage.pegs[1 : 1 + pegs]
    command = stay(make_controller(stage), stage, 5)
    assert torque_joints(command) == []
    assert command.telemetry.usable_push_points == pegs
    assert command.telemetry.reason


def test_triplet_standing_still_is_reported_and_jam_released():
    stage = make_stage()
    controller = make_controller(stage, stall_s=0.5, release_s=0.2)
    contacts = [make_contact("peg_1", (400.0, 0.0, 0.0)), make_contact("peg_2", (-390.0, 0.0, 0.0))]
    pushed, released, jams = 0, 0, []
    for tick in range(200):
        report = controller.update(
            stage.make_observation(tick, TAIL_S_M, contacts=contacts)
        ).telemetry
        if report.jammed:
            jams.append(report.reason)
            pushed += report.propulsion_joint is not None
            released += report.propulsion_joint is None
    assert jams[0].startswith("jammed: standing still")
    assert jams[0].endswith("peg_2 most")
    assert pushed
    assert released
    moved = stay(controller, stage, 3)
    assert moved.telemetry.jammed
    report = [
        controller.update(stage.make_observation(200 + t, TAIL_S_M + 0.002 * t)).telemetry
        for t in range(40)
    ][-1]
    assert not report.jammed
    assert report.reason == ""


def test_pitch_joints_stay_straight():
    stage = make_stage(26, ("yaw", "pitch"))
    command = stay(make_controller(stage), stage, 100)
    assert require_value(command.telemetry.propulsion_joint) % 2 == 0
    assert command.telemetry.reason == ""
    pitch = np.array(command.setpoints.target)[1::2]
    assert np.abs(pitch).max() < 1e-6
    assert len(command.telemetry.bending_torque_nm) == 26


def test_a_new_path_moves_no_target_at_once():
    stage = make_stage()
    controller = make_controller(stage)
    before = stay(controller, stage, 50).setpoints
    stage.path_id = 1
    after = controller.update(stage.make_observation(50, TAIL_S_M + 0.05)).setpoints
    steady = [i for i in range(13) if before.mode[i] == after.mode[i] == JointMode.POSITION]
    assert len(steady) >= 11
    for i in steady:
        assert after.target[i] == pytest.approx(before.target[i], abs=0.03)
