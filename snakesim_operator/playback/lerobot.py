"""A LeRobot dataset, format v3.0, of runs: an episode and a file of frames each, without images.

    meta/info.json                          features, rate, numbers of episodes and frames
    meta/stats.json                         of every feature, over all frames
    meta/tasks.parquet                      the scenarios; their names are the index, as pandas keeps it
    meta/episodes/chunk-000/file-000.parquet    where each episode is, and its own statistics
    data/chunk-000/file-000.parquet ...     its frames

`observation.state` is angle, speed and torque of every joint, then the base's position and orientation if known
throughout; `action` the targets as applied, in the unit of each joint's mode, then the modes.
Source: https://huggingface.co/docs/lerobot/lerobot-dataset-v3 and `lerobot` 0.4.4.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.errors import ConfigError
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.results.record import RunRecord

VERSION = "v3.0"
LACKS = "meta/lacks.json"  # of each episode that lacks something; not a file of LeRobot's
FILES_A_CHUNK = 1000
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA, EPISODES = f"data/{FILE}", f"meta/episodes/{FILE}".format(chunk_index=0, file_index=0)
QUANTILES = (1, 10, 50, 90, 99)  # percent
INDEX = "__index_level_0__"  # pandas' name for an index without one
COUNTED = ("frame_index", "episode_index", "index", "task_index")

Frames = dict[str, NDArray[Any]]
WriteTable = Callable[[dict[str, Any], Path, dict[bytes, bytes] | None], None]


def write_lerobot(records: Sequence[RunRecord], folder: Path, write_table: WriteTable) -> int:
    """Write the dataset. Returns how many frames. Raises ConfigError for runs that do not fit together.

    write_table: writes columns as Parquet, with metadata of the schema.
    """
    rate_hz = _common_rate_hz(records)
    tasks = list(dict.fromkeys(record.config.name for record in records))
    posed = all(bool(record.posed.all()) for record in records)
    all_frames, episodes, index = list[Frames](), list[dict[str, Any]](), 0
    for episode, record in enumerate(records):
        frames = _frames(record, posed=posed)
        count = len(record.time_s)
        frames |= {
            "timestamp": (record.time_s - record.time_s[:1]).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, episode),
            "index": np.arange(index, index + count),
            "task_index": np.full(count, tasks.index(record.config.name)),
        }
        chunk, file = divmod(episode, FILES_A_CHUNK)
        columns = {name: list(values) if values.ndim > 1 else values for name, values in frames.items()}
        write_table(columns, folder / DATA.format(chunk_index=chunk, file_index=file), None)
        row = {
            "episode_index": episode,
            "tasks": [record.config.name],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": index,
            "dataset_to_index": index + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name, values in frames.items():
            row |= {f"stats/{name}/{which}": numbers for which, numbers in _stats(values).items()}
        episodes.append(row)
        all_frames.append(frames)
        index += count
    write_table({name: [row[name] for row in episodes] for name in episodes[0]}, folder / EPISODES, None)
    columns = {"task_index": list(range(len(tasks))), INDEX: tasks}
    write_table(columns, folder / "meta" / "tasks.parquet", {b"pandas": json.dumps(_PANDAS).encode()})
    stats = {name: _stats(np.concatenate([frames[name] for frames in all_frames])) for name in all_frames[0]}
    write_text(folder / "meta" / "stats.json", json.dumps(stats, indent=2) + "\n")
    lacks = {episode: record.lacks for episode, record in enumerate(records) if record.lacks}
    if lacks:
        write_text(folder / LACKS, json.dumps(lacks, indent=2) + "\n")
    info = _info(records[0], rate_hz, posed=posed) | {
        "total_episodes": len(records),
        "total_frames": index,
        "total_tasks": len(tasks),
        "splits": {"train": f"0:{len(records)}"},
    }
    write_text(folder / "meta" / "info.json", json.dumps(info, indent=2) + "\n")
    return index


def _common_rate_hz(records: Sequence[RunRecord]) -> int:
    if any(one.description.layout != records[0].description.layout for one in records):
        raise ConfigError("the runs are of robots with different joints; a dataset is of one")
    rate_hz = records[0].config.rate_hz
    if any(one.config.rate_hz != rate_hz for one in records) or rate_hz != round(rate_hz):
        raise ConfigError("a dataset has one rate, a whole number of Hz; export the runs of each rate apart")
    empty = [one.config.name for one in records if not len(one.time_s)]
    if empty:
        raise ConfigError(f"the run of {empty[0]} has no tick after arming, so no frame; leave it out")
    return round(rate_hz)


def _info(record: RunRecord, rate_hz: int, *, posed: bool) -> dict[str, Any]:
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(names)], "names": names}
        for name, names in _names(record, posed=posed).items()
    }
    for name in ("timestamp", *COUNTED):
        features[name] = {"dtype": "int64" if name in COUNTED else "float32", "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": record.description.robot,
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate_hz,
        "data_path": DATA,
        "video_path": None,
        "features": features,
    }


def _names(record: RunRecord, *, posed: bool) -> dict[str, list[str]]:
    joints = [joint.name for joint in record.description.joints]
    state = [f"{name}.{joint}" for name in ("angle_rad", "velocity_rad_s", "torque_nm") for joint in joints]
    pose = [*(f"position_w_m.{axis}" for axis in "xyz"), *(f"orientation.{part}" for part in "wxyz")]
    return {
        "observation.state": [*state, *(pose if posed else [])],
        "action": [f"{name}.{joint}" for name in ("target", "mode") for joint in joints],
    }


def _frames(record: RunRecord, *, posed: bool) -> Frames:
    """(n, width) of each feature that a run has."""
    state = [record.angle_rad, record.velocity_rad_s, record.torque_nm]
    state += [record.position_w, record.orientation_wxyz] if posed else []
    return {
        "observation.state": np.hstack(state).astype(np.float32),
        "action": np.hstack((record.target, record.mode)).astype(np.float32),
    }


def _stats(values: NDArray[Any]) -> dict[str, list[float]]:
    wide = values.astype(np.float64).reshape(len(values), -1)
    numbers = {name: getattr(wide, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    quantiles = np.percentile(wide, QUANTILES, axis=0)
    numbers |= {f"q{percent:02d}": row.tolist() for percent, row in zip(QUANTILES, quantiles, strict=True)}
    return {**numbers, "count": [len(values)]}


_PANDAS = {  # what pandas needs to read an index: https://pandas.pydata.org/docs/development/developer.html
    "index_columns": [INDEX],
    "column_indexes": [
        {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    ],
    "columns": [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {"name": None, "field_name": INDEX, "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
    ],
    "pandas_version": "2.0.0",
}
