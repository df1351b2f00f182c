"""Tests that the simulated shape of each kind of obstacle is that of its outline."""

import numpy as np
import pytest

from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_hal.model.scenario import place_obstacles
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

KINDS = {
    "tall_peg": {"cylinder": [{"position_m": [3.0, 1.0], "radius_m": 0.1, "height_m": 0.4}]},
    "short_peg": {"cylinder": [{"position_m": [3.0, 1.0], "radius_m": 0.2, "height_m": 0.1}]},
    "box": {"box": [{"position_m": [3.0, 1.0], "size_m": [0.4, 0.2, 0.3], "yaw_rad": 0.5}]},
    "sphere": {"sphere": [{"position_m": [3.0, 1.0], "radius_m": 0.15, "center_height_m": 0.04}]},
    "wall": {"wall": [{"from_m": [2.5, 0.8], "to_m": [3.4, 1.3], "thickness_m": 0.06}]},
}


@pytest.mark.parametrize("scene", KINDS.values(), ids=KINDS.keys())
def test_obstacle_touches_body_exactly_at_its_outline(scene):
    """The rear cap of link 0, a sphere with the body's radius, approaches the center of the obstacle along a line."""
    config = make_config(scene=scene)
    run = SimulatorRig(config)
    data = run.sim.data
    (placed,) = place_obstacles(config)
    center_w = np.array(placed.obstacle.position_w[:2])
    radius_m = config.robot.module.radius_m
    distances_m = np.linspace(0.0, 1.0, 20001)[::20]  # from the center
    for angle_rad in np.arange(0.2, 2 * np.pi, 0.7):
        outward_w = np.array([np.cos(angle_rad), np.sin(angle_rad)])
        # The snake points away from the obstacle.
        data.qpos[3:7] = [np.cos(angle_rad / 2), 0, 0, np.sin(angle_rad / 2)]
        data.qpos[7:] = 0.0
        outline_distances_m = np.array(
            [
                compute_outline_distance_m(placed.obstacle, center_w + distance_m * outward_w)
                for distance_m in distances_m
            ]
        )
        touching_m = float(np.interp(radius_m, outline_distances_m, distances_m))
        for offset_m, expected_names in (
            (2e-5, set[str]()),
            (-2e-5, {placed.obstacle.name}),
        ):
            data.qpos[:3] = [*(center_w + (touching_m + offset_m) * outward_w), radius_m]
            run.sim.physics.forward()
            names = {contact.obstacle for contact in run.sim.true_state().contacts}
            assert names == expected_names


def test_contacts_exclude_steps_ground_and_the_snake_itself():
    step = {"step": [{"position_m": [0.7, 0.0], "size_m": [3.0, 2.0], "height_m": 0.05}]}
    run = SimulatorRig(make_config(scene=step))
    run.advance(0.2)
    assert run.sim.data.ncon > 0
    assert run.sim.true_state().contacts == []
    run.sim.data.qpos[7:] = 1.0
    run.sim.physics.forward()
    assert run.sim.true_state().contacts == []


def test_obstacle_may_have_the_name_of_a_link():
    pegs = [
        {"position_m": [2.0 + i, 1.0], "radius_m": 0.05, "name": name}
        for i, name in enumerate(["ground", "link_3"])
    ]
    run = SimulatorRig(make_config(scene={"cylinder": pegs}))
    assert [name for name in run.sim.sim.obstacle_of_geom if name] == ["ground", "link_3"]
