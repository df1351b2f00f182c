"""Compares the sparse with the dense factorization in the Newton solver of the installed MuJoCo version."""

from typing import Literal

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats

BODIES = 4
ARM_LINKS = 4
DEGREES_OF_FREEDOM = 56  # 4 * (6 + 2 * 4)
ARM_LINK = """
<body pos="0.1 {y} 0">
  <joint axis="0 0 1" damping="0.01"/>
  <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.045"/>
"""


def compute_accelerations(jacobian: Literal["dense", "sparse"]) -> Floats:
    """Compute the accelerations (56,) of bodies with two arms each, which lie on the ground and on each other."""
    bodies = ""
    for number in range(BODIES):
        arms = "".join(
            ARM_LINK.format(y=side) + ARM_LINK.format(y=0) * (ARM_LINKS - 1) + "</body>" * ARM_LINKS
            for side in (-0.1, 0.1)
        )
        bodies += (
            f'<body pos="{0.08 * number} 0 0.045"><freejoint/>'
            f'<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.05"/>{arms}</body>'
        )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option solver="Newton" jacobian="{jacobian}" tolerance="1e-10"><flag island="disable"/></option>'
        f'<worldbody><geom type="plane" size="5 5 1"/>{bodies}</worldbody></mujoco>'
    )
    assert model.nv == DEGREES_OF_FREEDOM
    data = mujoco.MjData(model)
    data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
    mujoco.mj_forward(model, data)
    assert data.nefc > 500
    return data.qacc.copy()


def test_newton_solver_sparse_and_dense_factorization_are_equal() -> None:
    """MuJoCo 4.0.0 gave other accelerations for every degree of freedom of these branching bodies."""
    dense = compute_accelerations("dense")
    np.testing.assert_allclose(
        compute_accelerations("sparse"), dense, rtol=0.0, atol=1e-8 * np.abs(dense).max()
    )
