"""Body points of many poses at once are bit-identical to those of each pose alone."""

import numpy as np
import pytest

from snakesim_hal.model.geometry.kinematics import ForwardKinematics, compute_body_points_w
from snakesim_hal.model.scenario import describe_run_robot, load_scenario

ROUNDS = 50


@pytest.mark.parametrize("scenario", ["peg_row", "mamba_flat"])
@pytest.mark.parametrize("pose_count", [1, 2, 50])
def test_body_points_of_many_poses_equal_those_of_each(scenario: str, pose_count: int) -> None:
    robot = describe_run_robot(load_scenario(scenario).config)
    random = np.random.default_rng(1)
    kinematics = ForwardKinematics(robot)
    for _ in range(ROUNDS // pose_count):
        positions_w = random.normal(size=(pose_count, 3))
        wxyz = random.normal(size=(pose_count, 4))
        angles_rad = random.normal(size=(pose_count, len(robot.joints)))
        nodes_w = kinematics.compute_body_points_w(positions_w, wxyz, angles_rad)
        for i in range(pose_count):
            alone_w = compute_body_points_w(robot, positions_w[i], wxyz[i], angles_rad[i].tolist())
            assert nodes_w[i].tobytes() == alone_w.tobytes()
