"""What other packages need to know of recordings, without the libraries that read and write MCAP."""

from dataclasses import dataclass

RECORDING_FILENAME = "recording.mcap"  # name of the file in the folder of a run
# Help of the option.
RAW_ONLY_HELP = "record messages as on the wire alone, without topics for Foxglove and PlotJuggler"


@dataclass(frozen=True)
class RecordedMessage:
    """One message of a recording."""

    key: str
    payload: bytes
    encoding: str  # on the wire
    robot_time_ns: int  # robot time
    wall_time_ns: int  # wall clock at the recorder
