"""The options of an import of a URDF, and its result: values of a robot file, and a report on them."""

import re
from dataclasses import dataclass, field

from snakesim_hal.base.errors import shorten
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.robots.xml_tree import XmlElement

VECTOR_BY_UP_AXIS = {
    "x": (1, 0, 0),
    "y": (0, 1, 0),
    "z": (0, 0, 1),
    "-x": (-1, 0, 0),
    "-y": (0, -1, 0),
    "-z": (0, 0, -1),
}


@dataclass(frozen=True)
class ImportOptions:
    """How to read a URDF."""

    tail: str | None = None  # a link at the tail; none: the root link
    up: str = "z"  # axis of the root link's frame that points up
    scale: float = 1.0  # meters per unit of length of the file
    like: str = "planar13"  # the robot file with what URDF has no words for


class ReportNotes:
    """Sentences of a report. The same sentence stands once, with all the places in the file that it holds for."""

    def __init__(self) -> None:
        self._places: dict[str, list[str]] = {}

    def add(self, sentence: str, *places: str) -> None:
        """Add a sentence, and the places that it is about, such as `line 12`."""
        known = self._places.setdefault(sentence, [])
        known.extend(place for place in places if place not in known)

    def format_lines(self) -> list[str]:
        """Return every sentence with its places, in the order in which they were added."""
        lines: list[str] = []
        for sentence, places in self._places.items():
            lines.append(f"{sentence}: {join_places(places)}" if places else sentence)
        return lines


def join_places(places: list[str]) -> str:
    """Return places as text; if all are lines, they share one word, as in `lines 5, 12`."""
    if len(places) > 1 and all(place.startswith("line ") for place in places):
        return f"lines {', '.join(place.removeprefix('line ') for place in places)}"
    return ", ".join(places)


@dataclass
class ImportResult:
    """What an import of a URDF yields: the values of a robot file, and the report on how they were found.

    The functions of an import get this object, and add their values and their lines of the report to it.
    """

    table: ConfigTable  # the values of the robot file
    names: list[str] = field(default_factory=list[str])  # ours, and those of the URDF
    # For each joint: our angle is minus the URDF's.
    is_negated: list[bool] = field(default_factory=list[bool])
    # Values of the file that became others.
    changes: ReportNotes = field(default_factory=ReportNotes)
    # Values that the file does not give.
    assumptions: ReportNotes = field(default_factory=ReportNotes)
    # Values that are allowed, and unusual for a snake robot.
    doubts: ReportNotes = field(default_factory=ReportNotes)
    # What is in the file and not in the robot file.
    omissions: ReportNotes = field(default_factory=ReportNotes)

    @property
    def changed(self) -> list[str]:
        """Values of the file that became others, as lines."""
        return self.changes.format_lines()

    @property
    def assumed(self) -> list[str]:
        """Values that the file does not give, as lines."""
        return self.assumptions.format_lines()

    @property
    def doubtful(self) -> list[str]:
        """Values that a person should check, as lines."""
        return self.doubts.format_lines()

    @property
    def left_out(self) -> list[str]:
        """What is in the file and not in the robot file, as lines."""
        return self.omissions.format_lines()

    @property
    def report(self) -> dict[str, list[str]]:
        """All lines of the report, by their heading for scripts."""
        return {
            "names": self.names,
            "changed": self.changed,
            "assumed": self.assumed,
            "doubtful": self.doubtful,
            "left_out": self.left_out,
        }

    @property
    def robot(self) -> RobotFile:
        """The checked robot file.

        Raises:
            ConfigError: A value is not allowed in a robot file.
        """
        return decode_table(self.table, RobotFile)

    def make_plain_name(self, name: str, default: str, element: XmlElement) -> str:
        """Return a name as a robot file may have it. A change is reported.

        Args:
            name: The name in the URDF.
            default: Replaces an empty name.
            element: The element that has the name.
        """
        allowed = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:40] or default
        if allowed != name:
            self.changes.add(
                f"<{element.tag} name> {shorten(name)!r} became {allowed!r}: letters, digits, _ and -, 40 at most",
                element.place,
            )
        return allowed
