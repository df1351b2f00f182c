"""A LeRobot dataset, format v3.0, of episodes: a file of frames each. A gap in a recording ends an episode.

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

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.playback.episodes import Episode
from snakesim_operator.playback.lerobot_statistics import (
    Statistics,
    compute_feature_statistics,
    compute_picture_statistics,
    merge_picture_statistics,
)
from snakesim_operator.results.run_log import RunRecord

VERSION = "v3.0"
MISSING = "meta/missing.json"  # of each incomplete episode; LeRobot knows no such file
FILES_A_CHUNK = 1000
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = f"data/{FILE}"
EPISODES = f"meta/episodes/{FILE}".format(chunk_index=0, file_index=0)
INDEX = "__index_level_0__"  # pandas' name for an index without one
COUNTED = ("frame_index", "episode_index", "index", "task_index")

IMAGES = "observation.images."
Frames = dict[str, NDArray[Any]]
WriteTable = Callable[[dict[str, Any], Path, dict[bytes, bytes] | None], None]


@dataclass(frozen=True)
class DatasetSize:
    """What was written."""

    episodes: int
    frames: int


def write_lerobot(
    episodes: Sequence[Episode], folder: Path, write_table: WriteTable, fps: float | None = None
) -> DatasetSize:
    """Write episodes as a dataset in the format of LeRobot.

    Args:
        episodes: Runs, or parts of runs between gaps.
        folder: Folder of the dataset.
        write_table: Writes columns as a Parquet file, with metadata of its schema.
        fps: Frames per second, a divisor of the robot's rate; None: the robot's rate.

    Returns:
        The number of episodes and frames that were written. Episodes without a frame are left out.

    Raises:
        ConfigError: The runs do not fit together, or a run has no frame.
    """
    robot_hz = _common_rate_hz([episode.record for episode in episodes])
    ticks_per_frame = _step(robot_hz, fps)
    content = _Content.from_episodes(episodes)
    dataset = _Dataset(folder, write_table, content, seconds_per_frame=ticks_per_frame / robot_hz)

    frames_by_episode = [_rows(episode, content, ticks_per_frame) for episode in episodes]
    folders_with_frames: set[Path] = set()
    for episode, (rows, _) in zip(episodes, frames_by_episode, strict=True):
        if len(rows):
            folders_with_frames.add(episode.record.folder)
    for episode in episodes:
        if episode.record.folder not in folders_with_frames:
            raise ConfigError(
                f"{episode.record.folder}: no picture came while it was armed; export it without --images",
                code="recording/missing-data",
            )

    for episode, (rows, picture_numbers) in zip(episodes, frames_by_episode, strict=True):
        if len(rows):
            dataset.add(episode, rows, picture_numbers)
    dataset.finish(_info(episodes[0], content, robot_hz // ticks_per_frame))
    return DatasetSize(len(dataset.rows), dataset.frame_count)


class _Dataset:
    """The files of a dataset, written episode by episode."""

    def __init__(self, folder: Path, write_table: WriteTable, content: "_Content", *, seconds_per_frame: float) -> None:
        self._folder = folder
        self._write_table = write_table
        self._content = content
        self._seconds_per_frame = seconds_per_frame
        self._tasks: list[str] = []
        self._frames: list[Frames] = []  # of each episode
        self._picture_statistics: dict[str, list[Statistics]] = {camera: [] for camera in content.cameras}
        self._records: list[RunRecord] = []  # of each episode
        self.rows: list[dict[str, Any]] = []  # of meta/episodes, one for each episode
        self.frame_count = 0

    def add(self, episode: Episode, rows: NDArray[np.int64], shown: dict[str, NDArray[np.int64]]) -> None:
        """Writes the frames of an episode.

        Args:
            episode: What they are of.
            rows: Rows of its record that become frames.
            shown: By camera, which picture each of the frames shows.
        """
        number = len(self.rows)
        count = len(rows)
        if episode.task not in self._tasks:
            self._tasks.append(episode.task)
        frames = _frames(episode, self._content, rows)
        frames["timestamp"] = (np.arange(count) * self._seconds_per_frame).astype(np.float32)
        frames["frame_index"] = np.arange(count)
        frames["episode_index"] = np.full(count, number)
        frames["index"] = np.arange(self.frame_count, self.frame_count + count)
        frames["task_index"] = np.full(count, self._tasks.index(episode.task))
        chunk, file = divmod(number, FILES_A_CHUNK)
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [episode.task],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.frame_count,
            "dataset_to_index": self.frame_count + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        columns: dict[str, Any] = {}
        for name, values in frames.items():
            columns[name] = list(values) if values.ndim > 1 else values
            row |= _columns_of(name, compute_feature_statistics(values))
        for camera, picture_numbers in shown.items():
            pictures = episode.pictures[camera]
            columns[IMAGES + camera] = [
                {"bytes": pictures.png[i], "path": f"frame-{i:06d}.png"} for i in picture_numbers
            ]
            statistics = compute_picture_statistics(pictures, picture_numbers)
            self._picture_statistics[camera].append(statistics)
            row |= _columns_of(IMAGES + camera, statistics)
        self._write_table(columns, self._folder / DATA.format(chunk_index=chunk, file_index=file), None)
        self._frames.append(frames)
        self._records.append(episode.record)
        self.rows.append(row)
        self.frame_count += count

    def finish(self, info: dict[str, Any]) -> None:
        """Write the files about the dataset as a whole: episodes, tasks, statistics, missing data and info.

        Args:
            info: Content of `meta/info.json` without the totals, which are added.
        """
        episode_columns = {name: [row[name] for row in self.rows] for name in self.rows[0]}
        self._write_table(episode_columns, self._folder / EPISODES, None)

        task_columns = {"task_index": list(range(len(self._tasks))), INDEX: self._tasks}
        task_metadata = {b"pandas": json.dumps(_PANDAS).encode()}
        self._write_table(task_columns, self._folder / "meta" / "tasks.parquet", task_metadata)

        statistics: dict[str, Statistics] = {}
        for name in self._frames[0]:
            values = np.concatenate([frames[name] for frames in self._frames])
            statistics[name] = compute_feature_statistics(values)
        for camera, parts in self._picture_statistics.items():
            statistics[IMAGES + camera] = merge_picture_statistics(parts)
        self._write_json("meta/stats.json", statistics)

        missing_by_episode: dict[int, list[str]] = {}
        for number, record in enumerate(self._records):
            if record.missing:
                missing_by_episode[number] = record.missing
        if missing_by_episode:
            self._write_json(MISSING, missing_by_episode)

        totals = {
            "total_episodes": len(self.rows),
            "total_frames": self.frame_count,
            "total_tasks": len(self._tasks),
            "splits": {"train": f"0:{len(self.rows)}"},
        }
        self._write_json("meta/info.json", info | totals)

    def _write_json(self, name: str, content: Any) -> None:
        write_text(self._folder / name, json.dumps(content, indent=2) + "\n")


def _columns_of(feature: str, statistics: Statistics) -> Statistics:
    """Returns the columns that hold a feature's statistics in meta/episodes."""
    return {f"stats/{feature}/{name}": numbers for name, numbers in statistics.items()}


