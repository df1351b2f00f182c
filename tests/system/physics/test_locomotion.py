"""Whole runs of the shipped scenarios in one process, with noise, limiter and lockstep: where the snake gets."""

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
STARTED = 50  # ticks until the body has moved far enough to be seen moving
FADE_MAX = 0.2  # period / blend_s + speed * period / blend_m at 0.9 m/s


@cache
def triplet(*sets: str) -> RecordedTicks:
    """The case study, as shipped or changed; several tests look at the same run."""
    return run_controller(load_run_config("triplet", *sets))


def propelled(whole: RecordedTicks) -> list[int]:
    return [turn for turn in whole.propulsion_joints if turn is not None]


# --- the case study -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "noise", [(), *(pytest.param((seed,), marks=pytest.mark.slow) for seed in ("seed=2", "seed=3"))]
)
def test_triplet_with_35_newtons_moves_half_a_meter(noise: tuple[str, ...]):
    whole = triplet(*noise)
    assert whole.record.time_s[-1] <= 10.0
    assert whole.advance_m >= 0.5
    turns = propelled(whole)
    assert len(turns) >= 4
    assert turns == [turns[0] - k for k in range(len(turns))]


def test_it_ends_when_the_obstacle_at_the_tail_is_lost():
    whole = triplet()
    assert [state for state, _ in groupby(whole.states)] == [
        "NotLocomoting",
        "Locomoting",
        "NotLocomoting",
    ]
    assert whole.reasons[0].startswith("standing still")
    assert whole.states[50] == "Locomoting"
    assert "2 usable push-points, 3 are needed" in whole.reasons[-1]


@pytest.mark.parametrize("what", ["blind", pytest.param("lost", marks=pytest.mark.slow)])
def test_locomotion_without_world_or_trajectory_stops_then_continues(what: str):
    gap = range(200, 400)
    blind, lost = (gap, ()) if what == "blind" else ((), gap)
    whole = run_controller(
        load_run_config("triplet"),
        duration_s=8.0,
        ticks_without_world=blind,
        ticks_without_trajectory=lost,
    )
    where, pushes = whole.path_s_m, (whole.record.mode == JointMode.TORQUE).any(axis=1)
    assert pushes[150:200].all()
    assert not pushes[gap.start + 2 : gap.stop].any()
    assert pushes[450:500].all()
    assert np.ptp(where[250:400]) < 0.01
    assert where[500] - where[400] > 0.05
    held = np.abs(whole.record.torque_nm[280:400]).max(axis=1)
    assert held.max() < 0.5 * np.abs(whole.record.torque_nm[150:200]).max()
    steps = np.abs(np.diff(whole.record.target, axis=0))[190:460]
    angles = (whole.record.mode[1:] == JointMode.POSITION)[190:460] & (
        whole.record.mode[:-1] == JointMode.POSITION
    )[190:460]
    assert steps[angles].max() < 0.03  # rad; the limiter would allow 0.075
    assert set(whole.states[gap.start + 2 : gap.stop]) <= {"NotLocomoting", "Idle"}


def test_triplet_has_one_torque_joint_and_others_in_position():
    whole = triplet()
    pushing = np.array([report.propulsion_joint is not None for report in whole.reports])
    torque_joints = (whole.record.mode == JointMode.TORQUE).sum(axis=1)
    # Periods from a controller's word to its deed.
    lag = whole.record.config.services["control"].latency_ticks - 1
    assert (torque_joints[lag + 1 :] == pushing[1 : len(pushing) - lag]).all()
    assert np.isin(whole.record.mode, [JointMode.TORQUE, JointMode.POSITION]).all()


def test_triplet_only_propulsion_joint_leaves_its_reference():
    """As in the paper's Figure 12."""
    whole = triplet()
    off = np.abs(
        whole.record.angle_rad - np.array([report.reference_rad for report in whole.reports])
    )
    torque = whole.record.mode == JointMode.TORQUE
    assert 0.1 < off[torque].max() < 0.7
    settled = np.array(
        [
            whole.record.mode[max(i - 40, 0) : i + 1].max(axis=0) == JointMode.POSITION
            for i in range(len(off))
        ]
    )
    assert np.median(off[settled]) < 0.02


