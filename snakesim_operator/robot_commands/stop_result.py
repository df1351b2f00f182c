"""The result of an emergency stop, by the stop port or by the network."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StopResult:
    """The result of an emergency stop for one robot."""

    name: str
    endpoint: str
    stopped: bool
    text: str
    in_doubt: bool = False  # an impostor may answer in its name
