"""Supply and health of the joint modules."""

from collections.abc import Sequence

import mujoco
import numpy as np

from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.physics.thermal import ThermalModel
from snakesim_hal.wire.messages import Power
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.model.build import view_joint_states


class PowerReader:
    """Supply, current and temperatures of the joint modules, without noise and without a leak."""

    def __init__(
        self,
        data: mujoco.MjData,
        motors: ModelMotors,
        windings: ThermalModel,
        joints: Sequence[Joint],
    ) -> None:
        _, self._velocities = view_joint_states(data, motors.count)
        self._torques = motors.get_applied_torque_nm()
        self._windings = windings
        self._count = len(joints)
        self._supply_v = np.array([joint.supply.voltage_v for joint in joints])
        self._idle_a = np.array([joint.supply.idle_a for joint in joints])

    def read(self, tick: int, timestamp_ns: int) -> Power:
        """Return the present values of the joint modules."""
        power_w = self._windings.compute_power_w(self._torques, self._velocities)
        return Power(
            tick=tick,
            timestamp_ns=timestamp_ns,
            voltage_v=self._supply_v.tolist(),
            current_a=(self._idle_a + power_w / self._supply_v).tolist(),
            motor_c=self._windings.winding_temperature_c.tolist(),
            board_c=self._windings.compute_board_temperatures_c().tolist(),
            leak=[False] * self._count,
            valid=[True] * self._count,
        )