def test_triplet_case_study_commands_are_smooth_and_never_limited():
    whole = triplet()
    assert not any(report.saturated for report in whole.reports)
    assert not whole.record.host.limited_commands
    assert np.abs(whole.record.torque_nm).max() < whole.record.config.robot.limits.torque_nm
    headroom = [r.torque_headroom_nm for r in whole.reports if r.torque_headroom_nm is not None]
    assert min(headroom) > 0
    steps = np.abs(np.diff(whole.record.target, axis=0))
    same = np.diff(whole.record.mode, axis=0) == 0
    limits = whole.record.config.robot.limits
    assert (
        steps[same & (whole.record.mode[1:] == JointMode.TORQUE)].max()
        < limits.torque_rate_nm_s * 0.01
    )
    assert (
        steps[same & (whole.record.mode[1:] == JointMode.POSITION)].max()
        < 0.6 * limits.speed_rad_s * 0.01
    )


def test_no_command_jumps_at_a_hand_over():
    """In the tick of a change of mode the applied target is within the stated bound of what would change nothing."""
    whole, record = triplet(), triplet().record
    switches = 0
    for i, j in zip(*np.nonzero(np.diff(record.mode, axis=0)), strict=True):
        tick, mode = i + 1, JointMode(int(record.mode[i + 1, j]))
        angle, speed, torque = (
            float(x[tick, j]) for x in (record.angle_rad, record.velocity_rad_s, record.torque_nm)
        )
        steady = compute_bumpless_target(record.description.joints[j], mode, angle, speed, torque)
        report = whole.reports[tick]
        if mode == JointMode.POSITION:
            way = abs(steady - report.reference_rad[j])
        else:
            full_nm = record.description.joints[j].torque_limit_nm - require_value(
                report.torque_headroom_nm
            )
            way = full_nm + 0.5 * abs(speed) + abs(torque)
        assert abs(record.target[tick, j] - steady) <= FADE_MAX * way + 1e-9
        switches += 1
    assert switches >= 8


# --- triplets that are not neighbors -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("clearance_m", [pytest.param(0.02, marks=pytest.mark.slow), 0.05])
def test_braking_obstacles_between_push_points_do_not_stop_pushing(clearance_m: float):
    config = load_run_config("triplet")
    route = require_value(make_route(config.scene))
    way_m = 0.04 + clearance_m + 0.05
    behind, middle, ahead = route.find_inflections_s_m()[1:4]
    places = (0.3 * behind + 0.7 * middle, 0.7 * middle + 0.3 * ahead, 0.4 * middle + 0.6 * ahead)
    pegs: list[Cylinder] = []
    for s, side in zip(places, (1, 1, -1), strict=True):
        (x, y), (along_x, along_y) = route.compute_point(s), route.tangent_w(s).tolist()
        pegs.append(
            Cylinder(
                position_m=(x - side * along_y * way_m, y + side * along_x * way_m), radius_m=0.05
            )
        )
    scene = msgspec.structs.replace(config.scene, cylinder=pegs)
    whole = run_controller(msgspec.structs.replace(config, scene=scene), duration_s=8.0)
    assert whole.advance_m > 0.5
    assert ["peg_0_1", "peg_0_2", "peg_0_3"] in [
        [p.obstacle for p in report.push_points] for report in whole.reports
    ]


@pytest.mark.slow
def test_steep_wave_pushes_with_contacts_further_apart():
    whole = run_controller(
        load_run_config("peg_row", "scene.route.amplitude_m=0.05"), duration_s=8.0
    )  # 34.9 degrees
    assert whole.advance_m > 1.0
    assert set(whole.states[STARTED:]) == {"Locomoting"}
    assert not any(report.jammed for report in whole.reports)
    turns = propelled(whole)
    assert len(turns) < 2 * whole.advance_m / whole.record.config.robot.module.length_m
    assert not whole.record.host.limited_commands


# --- the controls: what must not move -------------------------------------------------------------------------


@pytest.mark.slow
def test_two_newtons_are_too_little_and_said_to_be():
    whole = run_controller(load_run_config("triplet", f"{TRIPLET}.propulsion_n=2"))
    assert abs(whole.advance_m) < 0.02
    assert whole.states[-1] == "NotLocomoting"
    assert "too little against the friction" in whole.reasons[-1]
    assert not any(report.jammed for report in whole.reports)


def test_push_report_contains_measured_not_requested_forces():
    """Of 8 N, twice the drag of 3.9 N: a push-point that is not touched keeps a part away."""
    whole = run_controller(load_run_config("peg_row", f"{TRIPLET}.propulsion_n=8"), duration_s=5.0)
    assert whole.states[-1] == "NotLocomoting"
    assert not any(report.jammed for report in whole.reports)
    carried, missing = whole.reasons[-1].split("contacts push it on with ")[1].split(" N ", 1)
    assert 1.0 <= float(carried) <= 3.9
    assert missing.startswith("(no contact at peg_0_")
    assert "too little against the friction of the ground" in missing


