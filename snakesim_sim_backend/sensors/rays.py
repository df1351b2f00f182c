"""Ray casting with MuJoCo: needs no OpenGL, and is exact.

MuJoCo releases the interpreter lock meanwhile, so that a tick of the robot runs in parallel.
"""

import mujoco
import numpy as np

from snakesim_sim_backend.model.build import FOOT_GROUP
from snakesim_sim_backend.model.ground import GROUND, PLANE_GROUP
from snakesim_sim_backend.sensors.mount import SensorMount
from snakesim_sim_backend.sensors.scope import Floats, SensorScope

VISIBLE_GROUPS = np.ones(mujoco.mjNGROUP, np.uint8)
VISIBLE_GROUPS[FOOT_GROUP] = 0  # spheres inside of the links' capsules
# mj_multiRay of MuJoCo 4.0.0 overlooks it where rays leave the box around the obstacles.
VISIBLE_GROUPS[PLANE_GROUP] = 0


class RayBundle:
    """A bundle of rays from one place, cast together.

    They hit everything visible but the link that carries the sensor: the robot sees the rest of its own body.
    """

    def __init__(
        self, mount: SensorMount, scope: SensorScope, rays_s: Floats, max_lengths: float
    ) -> None:
        """Prepare a bundle of rays.

        Args:
            mount: Place of the sensor, where all rays start.
            scope: The model and its state.
            rays_s: (n, 3), directions in the sensor's frame, of any length.
            max_lengths: Range of the search for a surface, in lengths of a ray.
        """
        self._model = scope.sim.model
        self._data = scope.data
        self._mount = mount
        self._rays_s = rays_s
        self._ground_z_m = float(scope.sim.model.geom(GROUND).pos[2])
        self._cutoff_m = max_lengths * float(np.linalg.norm(rays_s, axis=1).max())
        self._hit_geoms = np.zeros(len(rays_s), np.int32)
        self._lengths = np.zeros(len(rays_s))

    def cast(self) -> Floats:
        """Find the nearest surface along each ray from the current place of the sensor.

        The distance to flat ground is computed here, because MuJoCo overlooks it for some rays: see VISIBLE_GROUPS.

        Returns:
            (n,) distances in lengths of the ray; infinity for a ray that hits nothing.
        """
        origin_w, world_from_sensor = self._mount.place()
        rays_w = self._rays_s @ world_from_sensor.T
        height_m = origin_w[2] - self._ground_z_m
        ground_distances = np.full(len(rays_w), np.inf)
        is_towards_ground = rays_w[:, 2] * height_m < 0
        np.divide(-height_m, rays_w[:, 2], out=ground_distances, where=is_towards_ground)
        mujoco.mj_multiRay(
            self._model,
            self._data,
            origin_w,
            rays_w.ravel(),
            VISIBLE_GROUPS,
            True,
            self._mount.body,
            self._hit_geoms,
            self._lengths,
            None,
            len(rays_w),
            self._cutoff_m,
        )
        # MuJoCo returns a negative length for a ray that hits nothing.
        return np.where(
            self._lengths < 0, ground_distances, np.minimum(self._lengths, ground_distances)
        )