@dataclass(frozen=True)
class _Content:
    """What is known of every episode."""

    posed: bool
    rewarded: bool
    judged: bool
    cameras: dict[str, tuple[int, int]]  # width and height

    @staticmethod
    def from_episodes(episodes: Sequence[Episode]) -> "_Content":
        """Return what is known of every one of some episodes."""
        cameras = _camera_sizes(episodes[0])
        for episode in episodes[1:]:
            cameras &= _camera_sizes(episode)
        return _Content(
            posed=all(bool(episode.record.posed.all()) for episode in episodes),
            rewarded=all(episode.reward_m is not None for episode in episodes),
            judged=all(episode.success is not None for episode in episodes),
            cameras=dict(sorted(cameras)),
        )


def _camera_sizes(episode: Episode) -> set[tuple[str, tuple[int, int]]]:
    """Return name, width and height of each camera that has pictures."""
    sizes: set[tuple[str, tuple[int, int]]] = set()
    for name, pictures in episode.pictures.items():
        if pictures.ticks:
            sizes.add((name, (pictures.width, pictures.height)))
    return sizes


def _step(robot_hz: int, fps: float | None) -> int:
    """Return the number of ticks from frame to frame."""
    if fps is None:
        return 1
    step = max(round(robot_hz / fps), 1)
    if fps != round(fps) or robot_hz != step * fps:
        allowed = ", ".join(str(hz) for hz in range(1, robot_hz + 1) if robot_hz % hz == 0)
        raise ConfigError(
            f"--fps {fps:g}: of a robot at {robot_hz} Hz give one of {allowed}", code="command/invalid-option"
        )
    return step


