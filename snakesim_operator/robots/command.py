"""`snakesim robot import` and `snakesim robot export`."""

from pathlib import Path

from snakesim_hal.errors import ConfigError
from snakesim_hal.model.files import decode, read_part
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.terminal import printable, say, say_json
from snakesim_operator.robots.exporting import urdf_of
from snakesim_operator.robots.imported import Imported, Order
from snakesim_operator.robots.importing import robot_of
from snakesim_operator.robots.toml_text import toml_of

HEADS = {"names": "names (ours: theirs)", "changed": "changed", "left_out": "left out"}


def import_robot(file: Path, order: Order, out: Path | None, *, as_json: bool = False) -> int:
    """Write a robot file from a URDF, and say what differs. Raises ConfigError."""
    found = robot_of(file, order)
    path = out or Path(f"{found.robot.name}.toml")
    _check_new(path, ".toml", file)
    notes = [f"From {file.name}, by `snakesim robot import`."]
    for key, lines in _as_json(found).items():
        notes += ["", f"{HEADS[key]}:", *(f"  {line}" for line in lines)] if lines else []
    write_text(path, toml_of(found.table.values, [printable(note) for note in notes]))
    if as_json:
        say_json({"file": str(path), **_as_json(found)})
        return 0
    for note in notes[1:]:
        say(note)
    robot = found.robot
    say("")
    say(
        f"{path}: {robot.chain.modules} joints ({', '.join(robot.chain.axes)}), {robot.length_m:.3f} m, "
        f"{sum(robot.link_masses_kg):.3f} kg"
    )
    say(f"try it: snakesim run SCENARIO --set robot={path if path.is_absolute() else f'./{path}'}")
    return 0


def _as_json(found: Imported) -> dict[str, list[str]]:
    return {"names": found.names, "changed": found.changed, "left_out": found.left_out}


def export_robot(name: str, out: Path | None) -> int:
    """Write a URDF from a robot file. Raises ConfigError."""
    robot = decode(read_part(name, "robots"), RobotFile)
    path = out or Path(f"{robot.name}.urdf")
    _check_new(path, ".urdf", None)
    write_text(path, urdf_of(robot))
    say(f"{path}: {robot.chain.modules + 1} links, link_0 (tail, the root) to link_{robot.chain.modules} (head)")
    return 0


def _check_new(path: Path, suffix: str, source: Path | None) -> None:
    if path.suffix != suffix:
        raise ConfigError(f"--out {path}: give a name that ends with {suffix}")
    if path == source or path.exists():
        raise ConfigError(f"{path} is there already; remove it, or give another --out")
