"""The robot's side: the simulator, which says that it is real. What a stranger forges must not change that."""

from typing import Any

import msgspec

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import RobotDescription
from snakesim_sim_backend.backend import SimBackend


class Bench(SimBackend):
    """For `snakesim run --backend verification/attack/data/bench.py:Bench`."""

    def __init__(self, config: RunConfig, settings: Any) -> None:
        super().__init__(config, settings)
        self._real = msgspec.structs.replace(super().describe(), backend="bench", emulated=False)

    def describe(self) -> RobotDescription:
        """A robot that really moves."""
        return self._real
