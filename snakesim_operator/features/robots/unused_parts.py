"""What a robot file has not taken from a URDF, by kind, with every value and its lines."""

from snakesim_hal.base.errors import short
from snakesim_operator.features.robots.imported import Notes, joined
from snakesim_operator.features.robots.xml_tree import Element, Unused

MAX_VALUE = 200  # characters that are shown of one value
LOOKS_HEADING = "looks, which change nothing in a run: "
LOOKS = ("<visual", "<material")  # how a path goes on that changes nothing in a run


def report_unused(omissions: Notes, urdf: Element) -> None:
    """Report every value that no function has read: first what may matter, then how the robot looks."""
    unused = list(urdf.unused())
    looks = [one for one in unused if _is_look(one)]
    _report(omissions, [one for one in unused if not _is_look(one)])
    if looks:
        outermost = dict.fromkeys(one.outermost or one.path for one in looks)
        omissions.add(f"{LOOKS_HEADING}{', '.join(map(short, outermost))}")
        _report(omissions, looks)


def _is_look(one: Unused) -> bool:
    return any(look in one.path for look in LOOKS)


def _report(omissions: Notes, unused: list[Unused]) -> None:
    """A line for each kind of element with its lines, then one for each kind of value in it."""
    elements: dict[str, list[int]] = {}
    values: dict[str, dict[str, list[int]]] = {}
    for one in unused:
        if one.outermost and one.path != one.outermost:
            lines = elements.setdefault(one.outermost, [])
            if one.outermost_line not in lines:
                lines.append(one.outermost_line)
        if one.value is None:
            elements.setdefault(one.path, []).append(one.line)
        else:
            values.setdefault(one.path, {}).setdefault(one.value, []).append(one.line)
    for path, lines in elements.items():
        omissions.add(f"{short(path)} left out: {_lines(lines)}")
    for path, found in values.items():
        shown = [f"{short(value, MAX_VALUE)!r} ({_lines(lines)})" for value, lines in found.items()]
        omissions.add(f"{short(path)} left out: {', '.join(shown)}")


def _lines(lines: list[int]) -> str:
    return joined([f"line {line}" for line in lines])
