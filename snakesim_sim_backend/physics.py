"""Steps of one simulation: MuJoCo's own, with the forces that this package computes itself."""

from collections.abc import Callable

import mujoco

from snakesim_sim_backend.laws.chain import Chain
from snakesim_sim_backend.laws.contact_friction import ContactFriction, count_numbers
from snakesim_sim_backend.laws.flat_ground import NUMBERS_PER_FOOT, FlatGround
from snakesim_sim_backend.laws.yielding import DOFS, Yielding
from snakesim_sim_backend.model.build import SimModel

AFTER_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)


class Physics:
    """Advances one simulation.

    Attributes:
        contacts: friction of the contacts that MuJoCo finds.
        ground: the ground's forces on the feet; None if the ground is not flat.
        after_step: called after every physics step, for a sensor that must not miss one.
    """

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        model = sim.model
        links = len(sim.link_geoms)
        self._model = model
        self._data = data
        self.after_step: Callable[[], None] | None = None
        chain = Chain(data, sim.first_link_body, links)

        start = NUMBERS_PER_FOOT * (links + 1)
        memory = data.userdata[start : start + count_numbers(links)]
        self.contacts = ContactFriction(model, data, chain, sim.link_geoms, sim.friction, memory)
        self._force_laws: list[Callable[[], None]] = [self.contacts.apply]

        self.ground = None
        if sim.feet is not None:
            self.ground = FlatGround(model, data, chain, sim.feet)
            self._force_laws.append(self.ground.apply)
        if sim.yielding:
            first_dof = model.nv - DOFS * len(sim.yielding)
            self._force_laws.append(Yielding(data, sim.yielding, first_dof, model.opt.timestep).apply)
        self._force_laws.append(chain.apply)  # last: it adds what the others have collected

    def set_min_friction(self, min_friction: float) -> None:
        """Use at least this friction coefficient in every contact, until it is set back to 0."""
        self.contacts.min_friction = min_friction
        if self.ground is not None:
            self.ground.min_friction = min_friction

    def begin(self) -> None:
        """Compute all quantities of the present state. The feet stick where they are, and contacts are forgotten."""
        if self.ground is not None:
            mujoco.mj_kinematics(self._model, self._data)
            self.ground.begin()
        self.contacts.begin()
        self.forward()

    def forward(self) -> None:
        """Compute all quantities of the present state."""
        mujoco.mj_forward(self._model, self._data)
        for apply in self._force_laws:
            apply()
        mujoco.mj_forwardSkip(self._model, self._data, AFTER_VELOCITIES, 0)
        self.contacts.update_contacts()

    def step(self, count: int) -> None:
        """Advance by this number of physics steps under the present inputs."""
        for _ in range(count):
            mujoco.mj_step1(self._model, self._data)
            for apply in self._force_laws:
                apply()
            mujoco.mj_step2(self._model, self._data)
            self.contacts.update_contacts()
            if self.after_step is not None:
                self.after_step()
