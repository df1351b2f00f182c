"""The C version of the laws, which MuJoCo's engine calls by itself in `mj_step`.

Everything that the C version remembers is in `plugin_state`, a part of MuJoCo's state. So it is saved, restored and
copied with the state, and `mujoco.batch.Batch` may step many simulations with it, on any number of threads: the library
has no memory of its own. A row of the batch's state then has the same numbers as `MjData.plugin_state` here.

To begin a simulation of a batch as `begin` and `forward` do here, do that once with one `MjData`, and copy its state
(`mjSTATE_INTEGRATION`) into the row. After a reset of a row to zeros, the feet stick where they are in the next step.

Source of the layout: the structs `Memory`, `Foot`, `RoughContact` and `MeasuredForce` in `snakesim_native/laws`.
"""

import ctypes

import mujoco

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.laws.laws import PhysicsLaws, find_normal_forces_n
from snakesim_sim_backend.laws.version import (
    FRICTION_INSTANCE,
    MEASURED_FORCE_INSTANCE,
    load_library,
)
from snakesim_sim_backend.model.build import SimModel

# Numbers in the memory of the plugin instance.
PLACED = 0  # 0: the feet stick where they are in the next step
MIN_FRICTION = 1
CONTACT_COUNT = 2
MEMORY_NUMBERS = 3
# Then for each foot.
FOOT_NORMAL_FORCE = 5
FOOT_NUMBERS = 6
# Then for each contact with friction.
CONTACT_FORCE = slice(17, 20)
CONTACT_INDEX = 20
CONTACT_IS_NEW = 21
CONTACT_NUMBERS = 28
# Numbers in the memory of the measured force.
MAX_MEAN_FORCE = 0


class NativeContacts:
    """The contacts of the last physics step, read from MuJoCo's arrays when they are needed."""

    def __init__(self, data: mujoco.MjData, memory: Floats, records: Floats) -> None:
        """Prepare views.

        Args:
            data: The simulation's data.
            memory: The memory of the plugin instance.
            records: (capacity, CONTACT_NUMBERS), the part of it with contacts.
        """
        self._data = data
        self._contact = data.contact
        self._memory = memory
        self._records = records

    @property
    def geom_pairs(self) -> list[list[int]]:
        if not self._data.ncon:
            return []
        return self._contact.geom.tolist()

    @property
    def normal_force_n(self) -> list[float]:
        if not self._data.ncon:
            return []
        return find_normal_forces_n(self._data.efc_force, self._contact.efc_address)

    @property
    def friction_force_w(self) -> dict[int, Vector]:
        count = int(self._memory[CONTACT_COUNT])
        if not count:
            return {}
        records = self._records[:count].tolist()
        return {
            int(record[CONTACT_INDEX]): tuple(record[CONTACT_FORCE])
            for record in records
            if not record[CONTACT_IS_NEW]
        }


class NativeMeasuredForce:
    """The force that the C version has measured."""

    def __init__(self, memory: Floats) -> None:
        """Begin to measure.

        Args:
            memory: The memory of the plugin instance.
        """
        self._memory = memory
        self._memory[:] = 0.0

    @property
    def max_n(self) -> float:
        return float(self._memory[MAX_MEAN_FORCE])


class NativeLaws(PhysicsLaws):
    """Lets MuJoCo's engine compute the forces."""

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        """Prepare the laws of a simulation whose model was built for the C version."""
        model = sim.model
        self._model = model
        self._data = data
        self._memory = self._view_memory(FRICTION_INSTANCE)
        feet = len(sim.link_geoms) + 1
        first_contact = MEMORY_NUMBERS + FOOT_NUMBERS * feet
        self._feet = self._memory[MEMORY_NUMBERS:first_contact].reshape(feet, FOOT_NUMBERS)
        self._has_feet = sim.feet is not None
        records = self._memory[first_contact:].reshape(-1, CONTACT_NUMBERS)
        self.contacts = NativeContacts(data, self._memory, records)

        self._advance = load_library().snakesim_advance
        self._advance.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        self._advance.restype = None

    @property
    def foot_forces_n(self) -> Floats | None:
        if not self._has_feet:
            return None
        return self._feet[:, FOOT_NORMAL_FORCE].copy()

    def set_min_friction(self, min_friction: float) -> None:
        self._memory[MIN_FRICTION] = min_friction

    def reset(self) -> None:
        self._memory[PLACED] = 0.0
        self._memory[CONTACT_COUNT] = 0.0

    def forward(self) -> None:
        mujoco.mj_forward(self._model, self._data)
        self._advance(self._model._address, self._data._address)

    def start_force_measurement(self) -> NativeMeasuredForce:
        return NativeMeasuredForce(self._view_memory(MEASURED_FORCE_INSTANCE))

    def step(self, count: int) -> None:
        mujoco.mj_step(self._model, self._data, count)

    def _view_memory(self, instance_name: str) -> Floats:
        """Return a view of the memory of a plugin instance.

        Raises:
            ValueError: The model was built without the instance.
        """
        instance = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_PLUGIN, instance_name)
        if instance < 0:
            raise ValueError(f"the model was built without the plugin instance `{instance_name}`")
        start = self._model.plugin_stateadr[instance]
        return self._data.plugin_state[start : start + self._model.plugin_statenum[instance]]
