"""Obstacles that yield: posts on a spring, blocks that slide on the ground, and both.

Each is a body with three degrees of freedom, all horizontal: along x, along y, and a rotation about the middle of its
foot. A spring holds it at its anchor. One with a mass rubs on the ground: the anchor slips along when the spring
would pull harder than dry friction holds, as the feet of the snake slip (flat_ground.py).

A rotation counts as the path of a point at the foot's mean radius, and adds to the path of the middle as a vector does.
So the friction of sliding and of rotating limit each other by an ellipsoid, and no direction is preferred.

Such an obstacle neither tips nor rolls, and slides level even where the ground is not. The anchors are kept in MuJoCo's
`userdata`.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scene_file.placement import PlacedObstacle
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_sim_backend.laws.flat_ground import DAMPING_RATIO, MAX_PHASE_RAD

JOINT_TYPE_BY_AXIS = {
    "x": mujoco.mjtJoint.mjJNT_SLIDE,
    "y": mujoco.mjtJoint.mjJNT_SLIDE,
    "z": mujoco.mjtJoint.mjJNT_HINGE,
}
DOFS = len(JOINT_TYPE_BY_AXIS)  # degrees of freedom of one obstacle, and its numbers in `userdata`
VALUES_PER_SPRING = 4  # parameters of one obstacle's spring, in the user data of its body
RIGID_STRETCH_M = 1e-4  # how far a rigid one moves under as much force as friction holds
WOOD_KG_M3 = 500.0  # density of an obstacle whose mass is not given
MAX_OBSTACLES = 128  # the solver works on all their degrees of freedom together with the snake's
UNLIMITED_N = 1e9  # friction of an obstacle that is fixed
GRID_POINTS = 20  # along an edge of a foot, to average its radius
MIN_FORCE_N = 1e-12  # keeps 0 / 0 out of the forces of an obstacle at rest


def measure_foot(obstacle: KnownObstacle) -> tuple[float, float]:
    """Return the area of an obstacle's foot in m², and the mean distance of its points from its middle in m."""
    if obstacle.shape != "box":
        return math.pi * obstacle.radius_m**2, 2.0 / 3.0 * obstacle.radius_m
    length, width = (2.0 * half for half in obstacle.half_size_m[:2])
    # Middles of cells, as fractions of an edge.
    across = (np.arange(GRID_POINTS) + 0.5) / GRID_POINTS - 0.5
    distances_m = np.hypot(length * across[:, None], width * across)
    return length * width, float(distances_m.mean())


def compute_mass_kg(placed: PlacedObstacle) -> float:
    """Return the mass of an obstacle that yields: the given one, or that of wood."""
    if placed.mass_kg is not None:
        return placed.mass_kg
    area_m2, _ = measure_foot(placed.obstacle)
    return WOOD_KG_M3 * area_m2 * placed.obstacle.height_m


def compute_max_stiffness_n_per_m(placed: PlacedObstacle, step_s: float) -> float:
    """Return the stiffness of the stiffest spring that physics steps of this length can follow."""
    return compute_mass_kg(placed) * (MAX_PHASE_RAD / step_s) ** 2


def validate_yielding_obstacles(
    placed: Sequence[PlacedObstacle], scene: str, step_s: float, slope_rad: float = 0.0
) -> None:
    """Check that the springs of obstacles that yield can be simulated, and that no obstacle slides down by itself.

    Args:
        placed: Obstacles that yield.
        scene: Name of the scene, for messages.
        step_s: Duration of a physics step in s.
        slope_rad: Slope of the ground.

    Raises:
        ConfigError: Too many obstacles yield, a spring is too stiff for its mass and the physics step, or an obstacle
            with a mass is on a slope that is steeper than its friction holds.
    """
    if len(placed) > MAX_OBSTACLES:
        raise ConfigError(
            f"scene {scene!r}: {len(placed)} obstacles yield (`stiffness_n_per_m`, `mass_kg`); at most {MAX_OBSTACLES} "
            f"may: leave some of them rigid and fixed",
            code="scene/invalid",
        )
    min_base_friction = math.tan(slope_rad)
    for item in placed:
        if item.mass_kg is not None and item.base_friction < min_base_friction:
            raise ConfigError(
                f"scene {scene!r}: obstacle {item.obstacle.name!r}: `base_friction` = {item.base_friction:g} does not "
                f"hold it on ground that slopes by `ground.slope_rad` = {slope_rad:g} rad; set at least "
                f"{min_base_friction:.3g}, leave `mass_kg` away (fixed), or lower the slope",
                code="scene/invalid",
            )
        max_stiffness = compute_max_stiffness_n_per_m(item, step_s)
        if item.stiffness_n_per_m is not None and item.stiffness_n_per_m > max_stiffness:
            raise ConfigError(
                f"scene {scene!r}: obstacle {item.obstacle.name!r}: `stiffness_n_per_m` = {item.stiffness_n_per_m:g} "
                f"N/m is too stiff for {compute_mass_kg(item):.3g} kg and physics steps of {step_s * 1e3:g} ms, with "
                f"which it may be {max_stiffness:.3g}; lower it, give more `mass_kg`, lower `timestep_s`, or leave it "
                f"away (rigid)",
                code="scene/invalid",
            )


