"""Reads the frames of a robot's CAN bus from the log that the driver writes in the format of candump."""

from pathlib import Path

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import CanFrame, CommandAction, Opcode, parse_opcode


def read_frames(path: Path) -> list[CanFrame]:
    """Return every complete frame of a log, oldest first. A missing log contains no frames."""
    if not path.is_file():
        return []
    lines = path.read_text().splitlines(keepends=True)
    return [_parse_frame(line) for line in lines if line.endswith("\n")]


def count_commands(frames: list[CanFrame], action: CommandAction) -> int:
    """Return how many Command frames with an action the driver sent."""
    layout = load_layouts()[Opcode.COMMAND]
    return sum(
        layout.decode(frame.data)["action"] == action
        for frame in frames
        if parse_opcode(frame.id) == Opcode.COMMAND
    )


def count_setpoints(frames: list[CanFrame]) -> int:
    """Return how many setpoint frames the driver sent."""
    return sum(parse_opcode(frame.id) == Opcode.SET_POINT for frame in frames)


def _parse_frame(line: str) -> CanFrame:
    """Parse a line such as `(1700000000.000000) can0 101#0102`."""
    _, _, text = line.split()[:3]
    frame_id, _, data = text.partition("#")
    return CanFrame(int(frame_id, 16), bytes.fromhex(data))
