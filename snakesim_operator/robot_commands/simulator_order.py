"""A request to the simulator, for `snakesim sim` and the console. Importable without Zenoh."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class SimulatorOrder:
    """A request of an operator to the simulator."""

    action: Any  # pause, resume, step, speed or reset
    ticks: int = 1  # number of ticks to advance, for `step`
    speed: float = 1.0  # robot time over wall time, for `speed`
    requester: str | None = None  # if None, the user of this process

    def __str__(self) -> str:
        match self.action:
            case "step":
                return f"step {self.ticks}"
            case "speed":
                return f"speed {self.speed:g}"
            case _:
                return self.action
