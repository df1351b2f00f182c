"""The scene of the console draws contact forces and the obstacles that guidance perceives."""

import pytest

from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import M_PER_N, draw
from snakesim_operator.features.console.scene.robot_scene import RobotScene
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.operator.drawn_samples import (
    make_contact,
    make_control_state,
    make_joints,
    make_world_model,
)
from snakesim_testing.operator.served_console import running_console


def test_scene_desired_force_without_contact_is_dashed():
    point = make_contact((0.0, 10.0, 0.0))
    control = make_control_state([point], [10.0])
    with running_console() as (server, _):
        scene = RobotScene(server.scene, make_description(), None)
        for contacts in ([], [point], []):
            snapshot = RobotSnapshot(
                robot=make_description(),
                body=make_joints(),
                world=make_world_model(contacts, []),
                control=control,
            )
            drawing = draw(snapshot, None)
            assert drawing is not None
            scene.update_nodes(drawing)
            desired = scene._arrows.get("forces/desired")
            assert scene._dashed_forces.visible is not bool(contacts)
            assert (desired is not None and desired.visible) is bool(contacts)
        dash_ends = scene._dashed_forces.points.reshape(-1, 3)
        assert len(dash_ends) == 10
        assert dash_ends[-1] - dash_ends[0] == pytest.approx([0.0, 10 * M_PER_N, 0.0], abs=1e-6)


def test_scene_perceived_shapes_are_drawn_until_forgotten():
    perceived = [
        KnownObstacle(
            name="a", shape="sphere", position_w=(1.0, 0.0, 0.0), radius_m=0.1, touched=True
        ),
        KnownObstacle(
            name="b",
            shape="cylinder",
            position_w=(2.0, 0.0, 0.0),
            radius_m=0.1,
            height_m=0.2,
            touched=True,
        ),
        KnownObstacle(
            name="c",
            shape="box",
            position_w=(3.0, 0.0, 0.0),
            half_size_m=(0.1, 0.2, 0.3),
            touched=True,
        ),
    ]
    with running_console() as (server, _):
        scene = RobotScene(server.scene, make_description(), None)
        for obstacles in (perceived, []):
            drawing = draw(
                RobotSnapshot(
                    robot=make_description(),
                    body=make_joints(),
                    world=make_world_model([], obstacles),
                ),
                None,
            )
            assert drawing is not None
            scene.update_nodes(drawing)
            batches = list(scene._perceived_obstacles.meshes.batches.values())
            assert [batch.visible for batch in batches] == [bool(obstacles)] * 3
            assert sorted(float(batch.batched_positions[0, 0]) for batch in batches) == [
                1.0,
                2.0,
                3.0,
            ]
