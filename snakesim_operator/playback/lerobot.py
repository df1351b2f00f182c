"""A LeRobot dataset, format v3.0, of episodes: a file of frames each.

    meta/info.json                          features, rate, numbers of episodes and frames
    meta/stats.json                         of every feature, over all frames
    meta/tasks.parquet                      the tasks; they are the index, as pandas keeps it
    meta/episodes/chunk-000/file-000.parquet    where each episode is, and its own statistics
    data/chunk-000/file-000.parquet ...     its frames, pictures as PNG in them

`observation.state` is angle, speed and torque of every joint, then the base's position and orientation if known
throughout; `action` the targets as applied, in the unit of each joint's mode, then the modes. `observation.images.NAME`
is the newest picture at each frame. `next.reward` is how far the robot comes on until the next frame, in m; `next.done`
is true at the last one, `next.success` there if the episode succeeded. What is not known of every episode is left out.
Source: https://huggingface.co/docs/lerobot/lerobot-dataset-v3 and `lerobot` 0.4.4.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.arrays import Floats
from snakesim_hal.errors import ConfigError
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.playback.episodes import Episode
from snakesim_operator.playback.pictures import Pictures
from snakesim_operator.results.record import RunRecord

VERSION = "v3.0"
LACKS = "meta/lacks.json"  # of each episode that lacks something; not a file of LeRobot's
FILES_A_CHUNK = 1000
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA, EPISODES = f"data/{FILE}", f"meta/episodes/{FILE}".format(chunk_index=0, file_index=0)
QUANTILES = (1, 10, 50, 90, 99)  # percent
INDEX = "__index_level_0__"  # pandas' name for an index without one
COUNTED = ("frame_index", "episode_index", "index", "task_index")

IMAGES = "observation.images."
Stats = dict[str, Any]
Frames = dict[str, NDArray[Any]]
WriteTable = Callable[[dict[str, Any], Path, dict[bytes, bytes] | None], None]


def write_lerobot(episodes: Sequence[Episode], folder: Path, write_table: WriteTable, fps: float | None = None) -> int:
    """Write the dataset. Returns how many frames. Raises ConfigError for runs that do not fit together.

    write_table: writes columns as Parquet, with metadata of the schema. fps: frames a second, a whole fraction of the
    robot's rate; None: that rate.
    """
    robot_hz = _common_rate_hz([one.record for one in episodes])
    step = _step(robot_hz, fps)
    content = _Content.of(episodes)
    tasks = list(dict.fromkeys(one.task for one in episodes))
    all_frames, listed, index = list[Frames](), list[dict[str, Any]](), 0
    picture_stats: dict[str, list[Stats]] = {name: [] for name in content.cameras}
    for number, episode in enumerate(episodes):
        rows, shown = _rows(episode, content, step)
        count = len(rows)
        frames = _frames(episode, content, rows) | {
            "timestamp": (np.arange(count) * step / robot_hz).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(index, index + count),
            "task_index": np.full(count, tasks.index(episode.task)),
        }
        chunk, file = divmod(number, FILES_A_CHUNK)
        columns: dict[str, Any] = {name: list(values) if values.ndim > 1 else values for name, values in frames.items()}
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [episode.task],
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
        for camera, at in shown.items():
            pictures = episode.pictures[camera]
            columns[IMAGES + camera] = [{"bytes": pictures.png[i], "path": f"frame-{i:06d}.png"} for i in at]
            found = _picture_stats(pictures, at)
            picture_stats[camera].append(found)
            row |= {f"stats/{IMAGES}{camera}/{which}": numbers for which, numbers in found.items()}
        write_table(columns, folder / DATA.format(chunk_index=chunk, file_index=file), None)
        listed.append(row)
        all_frames.append(frames)
        index += count
    write_table({name: [row[name] for row in listed] for name in listed[0]}, folder / EPISODES, None)
    columns = {"task_index": list(range(len(tasks))), INDEX: tasks}
    write_table(columns, folder / "meta" / "tasks.parquet", {b"pandas": json.dumps(_PANDAS).encode()})
    stats = {name: _stats(np.concatenate([frames[name] for frames in all_frames])) for name in all_frames[0]}
    stats |= {f"{IMAGES}{camera}": _together(found) for camera, found in picture_stats.items()}
    write_text(folder / "meta" / "stats.json", json.dumps(stats, indent=2) + "\n")
    lacks = {number: one.record.lacks for number, one in enumerate(episodes) if one.record.lacks}
    if lacks:
        write_text(folder / LACKS, json.dumps(lacks, indent=2) + "\n")
    info = _info(episodes[0], content, robot_hz // step) | {
        "total_episodes": len(episodes),
        "total_frames": index,
        "total_tasks": len(tasks),
        "splits": {"train": f"0:{len(episodes)}"},
    }
    write_text(folder / "meta" / "info.json", json.dumps(info, indent=2) + "\n")
    return index


@dataclass(frozen=True)
class _Content:
    """What is known of every episode."""

    posed: bool
    rewarded: bool
    judged: bool
    cameras: dict[str, tuple[int, int]]  # width and height

    @staticmethod
    def of(episodes: Sequence[Episode]) -> "_Content":
        sizes = [{name: (p.width, p.height) for name, p in one.pictures.items() if p.ticks} for one in episodes]
        return _Content(
            posed=all(bool(one.record.posed.all()) for one in episodes),
            rewarded=all(one.reward_m is not None for one in episodes),
            judged=all(one.success is not None for one in episodes),
            cameras=dict(sorted(set(sizes[0].items()).intersection(*(set(one.items()) for one in sizes)))),
        )


def _step(robot_hz: int, fps: float | None) -> int:
    """Ticks from frame to frame."""
    if fps is None:
        return 1
    step = max(round(robot_hz / fps), 1)
    if fps != round(fps) or robot_hz != step * fps:
        allowed = ", ".join(str(hz) for hz in range(1, robot_hz + 1) if robot_hz % hz == 0)
        raise ConfigError(f"--fps {fps:g}: of a robot at {robot_hz} Hz give one of {allowed}")
    return step


def _rows(episode: Episode, content: _Content, step: int) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]]]:
    """The rows that become frames, and the newest picture of each camera there. Raises ConfigError.

    They begin where every camera has shown something.
    """
    record = episode.record
    ticks = np.rint(record.time_s * 1e9 / record.description.period_ns).astype(np.int64)
    newest = {
        camera: np.searchsorted(np.array(episode.pictures[camera].ticks), ticks, side="right") - 1
        for camera in content.cameras
    }
    seen = np.logical_and.reduce([np.ones(len(ticks), dtype=bool), *(at >= 0 for at in newest.values())])
    if not seen.any():
        raise ConfigError(f"{record.folder}: no picture came while it was armed; export it without --images")
    rows = np.arange(int(np.argmax(seen)), len(ticks), step)
    return rows, {camera: at[rows] for camera, at in newest.items()}


def _common_rate_hz(records: Sequence[RunRecord]) -> int:
    if any(one.description.layout != records[0].description.layout for one in records):
        raise ConfigError("the runs are of robots with different joints; a dataset is of one")
    rate_hz = records[0].config.rate_hz
    if any(one.config.rate_hz != rate_hz for one in records) or rate_hz != round(rate_hz):
        raise ConfigError("a dataset has one rate, a whole number of Hz; export the runs of each rate apart")
    empty = [one.folder for one in records if not len(one.time_s)]
    if empty:
        raise ConfigError(f"{empty[0]} has no tick after arming, so no frame; leave it out")
    return round(rate_hz)


def _info(episode: Episode, content: _Content, fps: int) -> dict[str, Any]:
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(names)], "names": names}
        for name, names in _names(episode.record, posed=content.posed).items()
    }
    for camera, (width, height) in content.cameras.items():
        shape = {"shape": [height, width, 3], "names": ["height", "width", "channels"]}
        features[IMAGES + camera] = {"dtype": "image", **shape}
    kinds = {"timestamp": "float32", **dict.fromkeys(COUNTED, "int64"), "next.done": "bool"}
    kinds |= {"next.reward": "float32"} if content.rewarded else {}
    kinds |= {"next.success": "bool"} if content.judged else {}
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()}
    return {
        "codebase_version": VERSION,
        "robot_type": episode.record.description.robot,
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
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


def _frames(episode: Episode, content: _Content, rows: NDArray[np.int64]) -> Frames:
    """(n, width) or (n,) of each feature of its own, without pictures."""
    record = episode.record
    state = [record.angle_rad, record.velocity_rad_s, record.torque_nm]
    state += [record.position_w, record.orientation_wxyz] if content.posed else []
    done = np.arange(len(rows)) == len(rows) - 1
    frames: Frames = {
        "observation.state": np.hstack(state)[rows].astype(np.float32),
        "action": np.hstack((record.target, record.mode))[rows].astype(np.float32),
        "next.done": done,
    }
    if content.rewarded and episode.reward_m is not None:
        frames["next.reward"] = np.add.reduceat(episode.reward_m, rows).astype(np.float32)
    if content.judged:
        frames["next.success"] = done & bool(episode.success)
    return frames


def _stats(values: NDArray[Any]) -> dict[str, list[float]]:
    wide = values.astype(np.float64).reshape(len(values), -1)
    numbers = {name: getattr(wide, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    quantiles = np.percentile(wide, QUANTILES, axis=0)
    numbers |= {f"q{percent:02d}": row.tolist() for percent, row in zip(QUANTILES, quantiles, strict=True)}
    return {**numbers, "count": [len(values)]}


def _picture_stats(pictures: Pictures, at: NDArray[np.int64]) -> Stats:
    """Of each channel, 0 to 1, over the pictures of these frames; quantiles are not made of pictures."""
    mean = np.array(pictures.channel_means)[at].mean(axis=0)
    squares = np.array(pictures.channel_squares)[at].mean(axis=0)
    return _of_channels(pictures.least, pictures.most, mean, squares, len(at))


def _together(found: Sequence[Stats]) -> Stats:
    """Of all episodes."""
    least, most, means, stds = (
        np.array([one[name] for one in found]).reshape(-1, 3) for name in ("min", "max", "mean", "std")
    )
    weights = np.array([one["count"][0] for one in found])
    mean = np.average(means, axis=0, weights=weights)
    squares = np.average(np.square(stds) + np.square(means), axis=0, weights=weights)
    return _of_channels(least.min(axis=0), most.max(axis=0), mean, squares, int(weights.sum()))


def _of_channels(least: Floats, most: Floats, mean: Floats, squares: Floats, count: int) -> Stats:
    """squares: means of the squares; all are (3,)."""
    numbers = {"min": least, "max": most, "mean": mean, "std": np.sqrt(np.maximum(squares - np.square(mean), 0.0))}
    return {**{name: value.reshape(3, 1, 1).tolist() for name, value in numbers.items()}, "count": [count]}


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
