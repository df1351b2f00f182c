"""Shipped gaits on pipes, stairs and gaps, from starts at which the robot has settled."""

import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate
from snakesim_testing.sim.gliding import GlidingSnake, glide_without_mujoco, make_tilted_gravity
from snakesim_testing.sim.simulator_rig import SimulatorRig

HU = DirectionalFriction(0.11, 0.14, 0.19)
SCALES = {"skin": {"forward": 0.11, "backward": 0.14, "sideways": 0.19}}


def run_scenario(scenario: str, seconds: float, *sets: str) -> RunRecord:
    texts = (f"duration_s={seconds}", *sets)
    done = simulate(load_scenario(scenario, [parse_set_option(text) for text in texts]).config)
    assert done.summary.ended == "complete"
    return done.record


def find_nodes_w(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return the tail end, joints and head end at the start and at the end, (nodes, 3) each."""
    rows = np.flatnonzero(record.has_pose)[[0, -1]]
    first, last = (record.find_body_points_w(int(row)) for row in rows)
    assert first is not None
    assert last is not None
    return first, last


@pytest.mark.parametrize("surface", ["flat ground", "step"])
@pytest.mark.parametrize(("slope_rad", "towards_rad"), [(0.1, 0.0), (0.1, 2.0), (0.3, -0.7)])
def test_body_glides_on_a_slope_as_an_independent_integrator_says(
    surface: str, slope_rad: float, towards_rad: float
) -> None:
    """Friction holds the body on the slopes of 0.1 rad, and not on the third one."""
    glider = GlidingSnake(
        surface, SCALES, slope={"slope_rad": slope_rad, "slope_towards_rad": towards_rad}
    )
    velocity_m_s = np.array([1.0, 0.6])
    glider.throw(velocity_m_s)
    start = glider.position_w
    glider.go(1.0)
    expected_m = glide_without_mujoco(
        velocity_m_s, HU, 1.0, gravity_w=make_tilted_gravity(slope_rad, towards_rad)
    )
    assert glider.position_w - start == pytest.approx(
        expected_m, abs=0.01 * float(np.linalg.norm(expected_m))
    )


@pytest.mark.parametrize("scenario", ["pipe", "over_pipe", "stairs", "gaps"])
def test_robot_is_at_rest_at_its_start(scenario: str) -> None:
    run = SimulatorRig(load_scenario(scenario).config)
    before_w = run.sim.true_state().base_position_w
    run.command([JointMode.POSITION] * run.count)
    run.advance(1.0)
    after = run.sim.true_state()
    assert np.linalg.norm(after.base_position_w - before_w) < 1e-3
    assert np.abs(after.velocities_rad_s).max() < 0.02


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_wave_towards_the_head_advances_in_a_pipe(seed: int) -> None:
    first, last = find_nodes_w(run_scenario("pipe", 5, f"seed={seed}"))
    assert (last - first).mean(axis=0)[0] > 0.2
    assert np.abs(last[:, 1]).max() < 0.1  # the inside
    assert last[:, 2].max() < 0.21


@pytest.mark.slow
def test_wave_towards_the_tail_drives_the_body_backward_in_a_pipe() -> None:
    first, last = find_nodes_w(run_scenario("pipe", 5, "control.lag_rad=0.5"))
    assert (last - first).mean(axis=0)[0] < -0.2


def test_rectilinear_motion_advances_in_a_pipe() -> None:
    record = run_scenario("mamba_flat", 5, "scene=pipe", "controller=rectilinear")
    first, last = find_nodes_w(record)
    assert (last - first).mean(axis=0)[0] > 0.06


def test_arc_rolls_over_a_pipe() -> None:
    first, last = find_nodes_w(run_scenario("over_pipe", 10))
    # Before the pipe, which is 0.16 m wide at the height of the ground.
    assert first[:, 1].min() > -0.35 + 0.035
    assert last[:, 1].max() < -0.53 - 0.035  # and behind it


def test_helix_climbs_stairs() -> None:
    record = run_scenario("stairs", 10)
    first, last = find_nodes_w(record)
    (stairs,) = record.config.scene.stairs
    assert first[:, 2].max() < 0.05
    assert last[:, 1].min() > 0.3 + 3 * stairs.run_m  # all of the robot is on the landing
    assert last[:, 2].min() > stairs.count * stairs.rise_m


def test_wheels_carry_a_stiff_robot_across_gaps() -> None:
    record = run_scenario("gaps", 7)
    first, last = find_nodes_w(record)
    (row,) = record.config.scene.gaps
    end_of_first_gap_m = row.position_m[0] + row.platform_m + row.gap_m
    assert first[:, 2].min() > row.depth_m
    assert last[:, 0].min() > end_of_first_gap_m
    assert last[:, 2].min() > row.depth_m  # it is on top again


@pytest.mark.slow
def test_robot_falls_into_a_gap_that_is_too_wide() -> None:
    _, last = find_nodes_w(run_scenario("gaps", 7, "scene.gaps.0.gap_m=0.7"))
    assert last[:, 2].min() < 0.1
