"""Tests the pose of the snake at the start of a run: on flat and uneven ground, on a step, and with pitch joints."""

import mujoco
import numpy as np
import pytest

from snakesim_hal.model.geometry.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_hal.model.scenario import compute_start_pose, load_scenario
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.laws.flat_ground import SINK_M
from snakesim_sim_backend.model.ground import make_heights
from snakesim_testing.sim.hilly_start import CURVE, HILLS
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config


def get_heightfield(config):
    assert config.scene.ground.heightfield is not None
    return config.scene.ground.heightfield


def measure_penetration_m(run):
    """Return how far the snake is inside the ground or an obstacle."""
    return max(0.0, -min(run.sim.data.contact.dist, default=0.0))


def assert_stays(run, seconds=1.0, max_distance_m=2e-3):
    """Check that a snake that holds its start angles does not move any more."""
    start = run.sim.true_state()
    start_angles_rad = compute_start_pose(run.config).angles_rad.tolist()
    run.command([JointMode.POSITION] * run.count, start_angles_rad)
    run.advance(seconds)
    end = run.sim.true_state()
    assert np.linalg.norm(end.base_position_w - start.base_position_w) < max_distance_m
    assert np.abs(end.velocities_rad_s).max() < 0.02


def test_start_on_flat_ground_is_at_rest_at_time_zero():
    config = load_scenario("triplet").config
    run = SimulatorRig(config)
    state = run.sim.true_state()
    pose = compute_start_pose(config)
    assert state.time_s == 0.0
    assert state.base_position_w == pytest.approx(
        [*pose.position_w, config.robot.module.radius_m], abs=1.1 * SINK_M
    )
    assert state.angles_rad == pytest.approx(pose.angles_rad, abs=1e-3)
    assert not state.base_velocity_w.any()
    assert not state.velocities_rad_s.any()
    assert not state.torques_nm.any()
    assert_stays(run)


def test_start_hills_have_requested_height_and_repeat_for_seed():
    heightfield = get_heightfield(make_config(scene=HILLS))
    heights_m = make_heights(heightfield)
    assert (heights_m.min(), heights_m.max()) == pytest.approx((-0.03, 0.03))
    assert np.array_equal(heights_m, make_heights(heightfield))

    spacing_m = heightfield.area_m / (len(heights_m) - 1)
    max_slope = np.abs(np.diff(heights_m, axis=0)).max() / spacing_m
    assert max_slope < 2 * np.pi * heightfield.height_m / heightfield.wavelength_m

    signs = np.sign(heights_m - heights_m.mean())
    mean_crossings = np.abs(np.diff(signs, axis=1)).sum(axis=1).mean() / 2
    expected_crossings = 2 * heightfield.area_m / heightfield.wavelength_m
    assert mean_crossings == pytest.approx(expected_crossings, rel=0.5)


def test_start_height_field_of_model_equals_the_heights():
    config = make_config(scene=HILLS)
    run = SimulatorRig(config, settle_s=0.0)
    heights_m = make_heights(get_heightfield(config))
    grid_m = np.linspace(-3.0, 3.0, len(heights_m))
    ray_height_m = 5.0
    down_w = np.array([0.0, 0.0, -1.0])
    hit_geom = np.zeros(1, dtype=np.int32)
    for i, j in ((5, 80), (60, 12), (33, 40)):
        above_w = np.array([grid_m[j], grid_m[i], ray_height_m])
        distance_m = mujoco.mj_ray(
            run.sim.sim.model, run.sim.data, above_w, down_w, None, 1, -1, hit_geom
        )
        assert ray_height_m - distance_m == pytest.approx(heights_m[i, j], abs=2e-3)


@pytest.mark.parametrize("robot", ["planar13", "mamba"])
def test_start_on_uneven_ground_is_at_rest_where_placed(robot):
    run = SimulatorRig(
        make_config(scene={**HILLS, **CURVE}, base_robot=robot, start={"on_route": True})
    )
    assert measure_penetration_m(run) < 2e-3
    state = run.sim.true_state()
    pose = compute_start_pose(run.config)
    assert state.base_position_w[:2] == pytest.approx(pose.position_w, abs=0.05)
    assert not state.velocities_rad_s.any()
    assert_stays(run, max_distance_m=0.01)
    assert measure_penetration_m(run) < 2e-3


def test_start_half_on_a_step_does_not_sink_in():
    step = {"step": [{"position_m": [1.2, 0.0], "size_m": [1.2, 1.0], "height_m": 0.06}]}
    run = SimulatorRig(
        make_config(scene={**step, **CURVE}, base_robot="mamba", start={"on_route": True})
    )
    assert_stays(run, max_distance_m=0.01)
    assert measure_penetration_m(run) < 2e-3
    state = run.sim.true_state()
    robot = run.config.robot
    origins_w, _ = compute_link_frames(
        state.base_position_w,
        rotation_from_quaternion(state.base_orientation_wxyz),
        state.angles_rad,
        robot.axes,
        robot.link_lengths_m,
    )
    height_on_step_m = 0.06 + robot.module.radius_m
    assert origins_w[-1][2] == pytest.approx(height_on_step_m, abs=0.005)
    assert origins_w[1][2] < height_on_step_m


def test_start_of_alternating_axes_is_stable_passive_and_held():
    run = SimulatorRig(make_config(base_robot="mamba"))
    run.advance(1.0)
    state = run.sim.true_state()
    assert state.angles_rad == pytest.approx([0.0] * 18, abs=0.01)
    assert np.abs(state.velocities_rad_s).max() < 1e-2
    assert_stays(run)


def test_start_of_long_and_short_robot_is_on_the_ground():
    for modules in (1, 40):
        run = SimulatorRig(make_config({"chain": {"modules": modules}}))
        run.advance(0.05)
        assert run.sim.true_state().base_position_w[2] == pytest.approx(0.04, abs=1e-3)
