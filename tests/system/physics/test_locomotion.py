"""Complete runs of the shipped scenarios in one process, with noise, limiter and lockstep, reach their distances."""

from functools import cache
from itertools import groupby, pairwise

import msgspec
import numpy as np
import pytest

from snakesim_hal.model.scene_file.scene import Cylinder, make_route
from snakesim_hal.safety.limiter import compute_bumpless_target
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import require_value
from snakesim_testing.runs.whole_run import RecordedTicks, load_run_config, run_controller

TRIPLET = "controllers.obstacle_triplet"
TICK_S = 0.01
STARTED_TICK = 50  # from here on, the body has moved far enough for the controller to report it
MAX_BLEND_FRACTION = 0.2  # period / blend_s + speed * period / blend_m at 0.9 m/s


@cache
def run_triplet(*options: str) -> RecordedTicks:
    """Run the case study, as shipped or changed. The run is cached, because several tests evaluate it."""
    return run_controller(load_run_config("triplet", *options))


def list_propulsion_joints(run: RecordedTicks) -> list[int]:
    """Return the joints that pushed one after the other."""
    return [joint for joint in run.propulsion_joints if joint is not None]


# --- the case study -------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize(
    "noise", [(), *(pytest.param((seed,), marks=pytest.mark.slow) for seed in ("seed=2", "seed=3"))]
)
def test_triplet_with_35_newtons_moves_half_a_meter(noise: tuple[str, ...]):
    run = run_triplet(*noise)
    assert run.record.time_s[-1] <= 10.0
    assert run.advance_m >= 0.5
    propulsion_joints = list_propulsion_joints(run)
    assert len(propulsion_joints) >= 4
    # Each propulsion joint is the next one towards the tail.
    assert propulsion_joints == [propulsion_joints[0] - k for k in range(len(propulsion_joints))]


def test_triplet_ends_when_obstacle_at_tail_is_lost():
    run = run_triplet()
    assert [state for state, _ in groupby(run.states)] == [
        "NotLocomoting",
        "Locomoting",
        "NotLocomoting",
    ]
    assert run.reasons[0].startswith("standing still")
    assert run.states[50] == "Locomoting"
    assert "2 usable push-points, 3 are needed" in run.reasons[-1]


@pytest.mark.heavy
@pytest.mark.parametrize("missing", ["world", pytest.param("trajectory", marks=pytest.mark.slow)])
def test_locomotion_without_world_or_trajectory_stops_then_continues(missing: str):
    gap = range(200, 400)
    run = run_controller(
        load_run_config("triplet"),
        duration_s=8.0,
        ticks_without_world=gap if missing == "world" else (),
        ticks_without_trajectory=gap if missing == "trajectory" else (),
    )
    record = run.record
    pushes = (record.mode == JointMode.TORQUE).any(axis=1)
    assert pushes[150:200].all()
    assert not pushes[gap.start + 2 : gap.stop].any()
    assert pushes[450:500].all()
    assert np.ptp(run.path_s_m[250:400]) < 0.01
    assert run.path_s_m[500] - run.path_s_m[400] > 0.05
    max_torque_before_nm = np.abs(record.torque_nm[150:200]).max()
    max_torque_in_gap_nm = np.abs(record.torque_nm[280:400]).max()
    assert max_torque_in_gap_nm < 0.5 * max_torque_before_nm
    target_steps = np.abs(np.diff(record.target, axis=0))[190:460]
    in_position_mode = record.mode == JointMode.POSITION
    stays_in_position_mode = (in_position_mode[1:] & in_position_mode[:-1])[190:460]
    assert target_steps[stays_in_position_mode].max() < 0.03  # rad; the limiter allows 0.075
    assert set(run.states[gap.start + 2 : gap.stop]) <= {"NotLocomoting", "Idle"}


