"""Supply and health of the joint modules."""

import mujoco

from snakesim_hal.physics.thermal import SUPPLY_V, Thermal, board_c, current_a
from snakesim_hal.wire.messages import Power
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.model import FREE_DOFS


class PowerReader:
    """Supply, current and temperatures of the joints' modules. No noise, and never a leak."""

    def __init__(self, data: mujoco.MjData, motors: Motors, windings: Thermal, rated_nm: float) -> None:
        self._velocities, self._torques = data.qvel[FREE_DOFS:], motors.applied_nm()
        self._windings, self._rated_nm = windings, rated_nm
        self._count = motors.count

    def read(self, tick: int, stamp_ns: int) -> Power:
        """The modules' present values."""
        winding_c = self._windings.winding_c
        return Power(
            tick=tick,
            stamp_ns=stamp_ns,
            voltage_v=[SUPPLY_V] * self._count,
            current_a=current_a(self._torques, self._velocities, self._rated_nm, SUPPLY_V).tolist(),
            motor_c=winding_c.tolist(),
            board_c=board_c(winding_c).tolist(),
            leak=[False] * self._count,
            valid=[True] * self._count,
        )
