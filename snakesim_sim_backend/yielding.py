"""Obstacles that yield: posts on a spring, blocks that slide on the ground, and both.

Each is a body with three degrees of freedom, all horizontal: along x, along y, and a turn about the middle of its foot.
A spring holds it at its anchor. One with a mass rubs on the ground: the anchor slips along where the spring would pull
harder than dry friction holds, as the feet of the snake slip (flat_ground.py). A turn counts as the way of a point at
`arm_m`, where a foot that turns on the spot rubs on average, and adds to the way of the middle as a vector does. So the
friction of sliding and of turning bound each other by an ellipsoid, and none has a direction of its own.

It neither tips nor rolls, and slides level also where the ground is not. Anchors are kept in MuJoCo's `userdata`.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scene import Placed
from snakesim_hal.wire.messages import Obstacle
from snakesim_sim_backend.flat_ground import DAMPING, MAX_PHASE

AXES = {"x": mujoco.mjtJoint.mjJNT_SLIDE, "y": mujoco.mjtJoint.mjJNT_SLIDE, "z": mujoco.mjtJoint.mjJNT_HINGE}
FREEDOMS = len(AXES)  # of each, and numbers of each in `userdata`
HOLD_M = 1e-4  # of a rigid one under as much force as friction holds
WOOD_KG_M3 = 500.0  # of a post whose mass is not given
MOST = 128  # in a scene: the solver works on all their freedoms together with the snake's
NEVER_N = 1e9  # friction of one that is fixed
SPOTS = 20  # along an edge of a foot, where it rubs


def foot_of(obstacle: Obstacle) -> tuple[float, float]:
    """Area in m², and the mean distance of its points from the middle in m."""
    if obstacle.shape != "box":
        return math.pi * obstacle.radius_m**2, 2.0 / 3.0 * obstacle.radius_m
    length, width = (2.0 * half for half in obstacle.half_size_m[:2])
    across = (np.arange(SPOTS) + 0.5) / SPOTS - 0.5
    return length * width, float(np.hypot(length * across[:, None], width * across).mean())


def mass_kg(placed: Placed) -> float:
    """Of an obstacle that yields."""
    area_m2, _ = foot_of(placed.obstacle)
    return placed.mass_kg if placed.mass_kg is not None else WOOD_KG_M3 * area_m2 * placed.obstacle.height_m


def hardest_n_per_m(placed: Placed, step_s: float) -> float:
    """The stiffest spring that physics steps of this length can follow."""
    return mass_kg(placed) * (MAX_PHASE / step_s) ** 2


def check_yielding(placed: Sequence[Placed], scene: str, step_s: float) -> None:
    """Whether their springs can be computed. Raises ConfigError."""
    if len(placed) > MOST:
        raise ConfigError(
            f"scene {scene!r}: {len(placed)} obstacles yield (`stiffness_n_per_m`, `mass_kg`); at most {MOST} may: "
            f"leave some of them rigid and fixed"
        )
    for item in placed:
        most = hardest_n_per_m(item, step_s)
        if item.stiffness_n_per_m is not None and item.stiffness_n_per_m > most:
            raise ConfigError(
                f"scene {scene!r}: obstacle {item.obstacle.name!r}: `stiffness_n_per_m` = {item.stiffness_n_per_m:g} "
                f"N/m is too stiff for {mass_kg(item):.3g} kg and physics steps of {step_s * 1e3:g} ms, with which it "
                f"may be {most:.3g}; lower it, give more `mass_kg`, lower `timestep_s`, or leave it away (rigid)"
            )


class Yielding:
    """The springs of one simulation. `apply` comes between `mj_step1` and `mj_step2`."""

    def __init__(self, data: mujoco.MjData, placed: Sequence[Placed], first_dof: int, step_s: float) -> None:
        """first_dof: of the first of them; theirs are the last ones."""
        count = len(placed)
        masses = np.array([mass_kg(item) for item in placed])
        arms = np.array([foot_of(item.obstacle)[1] for item in placed])
        slides_at_n = [item.slides_at_n for item in placed]
        self._most = np.array([NEVER_N if slides is None else slides for slides in slides_at_n])
        hardest = np.array([hardest_n_per_m(item, step_s) for item in placed])
        held = np.minimum(hardest, self._most / HOLD_M)
        given = [item.stiffness_n_per_m for item in placed]
        stiffness = np.array([k if k is not None else stiff for k, stiff in zip(given, held, strict=True)])
        self._stiffness = stiffness[:, None]
        self._damping = (2.0 * DAMPING * np.sqrt(stiffness * masses))[:, None]
        self._scale = np.column_stack([np.ones((count, 2)), arms])
        self._moved = data.qpos[-FREEDOMS * count :].reshape(count, FREEDOMS)
        self._speeds = data.qvel[first_dof:].reshape(count, FREEDOMS)
        self._out = data.qfrc_passive[first_dof:].reshape(count, FREEDOMS)
        self._anchors = data.userdata[-FREEDOMS * count :].reshape(count, FREEDOMS)

    def apply(self) -> None:
        """Add their forces to MuJoCo's passive ones, which it computes in each step."""
        scale, most = self._scale, self._most
        stretched = scale * (self._moved - self._anchors)
        pull = self._stiffness[:, 0] * np.sqrt(np.einsum("ij,ij->i", stretched, stretched))
        stretched *= np.minimum(1.0, most / np.maximum(pull, 1e-12))[:, None]
        self._anchors[:] = self._moved - stretched / scale
        force = self._stiffness * stretched + self._damping * scale * self._speeds
        size = np.sqrt(np.einsum("ij,ij->i", force, force))
        self._out -= scale * force * np.minimum(1.0, most / np.maximum(size, 1e-12))[:, None]