def test_triplet_has_one_torque_joint_and_others_in_position():
    run = run_triplet()
    pushing = np.array([report.propulsion_joint is not None for report in run.reports])
    torque_joint_count = (run.record.mode == JointMode.TORQUE).sum(axis=1)
    # The ticks from a report of the controller to the effect of its command.
    delay_ticks = run.record.config.services["control"].latency_ticks - 1
    last = len(pushing) - delay_ticks
    assert (torque_joint_count[delay_ticks + 1 :] == pushing[1:last]).all()
    assert np.isin(run.record.mode, [JointMode.TORQUE, JointMode.POSITION]).all()


def test_triplet_only_propulsion_joint_leaves_its_reference():
    """The deviations are similar to those of the paper's Figure 12."""
    run = run_triplet()
    mode = run.record.mode
    reference_rad = np.array([report.reference_rad for report in run.reports])
    deviation_rad = np.abs(run.record.angle_rad - reference_rad)
    assert 0.1 < deviation_rad[mode == JointMode.TORQUE].max() < 0.7
    # A joint has settled if it has been in position mode for 40 ticks.
    settled = np.array(
        [
            mode[max(tick - 40, 0) : tick + 1].max(axis=0) == JointMode.POSITION
            for tick in range(len(mode))
        ]
    )
    assert np.median(deviation_rad[settled]) < 0.02


def test_triplet_case_study_commands_are_smooth_and_never_limited():
    run = run_triplet()
    record = run.record
    limits = record.config.robot.limits
    assert not any(report.saturated for report in run.reports)
    assert not record.host.limited_commands
    assert np.abs(record.torque_nm).max() < limits.torque_nm
    headroom_nm = [
        report.torque_headroom_nm for report in run.reports if report.torque_headroom_nm is not None
    ]
    assert min(headroom_nm) > 0
    target_steps = np.abs(np.diff(record.target, axis=0))
    same_mode = np.diff(record.mode, axis=0) == 0
    torque_steps_nm = target_steps[same_mode & (record.mode[1:] == JointMode.TORQUE)]
    angle_steps_rad = target_steps[same_mode & (record.mode[1:] == JointMode.POSITION)]
    assert torque_steps_nm.max() < limits.torque_rate_nm_s * TICK_S
    assert angle_steps_rad.max() < 0.6 * limits.speed_rad_s * TICK_S


def test_triplet_mode_change_moves_target_by_blend_fraction_at_most():
    """In the tick of a mode change, the applied target is near the target that would change nothing."""
    run = run_triplet()
    record = run.record
    mode_changes = 0
    for previous_tick, joint in zip(*np.nonzero(np.diff(record.mode, axis=0)), strict=True):
        tick = previous_tick + 1
        mode = JointMode(int(record.mode[tick, joint]))
        angle_rad = float(record.angle_rad[tick, joint])
        speed_rad_s = float(record.velocity_rad_s[tick, joint])
        torque_nm = float(record.torque_nm[tick, joint])
        description = record.description.joints[joint]
        bumpless_target = compute_bumpless_target(
            description, mode, angle_rad, speed_rad_s, torque_nm
        )
        report = run.reports[tick]
        if mode == JointMode.POSITION:
            full_change = abs(bumpless_target - report.reference_rad[joint])
        else:
            used_torque_nm = description.torque_limit_nm - require_value(report.torque_headroom_nm)
            full_change = used_torque_nm + 0.5 * abs(speed_rad_s) + abs(torque_nm)
        change = abs(record.target[tick, joint] - bumpless_target)
        assert change <= MAX_BLEND_FRACTION * full_change + 1e-9
        mode_changes += 1
    assert mode_changes >= 8


