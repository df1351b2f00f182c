"""Steps of one simulation: MuJoCo's own, with the forces that this package computes itself."""

import mujoco

from snakesim_sim_backend.laws.laws import MeasuredContactForce, PhysicsLaws
from snakesim_sim_backend.laws.native_laws import NativeLaws
from snakesim_sim_backend.laws.python_laws import PythonLaws
from snakesim_sim_backend.model.build import SimModel


def create_laws(sim: SimModel, data: mujoco.MjData) -> PhysicsLaws:
    """Return the laws of a simulation, in the version that its model was built for."""
    match sim.laws:
        case "c":
            return NativeLaws(sim, data)
        case "python":
            return PythonLaws(sim, data)


class PhysicsStepper:
    """Advances one simulation.

    Attributes:
        laws: The forces that MuJoCo does not compute.
        contacts: Forces of the contacts that MuJoCo finds.
    """

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        self.laws = create_laws(sim, data)
        self.contacts = self.laws.contacts

    def set_min_friction(self, min_friction: float) -> None:
        """Use at least this friction coefficient in every contact, until it is set back to 0."""
        self.laws.set_min_friction(min_friction)

    def reset(self) -> None:
        """Compute all quantities of the present state. The feet stick where they are, and contacts are forgotten."""
        self.laws.reset()
        self.laws.forward()

    def forward(self) -> None:
        """Compute all quantities of the present state."""
        self.laws.forward()

    def start_force_measurement(self) -> MeasuredContactForce:
        """Begin to measure the force between links and obstacles, in a model that was built with `measures_force`."""
        return self.laws.start_force_measurement()

    def step(self, count: int) -> None:
        """Advance by this number of physics steps under the present inputs."""
        self.laws.step(count)
