"""Forces between links and obstacles that the C laws write into the state, against those that Python reads."""

from typing import Any

import numpy as np
import pytest

from snakesim_hal.wire.messages import Mode
from snakesim_sim_backend.batch.placed import place
from snakesim_sim_backend.laws.version import choose_laws
from snakesim_testing.sim.simulator_rig import make_config

STEPS = 300
PEGS = [
    {"name": f"peg{i}", "position_m": [0.25 * i - 0.1, 0.1 * (-1) ** i], "radius_m": 0.05, "friction": 0.2 * (i % 2)}
    for i in range(4)
]
POST = {"name": "post", "position_m": [0.5, 0.095], "size_m": [0.1, 0.1, 0.2], "stiffness_n_per_m": 300.0}
SCENES: dict[str, dict[str, Any]] = {
    "rough and smooth pegs": {"ground": {"friction": 0.1}, "cylinder": PEGS},
    "an obstacle that yields": {"ground": {"friction": 0.1}, "cylinder": PEGS[:2], "box": [POST]},
}


@pytest.mark.skipif(choose_laws() == "python", reason="there is no C version of the laws here")
@pytest.mark.parametrize("name", SCENES)
def test_the_state_has_the_forces_that_python_reads(name: str) -> None:
    placed = place(make_config(scene={"name": "test", **SCENES[name]}))
    random = np.random.default_rng(1)
    joints = placed.motors.count
    limits_nm = [joint.limits.torque_nm for joint in placed.config.robot.joint_table]
    touched = 0
    for step in range(STEPS):
        if step % 30 == 0:
            placed.motors.drive([Mode.POSITION] * joints, random.uniform(-1.2, 1.2, joints).tolist(), limits_nm)
        placed.physics.step(1)
        expected = [[touch.link, *touch.force_w] for touch in placed.touches.read()]
        assert placed.read_touches() == expected
        touched += len(expected)
    assert touched > 20