# --- triplets that are not neighbors -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("clearance_m", [pytest.param(0.02, marks=pytest.mark.slow), 0.05])
def test_braking_obstacles_between_push_points_do_not_stop_pushing(clearance_m: float):
    config = load_run_config("triplet")
    route = require_value(make_route(config.scene))
    body_radius_m = 0.04
    peg_radius_m = 0.05
    distance_from_route_m = body_radius_m + clearance_m + peg_radius_m
    behind, middle, ahead = route.find_inflections_s_m()[1:4]
    peg_positions_s_m = (
        0.3 * behind + 0.7 * middle,
        0.7 * middle + 0.3 * ahead,
        0.4 * middle + 0.6 * ahead,
    )
    pegs: list[Cylinder] = []
    for s_m, side in zip(peg_positions_s_m, (1, 1, -1), strict=True):
        x, y = route.compute_point(s_m)
        along_x, along_y = route.tangent_w(s_m).tolist()
        offset_m = side * distance_from_route_m
        pegs.append(
            Cylinder(
                position_m=(x - offset_m * along_y, y + offset_m * along_x),
                radius_m=peg_radius_m,
            )
        )
    scene = msgspec.structs.replace(config.scene, cylinder=pegs)
    run = run_controller(msgspec.structs.replace(config, scene=scene), duration_s=8.0)
    assert run.advance_m > 0.5
    used_obstacles = [
        [push_point.obstacle for push_point in report.push_points] for report in run.reports
    ]
    assert ["peg_0_1", "peg_0_2", "peg_0_3"] in used_obstacles


@pytest.mark.slow
def test_steep_wave_pushes_with_contacts_further_apart():
    run = run_controller(
        load_run_config("peg_row", "scene.route.amplitude_m=0.05"), duration_s=8.0
    )  # 34.9 degrees
    assert run.advance_m > 1.0
    assert set(run.states[STARTED_TICK:]) == {"Locomoting"}
    assert not any(report.jammed for report in run.reports)
    propulsion_joints = list_propulsion_joints(run)
    assert len(propulsion_joints) < 2 * run.advance_m / run.record.config.robot.module.length_m
    assert not run.record.host.limited_commands


# --- control experiments: runs that must not move --------------------------------------------------------------


@pytest.mark.slow
def test_triplet_with_two_newtons_does_not_move_and_reports_reason():
    run = run_controller(load_run_config("triplet", f"{TRIPLET}.propulsion_n=2"))
    assert abs(run.advance_m) < 0.02
    assert run.states[-1] == "NotLocomoting"
    assert "too little against the friction" in run.reasons[-1]
    assert not any(report.jammed for report in run.reports)


@pytest.mark.heavy
def test_push_report_contains_measured_not_requested_forces():
    """Of the 8 N, twice the drag of 3.9 N, a part is missing, because one push-point is not in contact."""
    run = run_controller(load_run_config("peg_row", f"{TRIPLET}.propulsion_n=8"), duration_s=5.0)
    assert run.states[-1] == "NotLocomoting"
    assert not any(report.jammed for report in run.reports)
    _, measured_part = run.reasons[-1].split("contacts push it on with ")
    measured_force_n, explanation = measured_part.split(" N ", 1)
    assert 1.0 <= float(measured_force_n) <= 3.9
    assert explanation.startswith("(no contact at peg_0_")
    assert "too little against the friction of the ground" in explanation


@pytest.mark.heavy
def test_body_clear_of_every_peg_is_not_jammed():
    thin_robot = (
        "robot.chain.modules=10",
        "robot.module.length_m=0.09",
        "robot.module.radius_m=0.025",
    )
    # With this reference robot, the pegs keep their positions and are not scaled to the thin robot.
    unscaled_pegs = "scene.reference_robot={spacing_m = 0.09, radius_m = 0.025}"
    run = run_controller(load_run_config("peg_row", *thin_robot, unscaled_pegs), duration_s=4.0)
    assert not any(report.jammed for report in run.reports)
    assert run.states[-1] == "NotLocomoting"
    assert "no obstacle touches the body" in run.reasons[-1]
    assert "has swung out" in run.reasons[-1]


