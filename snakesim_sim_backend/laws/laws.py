"""What a version of the laws does, and what can be read of it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector


def find_normal_forces_n(solver_forces_n: Floats, solver_rows: NDArray[np.int32]) -> list[float]:
    """Return the normal force of each contact. A contact without a row in the solver has no force.

    Args:
        solver_forces_n: MuJoCo's `efc_force`.
        solver_rows: MuJoCo's `efc_address` of each contact; negative: the contact has no row.
    """
    forces_n = solver_forces_n.tolist()
    return [forces_n[row] if row >= 0 else 0.0 for row in solver_rows.tolist()]


class StepContacts(Protocol):
    """The contacts of the last physics step, in MuJoCo's order."""

    @property
    def geom_pairs(self) -> Sequence[Sequence[int]]:
        """Return the two geoms of each contact."""
        ...

    @property
    def normal_force_n(self) -> Sequence[float]:
        """Return the normal force of each contact."""
        ...

    @property
    def friction_force_w(self) -> Mapping[int, Vector]:
        """Return the friction force on the link, in N, by the contact's number; only contacts that have friction."""
        ...


class MeasuredContactForce(Protocol):
    """The contact force as a robot would measure it, see `snakesim_hal.model.measured_force`."""

    @property
    def max_n(self) -> float:
        """Return the mean force between the link and the obstacle that push each other hardest; 0 without contacts."""
        ...


class PhysicsLaws(ABC):
    """Computes ground, friction and yielding obstacles of one simulation.

    Attributes:
        contacts: Forces of the contacts that MuJoCo finds.
    """

    contacts: StepContacts

    @property
    @abstractmethod
    def foot_forces_n(self) -> Floats | None:
        """Return the normal force on each foot in the last step, (n_feet,); None if the ground is not flat."""

    @abstractmethod
    def set_min_friction(self, min_friction: float) -> None:
        """Use at least this friction coefficient in every contact."""

    @abstractmethod
    def reset(self) -> None:
        """Take the feet as sticking where they are in the next `forward`, and forget all contacts."""

    @abstractmethod
    def forward(self) -> None:
        """Compute all quantities of the present state, and remember the contacts."""

    @abstractmethod
    def start_force_measurement(self) -> MeasuredContactForce:
        """Begin to measure the force between links and obstacles in every step. Earlier steps are forgotten."""

    @abstractmethod
    def step(self, count: int) -> None:
        """Make physics steps.

        Args:
            count: Number of physics steps.
        """
