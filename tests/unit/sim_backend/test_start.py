"""How the snake lies when the run begins: on flat and uneven ground, on a step, and with pitch joints."""

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


def uneven_of(config):
    assert config.scene.ground.heightfield is not None
    return config.scene.ground.heightfield


def deepest_m(run):
    """How far the snake is inside anything."""
    return max(0.0, -min(run.sim.data.contact.dist, default=0.0))


def stays(run, seconds=1.0, within_m=2e-3):
    """Holding the angles of its start, the snake does not move any more."""
    start = run.sim.true_state()
    run.command(
        [JointMode.POSITION] * run.count, compute_start_pose(run.config).angles_rad.tolist()
    )
    run.advance(seconds)
    end = run.sim.true_state()
    assert np.linalg.norm(end.base_position_w - start.base_position_w) < within_m
    assert np.abs(end.velocities_rad_s).max() < 0.02


def test_start_on_flat_ground_is_at_rest_at_time_zero():
    config = load_scenario("triplet").config
    run = SimulatorRig(config)
    state, pose = run.sim.true_state(), compute_start_pose(config)
    assert state.time_s == 0.0
    assert state.base_position_w == pytest.approx(
        [*pose.position_w, config.robot.module.radius_m], abs=1.1 * SINK_M
    )
    assert state.angles_rad == pytest.approx(pose.angles_rad, abs=1e-3)
    assert not state.base_velocity_w.any()
    assert not state.velocities_rad_s.any()
    assert not state.torques_nm.any()
    stays(run)


def test_start_hills_have_requested_height_and_repeat_for_seed():
    uneven = uneven_of(make_config(scene=HILLS))
    heights = make_heights(uneven)
    assert (heights.min(), heights.max()) == pytest.approx((-0.03, 0.03))
    assert np.array_equal(heights, make_heights(uneven))
    spacing = uneven.area_m / (len(heights) - 1)
    assert (
        np.abs(np.diff(heights, axis=0)).max() / spacing
        < 2 * np.pi * uneven.height_m / uneven.wavelength_m
    )
    up_and_down = np.abs(np.diff(np.sign(heights - heights.mean()), axis=1)).sum(axis=1).mean() / 2
    assert up_and_down == pytest.approx(2 * uneven.area_m / uneven.wavelength_m, rel=0.5)


def test_the_height_field_is_where_the_heights_say():
    config = make_config(scene=HILLS)
    run = SimulatorRig(config, settle_s=0.0)
    heights = make_heights(uneven_of(config))
    grid = np.linspace(-3.0, 3.0, len(heights))
    hit = np.zeros(1, dtype=np.int32)
    for i, j in ((5, 80), (60, 12), (33, 40)):
        above = np.array([grid[j], grid[i], 5.0])
        drop = mujoco.mj_ray(
            run.sim.sim.model, run.sim.data, above, np.array([0.0, 0.0, -1.0]), None, 1, -1, hit
        )
        assert 5.0 - drop == pytest.approx(heights[i, j], abs=2e-3)


@pytest.mark.parametrize("robot", ["planar13", "mamba"])
def test_on_uneven_ground_it_rests_where_it_was_put(robot):
    run = SimulatorRig(
        make_config(scene={**HILLS, **CURVE}, base_robot=robot, start={"on_route": True})
    )
    assert deepest_m(run) < 2e-3
    state, pose = run.sim.true_state(), compute_start_pose(run.config)
    assert state.base_position_w[:2] == pytest.approx(pose.position_w, abs=0.05)
    assert not state.velocities_rad_s.any()
    stays(run, within_m=0.01)
    assert deepest_m(run) < 2e-3


def test_start_half_on_a_step_does_not_sink_in():
    step = {"step": [{"position_m": [1.2, 0.0], "size_m": [1.2, 1.0], "height_m": 0.06}]}
    run = SimulatorRig(
        make_config(scene={**step, **CURVE}, base_robot="mamba", start={"on_route": True})
    )
    stays(run, within_m=0.01)
    assert deepest_m(run) < 2e-3
    state, robot = run.sim.true_state(), run.config.robot
    origins, _ = compute_link_frames(
        state.base_position_w,
        rotation_from_quaternion(state.base_orientation_wxyz),
        state.angles_rad,
        robot.axes,
        robot.link_lengths_m,
    )
    assert origins[-1][2] == pytest.approx(0.06 + robot.module.radius_m, abs=0.005)
    assert origins[1][2] < 0.06 + robot.module.radius_m


def test_alternating_axes_lie_stably_passive_and_held():
    run = SimulatorRig(make_config(base_robot="mamba"))
    run.advance(1.0)
    state = run.sim.true_state()
    assert state.angles_rad == pytest.approx([0.0] * 18, abs=0.01)
    assert np.abs(state.velocities_rad_s).max() < 1e-2
    stays(run)


def test_a_long_and_a_short_robot_start_too():
    for modules in (1, 40):
        run = SimulatorRig(make_config({"chain": {"modules": modules}}))
        run.advance(0.05)
        assert run.sim.true_state().base_position_w[2] == pytest.approx(0.04, abs=1e-3)
