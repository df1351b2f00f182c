"""What went over a robot's bus, from the driver's own log in candump's format."""

from pathlib import Path

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import CanFrame, CommandAction, Opcode, parse_opcode


def read(path: Path) -> list[CanFrame]:
    """Every frame, in its order; none when nothing was logged. A last line that is torn is left out."""
    found: list[CanFrame] = []
    for line in path.read_text().splitlines(keepends=True) if path.is_file() else []:
        if line.endswith("\n"):
            number, _, data = line.split()[2].partition("#")
            found.append(CanFrame(int(number, 16), bytes.fromhex(data)))
    return found


def commands(frames: list[CanFrame], action: CommandAction) -> int:
    """How many Commands of a kind the driver sent."""
    layout = load_layouts()[Opcode.COMMAND]
    sent = [
        layout.decode(frame.data)["action"]
        for frame in frames
        if parse_opcode(frame.id) == Opcode.COMMAND
    ]
    return sent.count(action)


def setpoints(frames: list[CanFrame]) -> int:
    """How many setpoints the driver sent."""
    return sum(parse_opcode(frame.id) == Opcode.SET_POINT for frame in frames)
