"""`snakesim recording export`: a run as a table (CSV, Parquet), as arrays (NumPy), a LeRobot dataset or a whole MCAP.

A table has a row for each tick since the first arming. Its columns have the units in their names, and what they are of
behind a dot: `angle_rad.joint_1`, `position_w_m.x`. What is not known is empty (CSV, Parquet) or NaN. Each format
states in its own way which data is missing.
"""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import PrintLine, escape_invisible
from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.playback.episodes import describe_gaps, read_episodes
from snakesim_operator.playback.lerobot import write_lerobot
from snakesim_operator.recording.log_clock import LogTimeClock
from snakesim_operator.recording.recover import recover_recording
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import find_recording_path
from snakesim_operator.results.signals import (
    PARQUET_UNIT,
    compute_signals,
    find_unit,
    make_signal_columns,
)

MISSING_METADATA_KEY = b"snakesim.missing"  # metadata of a Parquet file: JSON


def export_run(
    runs: Sequence[Path],
    form: str,
    out: Path | None,
    print_text: PrintLine,
    stamps: LogTimeClock | None = None,
) -> int:
    """Export one run as a file in another format.

    Args:
        runs: The run, as the only item.
        form: Format of the file: "csv", "parquet" or "npz" for a row per tick, "mcap" for a recording.
        out: Path of the file; None for a file beside the recording.
        print_text: Prints a line.
        stamps: With "mcap", the clock of the timestamps in the file; None to keep those of the recording.

    Returns:
        The exit code: 3 if the run is incomplete, otherwise 0.

    Raises:
        ConfigError: There are several runs, the run cannot be read, or the file cannot be written.
    """
    if len(runs) > 1:
        raise ConfigError(
            f"--format {form}: one run at a time; several make a dataset, with --format lerobot",
            code="command/invalid-option",
        )
    run = runs[0]
    path = _check_output_path(out or _default_path(run, form))
    if form == "mcap":
        with export_atomically(path) as partial:
            message_count, missing = recover_recording(find_recording_path(run), partial, stamps)
        print_text(f"{message_count} messages: {path}")
        return report_missing_data(run, missing)

    record = RunRecord.load(run)
    with export_atomically(path) as partial:
        match form:
            case "npz":
                _write_npz(record, partial)
            case "csv":
                _write_csv(make_signal_columns(record), partial, record.missing)
            case _:
                columns = {
                    name: values.tolist() for name, values in make_signal_columns(record).items()
                }
                units = {name: find_unit(name, record) for name in columns}
                metadata = None
                if record.missing:
                    metadata = {MISSING_METADATA_KEY: json.dumps(record.missing).encode()}
                write_parquet(columns, partial, metadata, units)
    print_text(f"{len(record.time_s)} ticks: {path}")
    return report_missing_data(run, record.missing)


def export_dataset(
    runs: Sequence[Path],
    out: Path | None,
    print_text: PrintLine,
    *,
    images: bool,
    task: str | None,
    fps: float | None,
) -> int:
    """Export runs as a LeRobot dataset: an episode for each run or demonstration, and one more for each gap in it.

    Args:
        runs: Folders of runs or demonstrations, or recordings.
        out: Folder of the dataset; None for a folder beside the first run.
        print_text: Prints a line.
        images: Whether the images of the cameras are included.
        task: Task of all episodes in words; None for the task that each run names.
        fps: Frames per second; None for the control rate of the robot.

    Returns:
        The exit code: 3 if a run is incomplete, otherwise 0.

    Raises:
        ConfigError: A run cannot be read, the runs do not fit together, or the folder cannot be written.
    """
    path = _check_output_path(out or _default_path(runs[0], "lerobot"))
    episodes = read_episodes(runs, task, images=images)
    with export_atomically(path) as partial:
        size = write_lerobot(episodes, partial, write_parquet, fps)
    for sentence in describe_gaps(episodes):
        print_text(sentence)
    print_text(f"{size.episodes} episodes, {size.frames} frames: {path}")
    codes = [
        report_missing_data(episode.record.path, episode.record.missing) for episode in episodes
    ]
    return max(codes)


def _check_output_path(path: Path) -> Path:
    """Check that a path can be written and does not exist yet, and return it. Raises ConfigError otherwise."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Checked before minutes of work; does not follow a symbolic link.
        path.touch(exist_ok=False)
        path.unlink()
    except FileExistsError:
        what = "a symbolic link" if path.is_symlink() else "such a file"
        raise ConfigError(
            f"{path}: there is {what} already; choose another one with --out",
            code="file/already-exists",
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {error.strerror}; choose another one with --out",
            code="file/not-writable",
        ) from None
    return path


def _default_path(run: Path, form: str) -> Path:
    """Return the default path of an export: in the folder of the run, or beside a recording."""
    base = run / "export" if run.is_dir() else run.with_suffix("")
    if form == "lerobot":
        return base.with_name(f"{base.name}-lerobot")
    return base.with_suffix(f".{form}")


def _write_npz(record: RunRecord, path: Path) -> None:
    joints = np.array([joint.name for joint in record.description.joints])
    missing = np.array(record.missing, dtype=str)
    names: dict[str, Any] = {"joints": joints, "missing": missing}
    with path.open("xb") as file:
        np.savez_compressed(file, **compute_signals(record), **names)


def _write_csv(columns: dict[str, NDArray[Any]], path: Path, missing: Sequence[str]) -> None:
    with path.open("x", newline="", encoding="utf-8") as file:
        for sentence in missing:
            file.write(f"# incomplete: {escape_invisible(sentence)}\n")
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            # NaN is not equal to itself.
            writer.writerow(["" if value != value else value for value in row])


def write_parquet(
    columns: dict[str, Any],
    path: Path,
    metadata: dict[bytes, bytes] | None = None,
    units: Mapping[str, str] | None = None,
) -> None:
    """Write columns as a Parquet file. Needs the extra `report`.

    Args:
        columns: Values of each column by name.
        path: Path of the file.
        metadata: Metadata of the schema.
        units: Unit of each column by name, stored as metadata of the column; None for columns without units.
    """
    import pyarrow
    import pyarrow.parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    table_of_columns = pyarrow.table(columns)
    fields = list(table_of_columns.schema)
    if units is not None:
        fields = [
            field.with_metadata({PARQUET_UNIT: units[field.name].encode()}) for field in fields
        ]
    schema = pyarrow.schema(fields, metadata=metadata)
    pyarrow.parquet.write_table(table_of_columns.cast(schema), path)
