"""Shipped gaits advance on slopes, pipes, stairs and gaps, from starts at which the robot is at rest."""

import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate
from snakesim_testing.sim.gliding import GlidingSnake, glide_without_mujoco, make_tilted_gravity
from snakesim_testing.sim.simulator_rig import SimulatorRig

SCALES_FRICTION = DirectionalFriction(0.11, 0.14, 0.19)
SCALES = {"skin": {"forward": 0.11, "backward": 0.14, "sideways": 0.19}}


def run_scenario(scenario: str, seconds: float, *options: str) -> RunRecord:
    """Run a scenario to the end. The options are as `--set` takes them."""
    texts = (f"duration_s={seconds}", *options)
    result = simulate(load_scenario(scenario, [parse_set_option(text) for text in texts]).config)
    assert result.summary.ended == "complete"
    return result.record


def find_nodes_w(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return the tail end, joints and head end at the start and at the end, (nodes, 3) each."""
    rows = np.flatnonzero(record.has_pose)[[0, -1]]
    first, last = (record.find_body_points_w(int(row)) for row in rows)
    assert first is not None
    assert last is not None
    return first, last


@pytest.mark.parametrize("surface", ["flat ground", "step"])
@pytest.mark.parametrize(("slope_rad", "towards_rad"), [(0.1, 0.0), (0.1, 2.0), (0.3, -0.7)])
def test_body_glides_on_slope_as_independent_integrator_computes(
    surface: str, slope_rad: float, towards_rad: float
) -> None:
    """Friction stops the body on the slopes of 0.1 rad, and not on the steeper one."""
    glider = GlidingSnake(
        surface, SCALES, slope={"slope_rad": slope_rad, "slope_towards_rad": towards_rad}
    )
    velocity_m_s = np.array([1.0, 0.6])
    glider.throw(velocity_m_s)
    start_w = glider.position_w
    glider.go(1.0)
    expected_m = glide_without_mujoco(
        velocity_m_s, SCALES_FRICTION, 1.0, gravity_w=make_tilted_gravity(slope_rad, towards_rad)
    )
    tolerance_m = 0.01 * float(np.linalg.norm(expected_m))
    assert glider.position_w - start_w == pytest.approx(expected_m, abs=tolerance_m)


@pytest.mark.parametrize("scenario", ["pipe", "over_pipe", "stairs", "gaps"])
def test_robot_stays_at_rest_at_start_of_terrain_scenario(scenario: str) -> None:
    rig = SimulatorRig(load_scenario(scenario).config)
    start_w = rig.sim.true_state().base_position_w
    rig.command([JointMode.POSITION] * rig.count)
    rig.advance(1.0)
    final_state = rig.sim.true_state()
    assert np.linalg.norm(final_state.base_position_w - start_w) < 1e-3
    assert np.abs(final_state.velocities_rad_s).max() < 0.02


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_wave_towards_head_advances_in_pipe(seed: int) -> None:
    first, last = find_nodes_w(run_scenario("pipe", 5, f"seed={seed}"))
    assert (last - first).mean(axis=0)[0] > 0.2
    # All of the body is still inside the pipe.
    assert np.abs(last[:, 1]).max() < 0.1
    assert last[:, 2].max() < 0.21


@pytest.mark.slow
def test_wave_towards_tail_moves_body_backward_in_pipe() -> None:
    first, last = find_nodes_w(run_scenario("pipe", 5, "control.lag_rad=0.5"))
    assert (last - first).mean(axis=0)[0] < -0.2


@pytest.mark.heavy
def test_rectilinear_motion_advances_in_pipe() -> None:
    record = run_scenario("mamba_flat", 5, "scene=pipe", "controller=rectilinear")
    first, last = find_nodes_w(record)
    assert (last - first).mean(axis=0)[0] > 0.06


@pytest.mark.heavy
def test_rolling_arc_crosses_a_pipe() -> None:
    first, last = find_nodes_w(run_scenario("over_pipe", 10))
    # The pipe is 0.16 m wide at the height of the ground. The body starts before it, and ends behind it.
    assert first[:, 1].min() > -0.35 + 0.035
    assert last[:, 1].max() < -0.53 - 0.035


@pytest.mark.heavy
def test_helix_climbs_stairs() -> None:
    record = run_scenario("stairs", 10)
    first, last = find_nodes_w(record)
    (stairs,) = record.config.scene.stairs
    assert first[:, 2].max() < 0.05
    assert last[:, 1].min() > 0.3 + 3 * stairs.run_m  # all of the robot is on the landing
    assert last[:, 2].min() > stairs.count * stairs.rise_m


@pytest.mark.heavy
def test_stiff_robot_on_wheels_crosses_gaps() -> None:
    record = run_scenario("gaps", 7)
    first, last = find_nodes_w(record)
    (gaps,) = record.config.scene.gaps
    end_of_first_gap_m = gaps.position_m[0] + gaps.platform_m + gaps.gap_m
    assert first[:, 2].min() > gaps.depth_m
    assert last[:, 0].min() > end_of_first_gap_m
    assert last[:, 2].min() > gaps.depth_m  # the robot is on top again


@pytest.mark.slow
def test_robot_falls_into_gap_that_is_too_wide() -> None:
    _, last = find_nodes_w(run_scenario("gaps", 7, "scene.gaps.0.gap_m=0.7"))
    assert last[:, 2].min() < 0.1
