"""The numbers that the HAL host leaves behind."""

from dataclasses import dataclass, field


@dataclass
class Tally:
    """What the host measures of itself while armed."""

    ticks: int = 0
    overruns: int = 0
    answered_ticks: int = 0  # commands that came within their own tick
    state_to_command_us: list[float] = field(default_factory=list[float])
