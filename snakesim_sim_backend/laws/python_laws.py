"""The Python version of the laws, applied between the two halves of each physics step."""

from collections.abc import Callable

import mujoco

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.measured_force import MeasuredForce
from snakesim_sim_backend.laws.chain import LinkChain
from snakesim_sim_backend.laws.contact_friction import ContactFriction, count_contact_values
from snakesim_sim_backend.laws.directional import LinkUndersides
from snakesim_sim_backend.laws.flat_ground import VALUES_PER_FOOT, FlatGround
from snakesim_sim_backend.laws.laws import PhysicsLaws
from snakesim_sim_backend.laws.yielding import YieldingObstacles
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.state.contacts import ObstacleContactReader

VELOCITY_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)


class PythonLaws(PhysicsLaws):
    """Computes the forces in Python, in every physics step."""

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        """Prepare the laws of a simulation whose model was built for the Python version.

        Args:
            sim: Compiled model.
            data: State of the simulation.
        """
        model = sim.model
        link_count = len(sim.link_geoms)
        self._model = model
        self._data = data
        chain = LinkChain(data, sim.first_link_body, link_count)
        half_lengths_m = model.geom_size[sim.link_geoms, 1]
        underside = LinkUndersides(data, sim.first_link_body, (2.0 * half_lengths_m).tolist())

        # The values of the feet come first in `userdata`.
        contacts_start = VALUES_PER_FOOT * (link_count + 1)
        memory = data.userdata[contacts_start : contacts_start + count_contact_values(link_count)]
        self._friction = ContactFriction(model, data, chain, sim.link_geoms, memory, underside)
        self.contacts = self._friction
        self._force_laws: list[Callable[[], None]] = [self._friction.apply]

        self._ground: FlatGround | None = None
        if sim.feet is not None:
            self._ground = FlatGround(model, data, chain, sim.feet, underside)
            self._force_laws.append(self._ground.apply)
        if sim.yielding:
            self._force_laws.append(YieldingObstacles(model, data, len(sim.yielding)).apply)
        # Last, because it applies the forces that the other laws have collected.
        self._force_laws.append(chain.apply)

        self._contact_reader = ObstacleContactReader(sim, data, self.contacts)
        self._measured_force: MeasuredForce | None = None  # None until the measurement is started

    @property
    def foot_forces_n(self) -> Floats | None:
        if self._ground is None:
            return None
        return self._ground.normal_force_n

    def set_min_friction(self, min_friction: float) -> None:
        self._friction.min_friction = min_friction
        if self._ground is not None:
            self._ground.min_friction = min_friction

    def reset(self) -> None:
        if self._ground is not None:
            mujoco.mj_kinematics(self._model, self._data)
            self._ground.begin()
        self._friction.begin()

    def forward(self) -> None:
        mujoco.mj_forward(self._model, self._data)
        for apply in self._force_laws:
            apply()
        mujoco.mj_forwardSkip(self._model, self._data, VELOCITY_STAGE, 0)
        self._friction.update_contacts()

    def start_force_measurement(self) -> MeasuredForce:
        self._measured_force = MeasuredForce(self._model.opt.timestep)
        return self._measured_force

    def step(self, count: int) -> None:
        for _ in range(count):
            mujoco.mj_step1(self._model, self._data)
            for apply in self._force_laws:
                apply()
            mujoco.mj_step2(self._model, self._data)
            self._friction.update_contacts()
            if self._measured_force is not None:
                self._measured_force.add_sample(self._contact_reader.sum_forces_n())
