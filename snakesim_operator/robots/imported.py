"""What an import of a URDF is asked for, and what it returns."""

import re
from dataclasses import dataclass, field

from snakesim_hal.model.files import Table, decode
from snakesim_hal.model.robot import RobotFile

UPS = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


def plain(name: str, otherwise: str) -> str:
    """A name as a robot file may have it; otherwise: instead of an empty one."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)[:40] or otherwise


@dataclass(frozen=True)
class Order:
    """How to read a URDF."""

    tail: str | None = None  # a link at the tail; none: the root link
    up: str = "z"  # axis of the root link's frame that points up
    scale: float = 1.0  # metres per unit of length of the file
    like: str = "planar13"  # the robot file with what URDF has no words for


@dataclass
class Imported:
    """The values of a robot file, and what to know about them."""

    table: Table
    names: list[str] = field(default_factory=list[str])  # ours, and those of the URDF
    negated: list[bool] = field(default_factory=list[bool])  # for each joint: our angle is minus the URDF's
    changed: list[str] = field(default_factory=list[str])
    left_out: list[str] = field(default_factory=list[str])

    @property
    def robot(self) -> RobotFile:
        """Checked. Raises ConfigError."""
        return decode(self.table, RobotFile)
