"""Ray casting with MuJoCo: needs no OpenGL, and is exact.

MuJoCo gives the interpreter free meanwhile, so that a tick of the robot goes on beside it.
"""

import mujoco
import numpy as np

from snakesim_sim_backend.ground import GROUND, PLANE_GROUP
from snakesim_sim_backend.model import FOOT_GROUP
from snakesim_sim_backend.sensors.mount import Mount
from snakesim_sim_backend.sensors.scope import Floats, Scope

SEEN = np.ones(mujoco.mjNGROUP, np.uint8)
SEEN[FOOT_GROUP] = 0  # spheres inside of the links' capsules
SEEN[PLANE_GROUP] = 0  # mj_multiRay of MuJoCo 4.0.0 overlooks it where rays leave the box around the obstacles


class Rays:
    """A bundle of rays from one place, cast together.

    They meet everything visible but the link that carries the sensor: the robot sees the rest of its own body.
    """

    def __init__(self, mount: Mount, scope: Scope, rays_s: Floats, most: float) -> None:
        """rays_s: (n, 3) in the sensor's frame, of any length; most: lengths of a ray after which nothing is sought."""
        self._model, self._data, self._mount = scope.sim.model, scope.data, mount
        self._rays_s = rays_s
        self._ground_z_m = float(scope.sim.model.geom(GROUND).pos[2])
        self._cutoff_m = most * float(np.linalg.norm(rays_s, axis=1).max())
        self._met = np.zeros(len(rays_s), np.int32)
        self._shares = np.zeros(len(rays_s))

    def cast(self) -> Floats:
        """How far along each ray the nearest surface is, in lengths of the ray, (n,); infinite where there is none."""
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
            self._met,
            self._shares,
            None,
            len(rays_w),
            self._cutoff_m,
        )
        return np.where(self._shares < 0, to_ground, np.minimum(self._shares, to_ground))
