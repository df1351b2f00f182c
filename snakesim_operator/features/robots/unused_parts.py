"""Reports what a robot file has not taken from a URDF, by kind, with every value and its lines."""

from snakesim_hal.base.errors import shorten
from snakesim_operator.features.robots.imported import ReportNotes, join_places
from snakesim_operator.features.robots.xml_tree import UnusedPart, XmlElement

MAX_VALUE = 200  # characters that are shown of one value
LOOKS_HEADING = "looks, which change nothing in a run: "
LOOK_PREFIXES = ("<visual", "<material")  # how a path continues that changes nothing in a run


def report_unused(omissions: ReportNotes, urdf: XmlElement) -> None:
    """Report every value that no function has read: first what may matter, then how the robot looks."""
    unused = list(urdf.iterate_unused())
    looks = [part for part in unused if _is_only_appearance(part)]
    _add_notes_of_unused(omissions, [part for part in unused if not _is_only_appearance(part)])
    if looks:
        outermost = dict.fromkeys(part.outermost or part.path for part in looks)
        omissions.add(f"{LOOKS_HEADING}{', '.join(map(shorten, outermost))}")
        _add_notes_of_unused(omissions, looks)


def _is_only_appearance(part: UnusedPart) -> bool:
    """Return whether a value only changes how the robot looks."""
    return any(look in part.path for look in LOOK_PREFIXES)


def _add_notes_of_unused(omissions: ReportNotes, unused: list[UnusedPart]) -> None:
    """Add a note for each kind of unused element, then one for each kind of unused value, with their line numbers.

    Parts of one kind have the same path in the file, such as `<link> <inertial> <mass value>`.

    Args:
        omissions: The notes, which are extended.
        unused: Elements, attributes and texts that the import did not read.
    """
    for path, lines in _group_lines_by_element(unused).items():
        omissions.add(f"{shorten(path)} left out: {_join_lines(lines)}")
    for path, lines_by_value in _group_lines_by_value(unused).items():
        texts: list[str] = []
        for value, lines in lines_by_value.items():
            texts.append(f"{shorten(value, MAX_VALUE)!r} ({_join_lines(lines)})")
        omissions.add(f"{shorten(path)} left out: {', '.join(texts)}")


def _group_lines_by_element(unused: list[UnusedPart]) -> dict[str, list[int]]:
    """Return the line numbers of unused elements, by their path.

    An attribute, a text or an element inside an unused element also counts for the outermost unused one around it.
    """
    lines_by_path: dict[str, list[int]] = {}
    for part in unused:
        is_inside_unused = part.outermost and part.path != part.outermost
        if is_inside_unused:
            lines = lines_by_path.setdefault(part.outermost, [])
            if part.outermost_line not in lines:
                lines.append(part.outermost_line)
        is_element = part.value is None
        if is_element:
            lines_by_path.setdefault(part.path, []).append(part.line)
    return lines_by_path


def _group_lines_by_value(unused: list[UnusedPart]) -> dict[str, dict[str, list[int]]]:
    """Return the line numbers of unused attributes and texts, by their path, and then by their value."""
    lines_by_path: dict[str, dict[str, list[int]]] = {}
    for part in unused:
        if part.value is not None:
            lines_by_value = lines_by_path.setdefault(part.path, {})
            lines_by_value.setdefault(part.value, []).append(part.line)
    return lines_by_path


def _join_lines(lines: list[int]) -> str:
    return join_places([f"line {line}" for line in lines])
