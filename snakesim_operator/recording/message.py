"""A message of a recording, its file's name, words for an option: known without what reads and writes MCAP."""

from dataclasses import dataclass

RECORDING = "recording.mcap"
RAW_ONLY = "record messages as on the wire alone, without topics for Foxglove and PlotJuggler"


@dataclass(frozen=True)
class RecordedMessage:
    """One message of a recording."""

    key: str
    payload: bytes
    encoding: str  # on the wire
    time_ns: int  # robot time
    wall_ns: int  # at the recorder
