"""What went over a robot's bus, from the driver's own log in candump's format."""

from pathlib import Path

from snakesim_can_backend.protocol.codec import codec
from snakesim_can_backend.protocol.definitions import Action, Frame, Opcode, opcode_of


def read(path: Path) -> list[Frame]:
    """Every frame, in its order; none when nothing was logged. A last line that is torn is left out."""
    found: list[Frame] = []
    for line in path.read_text().splitlines(keepends=True) if path.is_file() else []:
        if line.endswith("\n"):
            number, _, data = line.split()[2].partition("#")
            found.append(Frame(int(number, 16), bytes.fromhex(data)))
    return found


def commands(frames: list[Frame], action: Action) -> int:
    """How many Commands of a kind the driver sent."""
    layout = codec()[Opcode.COMMAND]
    sent = [layout.values(frame.data)["action"] for frame in frames if opcode_of(frame.id) == Opcode.COMMAND]
    return sent.count(action)


def setpoints(frames: list[Frame]) -> int:
    """How many setpoints the driver sent."""
    return sum(opcode_of(frame.id) == Opcode.SET_POINT for frame in frames)
