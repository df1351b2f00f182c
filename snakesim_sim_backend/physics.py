"""Steps of one simulation: MuJoCo's, with the forces that come from laws of our own."""

from collections.abc import Callable

import mujoco

from snakesim_sim_backend.flat_ground import FlatGround
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.yielding import FREEDOMS, Yielding

AFTER_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)


class Physics:
    """Steps of one simulation."""

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        model = sim.model
        self._model, self._data = model, data
        self.after_step: Callable[[], None] | None = None  # of a sensor that misses no step
        self.ground = None if sim.soles is None else FlatGround(model, data, sim.soles)
        self._laws: list[Callable[[], None]] = [] if self.ground is None else [self.ground.apply]
        if sim.yielding:
            first_dof = model.nv - FREEDOMS * len(sim.yielding)
            self._laws.append(Yielding(data, sim.yielding, first_dof, model.opt.timestep).apply)

    @property
    def friction(self) -> float:
        """Of the flat ground; 0 where there is none."""
        return 0.0 if self.ground is None else self.ground.friction

    @friction.setter
    def friction(self, friction: float) -> None:
        if self.ground is not None:
            self.ground.friction = friction

    def begin(self) -> None:
        """Compute everything of the present state, in which the robot is taken as standing."""
        if self.ground is not None:
            mujoco.mj_kinematics(self._model, self._data)
            self.ground.begin()
        self.forward()

    def forward(self) -> None:
        """Compute everything of the present state."""
        mujoco.mj_forward(self._model, self._data)
        if self._laws:
            for apply in self._laws:
                apply()
            mujoco.mj_forwardSkip(self._model, self._data, AFTER_VELOCITIES, 0)

    def step(self, count: int) -> None:
        """That many physics steps under the present inputs."""
        if not self._laws and self.after_step is None:
            mujoco.mj_step(self._model, self._data, count)
            return
        for _ in range(count):
            if self._laws:
                mujoco.mj_step1(self._model, self._data)
                for apply in self._laws:
                    apply()
                mujoco.mj_step2(self._model, self._data)
            else:
                mujoco.mj_step(self._model, self._data)
            if self.after_step is not None:
                self.after_step()