def compute_spring(
    placed: PlacedObstacle, step_s: float, normal_gravity_m_s2: float
) -> list[float]:
    """Return the parameters of an obstacle's spring, which are the user data of its body.

    Args:
        placed: Obstacle that yields.
        step_s: Duration of a physics step in s.
        normal_gravity_m_s2: Part of gravity that presses the obstacle onto the ground.

    Returns:
        Stiffness in N/m, damping in N·s/m, largest force in N, and mean radius of the foot in m.
    """
    mass_kg = compute_mass_kg(placed)
    max_force_n = _compute_max_friction_n(placed, normal_gravity_m_s2)
    # A rigid obstacle is as stiff as needed to hardly move, or as the physics step allows.
    stiffness = min(compute_max_stiffness_n_per_m(placed, step_s), max_force_n / RIGID_STRETCH_M)
    if placed.stiffness_n_per_m is not None:
        stiffness = placed.stiffness_n_per_m
    damping = 2.0 * DAMPING_RATIO * math.sqrt(stiffness * mass_kg)
    _, mean_radius_m = measure_foot(placed.obstacle)
    return [stiffness, damping, max_force_n, mean_radius_m]


class YieldingObstacles:
    """The springs of one simulation. Call `apply` between `mj_step1` and `mj_step2`.

    Equations of one obstacle, with its displacement q (x and y in m, rotation in rad), its anchor a, and the lengths
    L = (1, 1, mean radius of the foot) that make its coordinates comparable:

        s = L (q - a)                                     stretch, m
        s is shortened so that k |s| <= F_max, and the anchor slips: a = q - s / L
        F = k s + d L dq/dt, shortened to |F| <= F_max
        generalized force = -L F
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, count: int) -> None:
        """Read the parameters of this many obstacles. Their bodies and degrees of freedom are the model's last ones."""
        stiffness, damping, max_force_n, mean_radii_m = model.body_user[-count:].T
        first_dof = model.nv - DOFS * count
        self._max_force_n = max_force_n
        self._stiffness = stiffness[:, None]  # N/m
        self._damping = damping[:, None]  # N·s/m
        self._lengths = np.column_stack([np.ones((count, 2)), mean_radii_m])  # L, (n_obstacles, 3)

        # Views of MuJoCo's arrays, (n_obstacles, 3) each.
        self._displacements = data.qpos[-DOFS * count :].reshape(count, DOFS)
        self._velocities = data.qvel[first_dof:].reshape(count, DOFS)
        self._passive_forces = data.qfrc_passive[first_dof:].reshape(count, DOFS)
        self._anchors = data.userdata[-DOFS * count :].reshape(count, DOFS)

    def apply(self) -> None:
        """Add the obstacles' forces to MuJoCo's passive ones, which it computes in each step."""
        lengths = self._lengths
        max_force_n = self._max_force_n

        stretch = lengths * (self._displacements - self._anchors)
        pull_n = self._stiffness[:, 0] * _compute_lengths(stretch)
        stretch *= np.minimum(1.0, max_force_n / np.maximum(pull_n, MIN_FORCE_N))[:, None]
        self._anchors[:] = self._displacements - stretch / lengths

        force = self._stiffness * stretch + self._damping * lengths * self._velocities
        size_n = _compute_lengths(force)
        scale = np.minimum(1.0, max_force_n / np.maximum(size_n, MIN_FORCE_N))
        self._passive_forces -= lengths * force * scale[:, None]


def _compute_lengths(vectors: Floats) -> Floats:
    """Return the length of each vector, (n, 3). `np.einsum` rounds in another way on each kind of processor."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)


def _compute_max_friction_n(placed: PlacedObstacle, normal_gravity_m_s2: float) -> float:
    """Return the force above which an obstacle slides on the ground."""
    sliding_force_n = placed.compute_sliding_force_n(normal_gravity_m_s2)
    if sliding_force_n is None:
        return UNLIMITED_N
    return sliding_force_n
