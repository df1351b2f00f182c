"""The Python version of the laws, applied between the two halves of each physics step."""

from collections.abc import Callable

import mujoco

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.measured_force import MeasuredForce
from snakesim_sim_backend.laws.chain import Chain
from snakesim_sim_backend.laws.contact_friction import ContactFriction, count_numbers
from snakesim_sim_backend.laws.flat_ground import NUMBERS_PER_FOOT, FlatGround
from snakesim_sim_backend.laws.laws import Laws
from snakesim_sim_backend.laws.yielding import Yielding
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.state.contacts import TouchReader

AFTER_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)


class PythonLaws(Laws):
    """Computes the forces in Python, in every physics step."""

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        """Prepare the laws of a simulation."""
        model = sim.model
        links = len(sim.link_geoms)
        self._model = model
        self._data = data
        chain = Chain(data, sim.first_link_body, links)

        start = NUMBERS_PER_FOOT * (links + 1)
        memory = data.userdata[start : start + count_numbers(links)]
        self._friction = ContactFriction(model, data, chain, sim.link_geoms, memory)
        self.contacts = self._friction
        self._force_laws: list[Callable[[], None]] = [self._friction.apply]

        self._ground: FlatGround | None = None
        if sim.feet is not None:
            self._ground = FlatGround(model, data, chain, sim.feet)
            self._force_laws.append(self._ground.apply)
        if sim.yielding:
            self._force_laws.append(Yielding(model, data, len(sim.yielding)).apply)
        self._force_laws.append(chain.apply)  # last: it adds what the others have collected

        self._touches = TouchReader(sim, data, self.contacts)
        self._measured_force: MeasuredForce | None = None  # None: nothing measures it

    @property
    def foot_forces_n(self) -> Floats | None:
        if self._ground is None:
            return None
        return self._ground.normal_force_n

    def set_min_friction(self, min_friction: float) -> None:
        self._friction.min_friction = min_friction
        if self._ground is not None:
            self._ground.min_friction = min_friction

    def begin(self) -> None:
        if self._ground is not None:
            mujoco.mj_kinematics(self._model, self._data)
            self._ground.begin()
        self._friction.begin()

    def forward(self) -> None:
        mujoco.mj_forward(self._model, self._data)
        for apply in self._force_laws:
            apply()
        mujoco.mj_forwardSkip(self._model, self._data, AFTER_VELOCITIES, 0)
        self._friction.update_contacts()

    def measure_force(self) -> MeasuredForce:
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
                self._measured_force.add(self._touches.sum_forces_n())
