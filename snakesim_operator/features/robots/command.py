"""Runs `snakesim robot import` and `snakesim robot export`."""

from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import escape_invisible, print_json, print_line
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.features.robots.exporting import format_urdf, list_values_beside_urdf
from snakesim_operator.features.robots.imported import ImportOptions
from snakesim_operator.features.robots.importing import import_urdf
from snakesim_operator.features.robots.toml_text import format_toml
from snakesim_operator.features.robots.unused_parts import LOOKS_HEADING

HEADING_BY_KEY = {
    "names": "names (ours: theirs)",
    "changed": "changed",
    "assumed": "assumed, because the file does not have it",
    "doubtful": "please check",
    "left_out": "left out",
}


def import_robot(
    file: Path, options: ImportOptions, output_path: Path | None, *, as_json: bool = False
) -> int:
    """Write a robot file from a URDF, and print what the import has changed, assumed or left out.

    Args:
        file: Path of the URDF.
        options: Options of the import.
        output_path: Path of the robot file to write; None for a name made of the robot's name.
        as_json: Whether to print the report as JSON.

    Returns:
        The exit code, which is always 0.

    Raises:
        ConfigError: The URDF cannot be imported, or the robot file exists already.
    """
    result = import_urdf(file, options)
    robot = result.robot
    path = output_path or Path(f"{robot.name}.toml")
    _validate_output_path(path, ".toml", file)
    notes = [f"From {file.name}, by `snakesim robot import`."]
    for key, lines in result.report.items():
        if lines:
            notes += ["", f"{HEADING_BY_KEY[key]}:"]
            notes += [f"  {line}" for line in lines]
    comments = [escape_invisible(note) for note in notes]
    write_text(path, format_toml(result.table.values, comments))
    if as_json:
        print_json({"file": str(path), **result.report})
        return 0
    # The console shows the first notes after the heading of the file; the file has all of them.
    shown_count = _count_shown_notes(notes)
    for note in notes[1:shown_count]:
        print_line(note)
    if shown_count < len(notes):
        print_line(f"  (their text is at the top of {path})")
    print_line("")
    print_line(
        f"{path}: {robot.chain.modules} joints ({', '.join(robot.chain.axes)}), "
        f"{_compute_total_length_m(robot):.3f} m, {sum(robot.link_masses_kg):.3f} kg"
    )
    path_on_command_line = path if path.is_absolute() else f"./{path}"
    print_line(f"try it: snakesim run SCENARIO --set robot={path_on_command_line}")
    return 0


def _count_shown_notes(notes: list[str]) -> int:
    """Return how many notes the terminal shows. Values that only change the looks are in the file alone."""
    looks = [i for i, note in enumerate(notes) if note.startswith(f"  {LOOKS_HEADING}")]
    return looks[0] + 1 if looks else len(notes)


def _compute_total_length_m(robot: RobotFile) -> float:
    """Return the length between the tips of tail and head, with the rounded caps that `length_m` leaves out."""
    return robot.length_m + 2 * robot.module.radius_m


def export_robot(name: str, output_path: Path | None) -> int:
    """Write a URDF from a robot file, with the values that URDF cannot hold in elements of its own.

    Args:
        name: Name of a shipped robot, or path of a robot file.
        output_path: Path of the URDF to write; None for a name made of the robot's name.

    Returns:
        The exit code, which is always 0.

    Raises:
        ConfigError: There is no such robot, or the URDF exists already.
    """
    robot = decode_table(read_table_with_base(name, "robots"), RobotFile)
    path = output_path or Path(f"{robot.name}.urdf")
    _validate_output_path(path, ".urdf", None)
    write_text(path, format_urdf(robot))
    print_line(
        f"{path}: {robot.chain.modules + 1} links, link_0 (tail, the root) to link_{robot.chain.modules} (head)"
    )
    sections = dict.fromkeys(key.partition(".")[0] for key in list_values_beside_urdf(robot))
    print_line(f"in <snakesim> elements, which other readers skip: {', '.join(sections)}")
    return 0


def _validate_output_path(path: Path, suffix: str, source: Path | None) -> None:
    if path.suffix != suffix:
        raise ConfigError(
            f"--out {path}: give a name that ends with {suffix}", code="command/invalid-option"
        )
    if path == source or path.exists():
        raise ConfigError(
            f"{path} is there already; remove it, or give another --out", code="file/already-exists"
        )
