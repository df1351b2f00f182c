"""The result of an emergency stop, by the stop port or by the network."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StopResult:
    """The result of an emergency stop for one robot, as one stop port or the network has reported it."""

    name: str
    endpoint: str
    is_stopped: bool
    text: str
    is_doubtful: bool = False  # an impostor may answer in its name
