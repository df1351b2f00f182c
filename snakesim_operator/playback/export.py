"""`snakesim export`: a run as a table (CSV, Parquet), as arrays (NumPy), as a LeRobot dataset, or a whole MCAP file.

A table has a row for each tick since the first arming. Its columns have the units in their names, and what they are of
behind a dot: `angle_rad.joint_1`, `position_w_m.x`. What is not known is empty (CSV, Parquet) or NaN. What the record
lacks is told in each format's own way.
"""

import csv
import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import Say, printable
from snakesim_hal.model.textfiles import exported
from snakesim_hal.wire.own_sample import own_kinds
from snakesim_operator.playback.episodes import gaps_in_words, read_episodes
from snakesim_operator.playback.info import recording_of
from snakesim_operator.playback.lerobot import write_lerobot
from snakesim_operator.recording.recover import recover
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.record import RunRecord

LACKS = b"snakesim.lacks"  # metadata of a Parquet file: JSON
OF_JOINTS = ("angle_rad", "velocity_rad_s", "torque_nm", "mode", "target", "torque_limit_nm")
UNITS = {
    "time_s": "s",
    "age_s": "s",
    "angle_rad": "rad",
    "velocity_rad_s": "rad/s",
    "torque_nm": "N·m",
    "mode": "1",
    "target": "rad, rad/s or N·m, by mode",
    "torque_limit_nm": "N·m",
    "position_w": "m",
    "position_w_m": "m",
    "orientation_wxyz": "1",
    "contact_peak_n": "N",
    "contact_count": "1",
}


def export(runs: Sequence[Path], form: str, out: Path | None, say: Say) -> int:
    """Write a run in a format. Raises ConfigError."""
    if len(runs) > 1:
        raise ConfigError(f"--format {form}: one run at a time; several make a dataset, with --format lerobot")
    path = _free(out or _beside(runs[0], form))
    if form == "mcap":
        with exported(path) as partial:
            count, lacks = recover(recording_of(runs[0]), partial)
        say(f"{count} messages: {path}")
        return exit_code(runs[0], lacks)
    record = RunRecord.load(runs[0])
    if form == "npz":
        names: dict[str, Any] = {"joints": np.array([joint.name for joint in record.description.joints])}
        lacks_of_npz = np.array(record.lacks, dtype=str)
        with exported(path) as partial, partial.open("xb") as file:
            np.savez_compressed(file, **arrays(record), **names, lacks=lacks_of_npz)
    elif form == "csv":
        with exported(path) as partial:
            _write_csv(table(record), partial, record.lacks)
    else:
        columns = {name: values.tolist() for name, values in table(record).items()}
        metadata = {LACKS: json.dumps(record.lacks).encode()} if record.lacks else None
        with exported(path) as partial:
            write_parquet(columns, partial, metadata)
    say(f"{len(record.time_s)} ticks: {path}")
    return exit_code(runs[0], record.lacks)


def export_dataset(
    runs: Sequence[Path], out: Path | None, say: Say, *, images: bool, task: str | None, fps: float | None
) -> int:
    """Writes a LeRobot dataset, an episode a run or demonstration, and one more for each gap. Raises ConfigError."""
    path = _free(out or _beside(runs[0], "lerobot"))
    episodes = read_episodes(runs, task, images=images)
    with exported(path) as partial:
        size = write_lerobot(episodes, partial, write_parquet, fps)
    for sentence in gaps_in_words(episodes):
        say(sentence)
    say(f"{size.episodes} episodes, {size.frames} frames: {path}")
    return max(exit_code(one.record.folder, one.record.lacks) for one in episodes)


def _free(path: Path) -> Path:
    """A path that can be written, where nothing is yet. Raises ConfigError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch(exist_ok=False)  # before the work of minutes; not through a link, wherever it leads
        path.unlink()
    except FileExistsError:
        what = "a symbolic link" if path.is_symlink() else "such a file"
        raise ConfigError(f"{path}: there is {what} already; choose another one with --out") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; choose another one with --out") from None
    return path


def _beside(run: Path, form: str) -> Path:
    name = run / "export" if run.is_dir() else run.with_suffix("")
    return name.with_name(f"{name.name}-lerobot") if form == "lerobot" else name.with_suffix(f".{form}")


def arrays(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Every column as an array, (n,) or (n, width)."""
    found: dict[str, NDArray[Any]] = {}
    for column in fields(record):  # not `vars`: that has what the record has worked out, too
        value = getattr(record, column.name)
        if isinstance(value, np.ndarray):
            found[column.name] = value
    return found | record.own


def unit_of(name: str, record: RunRecord) -> str:
    """Of a column, or of all of a signal."""
    what = name.partition(".")[0]
    own = {field: unit for kind in own_kinds(record.description).values() for field, unit in kind.units.items()}
    return {**own, **UNITS}[what]


def table(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Every column as numbers, (n,)."""
    joints = [joint.name for joint in record.description.joints]
    found: dict[str, NDArray[Any]] = {}
    for name, values in arrays(record).items():
        if values.ndim == 1:
            found[name] = values
            continue
        unit = "_m" if name == "position_w" else ""
        parts = joints if name in OF_JOINTS else "xyz" if name == "position_w" else "wxyz"
        found |= {f"{name}{unit}.{part}": values[:, i] for i, part in enumerate(parts)}
    return found


def _write_csv(columns: dict[str, NDArray[Any]], path: Path, lacks: Sequence[str]) -> None:
    with path.open("x", newline="", encoding="utf-8") as file:
        for lack in lacks:
            file.write(f"# incomplete: {printable(lack)}\n")
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            writer.writerow(["" if value != value else value for value in row])


def write_parquet(columns: dict[str, Any], path: Path, metadata: dict[bytes, bytes] | None = None) -> None:
    """Columns as a Parquet file. metadata: of the schema. Needs the extra `export`."""
    import pyarrow
    import pyarrow.parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(columns).replace_schema_metadata(metadata), path)