# --- long rows, other bodies ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_triplet_travels_three_body_lengths_with_backward_hand_overs():
    run = run_controller(load_run_config("peg_row"))
    body_m = run.record.config.robot.length_m
    assert body_m >= 4.29 / 3
    assert run.advance_m >= 3 * body_m
    assert set(run.states[STARTED_TICK:]) == {"Locomoting"}
    positions_each_second_m = run.path_s_m[::100]
    assert np.diff(positions_each_second_m).min() > 0.05
    assert not any(report.jammed or report.saturated for report in run.reports)
    propulsion_joints = list_propulsion_joints(run)
    backward = sum(b == a - 1 for a, b in pairwise(propulsion_joints))
    forward = sum(b > a for a, b in pairwise(propulsion_joints))
    assert backward + forward == len(propulsion_joints) - 1
    assert backward > 1.5 * forward


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("modules", "min_advance_m"), [(8, 0.8), pytest.param(30, 0.5, marks=pytest.mark.slow)]
)
def test_any_number_of_modules_moves_with_the_same_code(modules, min_advance_m):
    run = run_controller(
        load_run_config("peg_row", f"robot.chain.modules={modules}"), duration_s=6.0
    )
    assert run.advance_m >= min_advance_m
    assert set(run.states[STARTED_TICK:]) == {"Locomoting"}
    assert not any(report.jammed for report in run.reports)


@pytest.mark.slow
def test_robot_with_pitch_joints_crosses_hills_among_pegs():
    run = run_controller(load_run_config("mamba_hills", "controller=obstacle_triplet"))
    assert run.advance_m >= 0.3
    axes = [joint.axis for joint in run.record.description.joints]
    assert {axes[joint] for joint in list_propulsion_joints(run)} == {"yaw"}


@pytest.mark.heavy
def test_path_following_moves_steadily_along_the_row():
    run = run_controller(load_run_config("peg_row", "controller=path_following"), duration_s=6.0)
    expected_advance_m = run.record.config.mission.speed_m_s * 6.0
    assert 0.7 * expected_advance_m < run.advance_m < 1.2 * expected_advance_m
    assert set(run.states[STARTED_TICK:]) == {"Locomoting"}


# --- jams -----------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_jam_is_reported_and_snake_stays():
    run = run_controller(load_run_config("jam"))
    jammed = np.array([report.jammed for report in run.reports])
    assert jammed[-1]
    jam_tick = int(np.argmax(jammed))
    assert run.path_s_m[jam_tick:].max() - run.path_s_m[jam_tick] < 0.1
    assert set(run.states[jam_tick:]) == {"NotLocomoting"}
    assert all(reason.startswith("jammed: standing still") for reason in run.reasons[jam_tick:])


@pytest.mark.heavy
def test_pegs_with_high_friction_are_reported_as_jam():
    run = run_controller(
        load_run_config("triplet", "scene.pegs_along_route.0.friction=1.0"), duration_s=4.0
    )
    assert run.advance_m < 0.15
    assert run.reports[-1].jammed


# --- clutter --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [10, 14])
def test_snake_advances_through_random_scene(seed: int):
    random_scene = (f"scene.random_field.0.seed={seed}", "scene.random_field.0.density_per_m2=12")
    run = run_controller(load_run_config("surveyed_clutter", *random_scene), duration_s=13.0)
    assert run.advance_m > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.0, -1.0])
def test_clutter_without_contact_search_moves_only_by_push(scale: float):
    """Neither replanned paths nor a push of the wrong sign move the snake forward."""
    random_scene = ("scene.random_field.0.seed=10", "scene.random_field.0.density_per_m2=12")
    push_alone = (f"control.push_scale={scale}", "control.search_after_s=0")
    run = run_controller(
        load_run_config("surveyed_clutter", *random_scene, *push_alone), duration_s=5.0
    )
    assert (
        len(run.record.trajectories) >= 2
    )  # the snake does not move, so that its path is replanned
    assert run.advance_m < 0.1  # with the shipped push: 1.16 m
