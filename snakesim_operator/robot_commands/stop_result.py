"""What a stop came to, whichever way it was asked for."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StopResult:
    """The result for one robot."""

    name: str
    endpoint: str
    stopped: bool
    text: str
    in_doubt: bool = False  # an impostor may answer in its name