def _rows(episode: Episode, content: _Content, step: int) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]]]:
    """Select the rows of an episode that become frames, and the newest picture of each camera at each frame.

    The frames begin at the first row at which every camera has taken a picture during this episode.

    Args:
        episode: The episode; its rows are indices into the record of the run.
        content: What the dataset holds, with the names of its cameras.
        step: Number of ticks from frame to frame.

    Returns:
        rows: (frames,) rows of the record; empty if a camera has no picture.
        picture_numbers: For each camera, (frames,) the index of the picture that the frame shows.
    """
    ticks = episode.record.ticks[episode.rows]
    has_all_pictures = np.ones(len(ticks), dtype=bool)
    newest_pictures: dict[str, NDArray[np.int64]] = {}
    for camera in content.cameras:
        picture_ticks = np.array(episode.pictures[camera].ticks)
        newest = np.searchsorted(picture_ticks, ticks, side="right") - 1
        # Pictures up to this tick were taken before the gap in front of the episode.
        first_usable = int(np.searchsorted(picture_ticks, episode.pictures_after_tick, side="right"))
        has_all_pictures &= newest >= first_usable
        newest_pictures[camera] = newest
    if not has_all_pictures.any():
        return episode.rows[:0], {}
    first = int(np.argmax(has_all_pictures))
    picture_numbers = {camera: newest[first::step] for camera, newest in newest_pictures.items()}
    return episode.rows[first::step], picture_numbers


def _common_rate_hz(records: Sequence[RunRecord]) -> int:
    if any(one.description.layout != records[0].description.layout for one in records):
        raise ConfigError(
            "the runs are of robots with different joints; a dataset is of one", code="recording/not-comparable"
        )
    rate_hz = records[0].config.rate_hz
    if any(one.config.rate_hz != rate_hz for one in records) or rate_hz != round(rate_hz):
        raise ConfigError(
            "a dataset has one rate, a whole number of Hz; export the runs of each rate apart",
            code="recording/not-comparable",
        )
    empty = [one.folder for one in records if not len(one.time_s)]
    if empty:
        raise ConfigError(
            f"{empty[0]} has no tick after arming, so no frame; leave it out", code="recording/missing-data"
        )
    return round(rate_hz)


def _info(episode: Episode, content: _Content, fps: int) -> dict[str, Any]:
    """Return the content of `meta/info.json` in a LeRobot dataset, without the totals.

    Args:
        episode: Any episode of the dataset, for the names of robot and joints.
        content: What is known of every episode, and therefore becomes a feature.
        fps: Frames per second.
    """
    features: dict[str, Any] = {}
    for feature, names in _names(episode.record, posed=content.posed).items():
        features[feature] = {"dtype": "float32", "shape": [len(names)], "names": names}
    for camera, (width, height) in content.cameras.items():
        features[IMAGES + camera] = {
            "dtype": "image",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
        }

    scalar_types = {"timestamp": "float32"}
    for feature in COUNTED:
        scalar_types[feature] = "int64"
    scalar_types["next.done"] = "bool"
    if content.rewarded:
        scalar_types["next.reward"] = "float32"
    if content.judged:
        scalar_types["next.success"] = "bool"
    for feature, dtype in scalar_types.items():
        features[feature] = {"dtype": dtype, "shape": [1], "names": None}

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
    """Return the values of the features that an episode has by itself, (n, width) or (n,), without pictures."""
    record = episode.record
    state = [record.angle_rad, record.velocity_rad_s, record.torque_nm]
    state += [record.position_w_m, record.orientation_wxyz] if content.posed else []
    is_last_frame = np.arange(len(rows)) == len(rows) - 1
    frames: Frames = {
        "observation.state": np.hstack(state)[rows].astype(np.float32),
        "action": np.hstack((record.target, record.mode))[rows].astype(np.float32),
        "next.done": is_last_frame,
    }
    if content.rewarded and episode.reward_m is not None:
        reward_m = episode.reward_m[: episode.rows[-1] + 1]  # the last frame earns nothing beyond its episode
        frames["next.reward"] = np.add.reduceat(reward_m, rows).astype(np.float32)
    if content.judged:
        frames["next.success"] = is_last_frame & bool(episode.success)
    return frames


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
