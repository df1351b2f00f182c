"""A message of a recording, and the name of the file in a run's folder: known without what reads and writes MCAP."""

from dataclasses import dataclass

RECORDING = "recording.mcap"


@dataclass(frozen=True)
class Recorded:
    """One message of a recording."""

    key: str
    payload: bytes
    encoding: str  # on the wire
    time_ns: int  # robot time
    wall_ns: int  # at the recorder
