"""The exact state of the simulation, without noise, rate or delay: for tests, benchmarks and reports."""

from dataclasses import dataclass

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.state.contacts import ObstacleContact


@dataclass(frozen=True)
class TrueState:
    """The whole snake at one instant."""

    time_s: float
    base_position_w: Floats  # (3,), m: the tail end of link 0
    base_orientation_wxyz: Floats  # (4,)
    base_velocity_w: Floats  # (3,), m/s
    angles_rad: Floats  # (n_joints,), tail to head
    velocities_rad_s: Floats  # (n_joints,)
    torques_nm: Floats  # (n_joints,), of the motors over the last physics step
    contacts: list[ObstacleContact]
