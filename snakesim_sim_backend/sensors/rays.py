"""Ray casting with MuJoCo: needs no OpenGL, and is exact.

MuJoCo releases the interpreter lock meanwhile, so that a tick of the robot runs in parallel.
"""

import mujoco
import numpy as np

from snakesim_sim_backend.model.build import FOOT_GROUP
from snakesim_sim_backend.model.ground import GROUND, PLANE_GROUP
from snakesim_sim_backend.sensors.mount import Mount
from snakesim_sim_backend.sensors.scope import Floats, Scope

SEEN = np.ones(mujoco.mjNGROUP, np.uint8)
SEEN[FOOT_GROUP] = 0  # spheres inside of the links' capsules
SEEN[PLANE_GROUP] = 0  # mj_multiRay of MuJoCo 4.0.0 overlooks it where rays leave the box around the obstacles


class Rays:
    """A bundle of rays from one place, cast together.

    They hit everything visible but the link that carries the sensor: the robot sees the rest of its own body.
    """

    def __init__(self, mount: Mount, scope: Scope, rays_s: Floats, max_lengths: float) -> None:
        """Prepare a bundle of rays.

        Args:
            mount: where the rays begin.
            scope: the model and its state.
            rays_s: (n, 3), directions in the sensor's frame, of any length.
            max_lengths: how far to look for a surface, in lengths of a ray.
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
        """Find the nearest surface along each ray from the present place of the sensor, flat ground included.

        Returns:
            (n,) distances in lengths of the ray; inf for a ray that reaches no surface.
        """
        origin_w, world_from_sensor = self._mount.place()
        rays_w = self._rays_s @ world_from_sensor.T
        below_m = origin_w[2] - self._ground_z_m
        to_ground = np.full(len(rays_w), np.inf)
        np.divide(-below_m, rays_w[:, 2], out=to_ground, where=rays_w[:, 2] * below_m < 0)
        mujoco.mj_multiRay(
            self._model,
            self._data,
            origin_w,
            rays_w.ravel(),
            SEEN,
            True,
            self._mount.body,
            self._hit_geoms,
            self._lengths,
            None,
            len(rays_w),
            self._cutoff_m,
        )
        return np.where(self._lengths < 0, to_ground, np.minimum(self._lengths, to_ground))