def test_body_clear_of_every_peg_is_not_jammed():
    thin = ("robot.chain.modules=10", "robot.module.length_m=0.09", "robot.module.radius_m=0.025")
    # As it is, not in proportion.
    row = "scene.reference_robot={spacing_m = 0.09, radius_m = 0.025}"
    whole = run_controller(load_run_config("peg_row", *thin, row), duration_s=4.0)
    assert not any(report.jammed for report in whole.reports)
    assert whole.states[-1] == "NotLocomoting"
    assert "no obstacle touches the body" in whole.reasons[-1]
    assert "has swung out" in whole.reasons[-1]


# --- long rows, other bodies ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_triplet_travels_three_body_lengths_with_backward_hand_overs():
    whole = run_controller(load_run_config("peg_row"))
    body_m = whole.record.config.robot.length_m
    assert whole.advance_m >= 3 * body_m >= 4.29
    assert set(whole.states[STARTED:]) == {"Locomoting"}
    every_second = whole.path_s_m[::100]
    assert np.diff(every_second).min() > 0.05
    assert not any(report.jammed or report.saturated for report in whole.reports)
    turns = propelled(whole)
    backward = sum(b == a - 1 for a, b in pairwise(turns))
    forward = sum(b > a for a, b in pairwise(turns))
    assert backward + forward == len(turns) - 1
    assert backward > 1.5 * forward


@pytest.mark.parametrize(
    ("modules", "min_advance_m"), [(8, 0.8), pytest.param(30, 0.5, marks=pytest.mark.slow)]
)
def test_any_number_of_modules_moves_with_the_same_code(modules, min_advance_m):
    whole = run_controller(
        load_run_config("peg_row", f"robot.chain.modules={modules}"), duration_s=6.0
    )
    assert whole.advance_m >= min_advance_m
    assert set(whole.states[STARTED:]) == {"Locomoting"}
    assert not any(report.jammed for report in whole.reports)


@pytest.mark.slow
def test_robot_with_pitch_joints_crosses_hills_among_pegs():
    whole = run_controller(load_run_config("mamba_hills", "controller=obstacle_triplet"))
    assert whole.advance_m >= 0.3
    axes = [joint.axis for joint in whole.record.description.joints]
    assert {axes[turn] for turn in propelled(whole)} == {"yaw"}


def test_path_following_moves_steadily_along_the_row():
    whole = run_controller(load_run_config("peg_row", "controller=path_following"), duration_s=6.0)
    wanted = whole.record.config.mission.speed_m_s * 6.0
    assert 0.7 * wanted < whole.advance_m < 1.2 * wanted
    assert set(whole.states[STARTED:]) == {"Locomoting"}


# --- jams -----------------------------------------------------------------------------------------------------


def test_a_jam_is_reported_as_one():
    whole = run_controller(load_run_config("jam"))
    jammed = np.array([report.jammed for report in whole.reports])
    assert jammed[-1]
    start = int(np.argmax(jammed))
    assert whole.path_s_m[start:].max() - whole.path_s_m[start] < 0.1
    assert set(whole.states[start:]) == {"NotLocomoting"}
    assert all(reason.startswith("jammed: standing still") for reason in whole.reasons[start:])


def test_pegs_that_grip_are_a_jam_too():
    whole = run_controller(
        load_run_config("triplet", "scene.pegs_along_route.0.friction=1.0"), duration_s=4.0
    )
    assert whole.advance_m < 0.15
    assert whole.reports[-1].jammed


# --- clutter --------------------------------------------------------------------------------------------------


@pytest.mark.slow  # a field that is surveyed is crossed below
@pytest.mark.parametrize("seed", [10, 14])
def test_it_goes_through_a_random_field_that_nobody_laid_out(seed: int):
    field = (f"scene.random_field.0.seed={seed}", "scene.random_field.0.density_per_m2=12")
    whole = run_controller(load_run_config("surveyed_clutter", *field), duration_s=13.0)
    assert whole.advance_m > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.0, -1.0])
def test_clutter_without_contact_search_moves_only_by_push(scale: float):
    """Neither the paths that are replanned, since it stands, nor a push of the wrong sign, which only shifts it."""
    field = ("scene.random_field.0.seed=10", "scene.random_field.0.density_per_m2=12")
    alone = (f"control.push_scale={scale}", "control.search_after_s=0")
    whole = run_controller(load_run_config("surveyed_clutter", *field, *alone), duration_s=5.0)
    assert len(whole.record.trajectories) >= 2
    assert whole.advance_m < 0.1  # pushed as shipped: 1.16 m
