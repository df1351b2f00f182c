"""A simulator that describes itself as a real robot. A forged description must not change what the host knows of it.

This is the only code of the attacks that runs in the process of the robot.
"""

from typing import Any

import msgspec

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import RobotDescription
from snakesim_sim_backend.backend import SimBackend


class RealRobot(SimBackend):
    """Backend for `snakesim run --backend verification/attack/robot_side/real_robot.py:RealRobot`."""

    def __init__(self, config: RunConfig, settings: Any) -> None:
        super().__init__(config, settings)
        self._description = msgspec.structs.replace(
            super().describe(), backend="real_robot", emulated=False
        )

    def describe(self) -> RobotDescription:
        """Return the description of the simulated robot, with `emulated` set to false."""
        return self._description
