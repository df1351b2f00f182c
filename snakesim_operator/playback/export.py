"""`snakesim export`: a run as a table (CSV, Parquet), as arrays (NumPy), as a LeRobot dataset, or a whole MCAP file.

A table has a row for each tick since the first arming. Its columns have the units in their names, and what they are of
behind a dot: `angle_rad.joint_1`, `position_w_m.x`. What is not known is empty (CSV, Parquet) or NaN.
"""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.errors import ConfigError
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.terminal import Say
from snakesim_operator.playback.info import recording_of
from snakesim_operator.recording.recover import recover
from snakesim_operator.results.record import RunRecord

FORMATS = ("csv", "parquet", "npz", "lerobot", "mcap")
OF_JOINTS = ("angle_rad", "velocity_rad_s", "torque_nm", "mode", "target", "torque_limit_nm")
LEROBOT = "v2.1"
EPISODES_A_CHUNK = 1000
DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"


def export(runs: Sequence[Path], form: str, out: Path | None, say: Say) -> int:
    """Write runs in a format. Several make a LeRobot dataset, an episode each. Raises ConfigError."""
    if len(runs) > 1 and form != "lerobot":
        raise ConfigError(f"--format {form}: one run at a time; several make a dataset, with --format lerobot")
    path = out or _beside(runs[0], form)
    if path.exists():
        raise ConfigError(f"{path}: there is such a file already; choose another one with --out")
    if form == "mcap":
        say(f"{recover(recording_of(runs[0]), path)} messages: {path}")
        return 0
    records = [RunRecord.load(run) for run in runs]
    if form == "lerobot":
        frames = write_lerobot(records, path)
        say(f"{len(records)} episodes, {frames} frames: {path}")
        return 0
    record = records[0]
    if form == "npz":
        content: dict[str, Any] = {**arrays(record), "joints": np.array([j.name for j in record.description.joints])}
        np.savez_compressed(path, **content)
    elif form == "csv":
        _write_csv(table(record), path)
    else:
        _write_parquet({name: values.tolist() for name, values in table(record).items()}, path)
    say(f"{len(record.time_s)} ticks: {path}")
    return 0


def _beside(run: Path, form: str) -> Path:
    name = run / "export" if run.is_dir() else run.with_suffix("")
    return name.with_name(f"{name.name}-lerobot") if form == "lerobot" else name.with_suffix(f".{form}")


def arrays(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Every column as an array, (n,) or (n, width)."""
    return {name: value for name, value in vars(record).items() if isinstance(value, np.ndarray) and name != "posed"}


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


def _write_csv(columns: dict[str, NDArray[Any]], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            writer.writerow(["" if value != value else value for value in row])


def _write_parquet(columns: dict[str, Any], path: Path, schema: Any = None) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ConfigError("this format needs pyarrow: pip install 'snakesim[export]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(columns, schema=schema), path)


def write_lerobot(records: Sequence[RunRecord], folder: Path) -> int:
    """A LeRobot dataset (v2.1, without images): an episode a run. Returns how many frames.

    `observation.state` is angle, speed and torque of every joint, then the base's position and orientation if known
    throughout; `action` the targets as applied, in the unit of each joint's mode, then the modes.
    """
    first = records[0]
    if any(one.description.layout != first.description.layout for one in records):
        raise ConfigError("the runs are of robots with different joints; a dataset is of one")
    rate_hz = first.config.rate_hz
    if any(one.config.rate_hz != rate_hz for one in records) or rate_hz != round(rate_hz):
        raise ConfigError("a dataset has one rate, a whole number of Hz; export the runs of each rate apart")
    tasks = list(dict.fromkeys(record.config.name for record in records))
    posed = all(bool(record.posed.all()) for record in records)
    episodes: list[dict[str, Any]] = []
    stats: list[dict[str, Any]] = []
    index = 0
    for episode, record in enumerate(records):
        frames = _frames(record, posed=posed)
        count = len(record.time_s)
        columns = {
            **{name: list(values) for name, values in frames.items()},
            "timestamp": ((record.time_s - record.time_s[:1]).astype(np.float32)),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, episode),
            "index": np.arange(index, index + count),
            "task_index": np.full(count, tasks.index(record.config.name)),
        }
        path = DATA_PATH.format(episode_chunk=episode // EPISODES_A_CHUNK, episode_index=episode)
        _write_parquet(columns, folder / path)
        episodes.append({"episode_index": episode, "tasks": [record.config.name], "length": count})
        stats.append({"episode_index": episode, "stats": {name: _stats(values) for name, values in frames.items()}})
        index += count
    features = {name: _feature(names) for name, names in _names(first, posed=posed).items()}
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
    info = {
        "codebase_version": LEROBOT,
        "robot_type": first.description.robot,
        "total_episodes": len(records),
        "total_frames": index,
        "total_tasks": len(tasks),
        "total_videos": 0,
        "total_chunks": (len(records) - 1) // EPISODES_A_CHUNK + 1,
        "chunks_size": EPISODES_A_CHUNK,
        "fps": round(rate_hz),
        "splits": {"train": f"0:{len(records)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }
    write_text(folder / "meta" / "info.json", json.dumps(info, indent=2) + "\n")
    told = [{"task_index": i, "task": task} for i, task in enumerate(tasks)]
    for name, rows in (("tasks", told), ("episodes", episodes), ("episodes_stats", stats)):
        write_text(folder / "meta" / f"{name}.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
    return index


def _names(record: RunRecord, *, posed: bool) -> dict[str, list[str]]:
    joints = [joint.name for joint in record.description.joints]
    state = [f"{name}.{joint}" for name in ("angle_rad", "velocity_rad_s", "torque_nm") for joint in joints]
    pose = [*(f"position_w_m.{axis}" for axis in "xyz"), *(f"orientation.{part}" for part in "wxyz")]
    return {
        "observation.state": [*state, *(pose if posed else [])],
        "action": [f"{name}.{joint}" for name in ("target", "mode") for joint in joints],
    }


def _frames(record: RunRecord, *, posed: bool) -> dict[str, NDArray[np.float32]]:
    """(n, width) of each feature."""
    state = [record.angle_rad, record.velocity_rad_s, record.torque_nm]
    state += [record.position_w, record.orientation_wxyz] if posed else []
    return {
        "observation.state": np.hstack(state).astype(np.float32),
        "action": np.hstack((record.target, record.mode)).astype(np.float32),
    }


def _feature(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def _stats(values: NDArray[np.float32]) -> dict[str, Any]:
    wide = values.astype(np.float64)
    numbers = {name: getattr(wide, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return {**numbers, "count": [len(values)]}
