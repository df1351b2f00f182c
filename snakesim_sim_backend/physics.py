"""Steps of one simulation: MuJoCo's, with the forces that come from laws of our own."""

from collections.abc import Callable

import mujoco

from snakesim_sim_backend.chain import Chain
from snakesim_sim_backend.contact_friction import ContactFriction, numbers_kept
from snakesim_sim_backend.flat_ground import KEPT, FlatGround
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.yielding import FREEDOMS, Yielding

AFTER_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)


class Physics:
    """Steps of one simulation."""

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        model = sim.model
        self._model, self._data = model, data
        self.after_step: Callable[[], None] | None = None  # of a sensor that misses no step
        chain, feet = Chain(data, sim.first_link_body, len(sim.link_geoms)), KEPT * (len(sim.link_geoms) + 1)
        kept = data.userdata[feet : feet + numbers_kept(len(sim.link_geoms))]
        self.contacts = ContactFriction(model, data, chain, sim.link_geoms, sim.friction, kept)
        self._laws: list[Callable[[], None]] = [self.contacts.apply]
        self.ground = None
        if sim.soles is not None:
            self.ground = FlatGround(model, data, chain, sim.soles)
            self._laws.append(self.ground.apply)
        if sim.yielding:
            first_dof = model.nv - FREEDOMS * len(sim.yielding)
            self._laws.append(Yielding(data, sim.yielding, first_dof, model.opt.timestep).apply)
        self._laws.append(chain.apply)

    def grip(self, least: float) -> None:
        """Have nothing rub less than this, until it is set back to 0."""
        self.contacts.least = least
        if self.ground is not None:
            self.ground.least = least

    def begin(self) -> None:
        """Compute everything of the present state, in which the robot is taken as standing."""
        if self.ground is not None:
            mujoco.mj_kinematics(self._model, self._data)
            self.ground.begin()
        self.contacts.begin()
        self.forward()

    def forward(self) -> None:
        """Compute everything of the present state."""
        mujoco.mj_forward(self._model, self._data)
        for apply in self._laws:
            apply()
        mujoco.mj_forwardSkip(self._model, self._data, AFTER_VELOCITIES, 0)
        self.contacts.remember()

    def step(self, count: int) -> None:
        """That many physics steps under the present inputs."""
        for _ in range(count):
            mujoco.mj_step1(self._model, self._data)
            for apply in self._laws:
                apply()
            mujoco.mj_step2(self._model, self._data)
            self.contacts.remember()
            if self.after_step is not None:
                self.after_step()
