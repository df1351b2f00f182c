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
from snakesim_operator.playback.episodes import RecordedEpisode
from snakesim_operator.playback.lerobot_statistics import (
    Statistics,
    compute_feature_statistics,
    compute_image_statistics,
    merge_image_statistics,
)
from snakesim_operator.results.run_log import RunRecord

VERSION = "v3.0"
MISSING_PATH = "meta/missing.json"  # missing data of each incomplete episode; LeRobot does not define this file
FILES_PER_CHUNK = 1000
FILE_PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATTERN = f"data/{FILE_PATTERN}"
EPISODES_PATH = f"meta/episodes/{FILE_PATTERN}".format(chunk_index=0, file_index=0)
TASK_COLUMN = "__index_level_0__"  # column of the task texts: the name that pandas gives to an index without a name
INDEX_COLUMNS = ("frame_index", "episode_index", "index", "task_index")

IMAGE_PREFIX = "observation.images."
Frames = dict[str, NDArray[Any]]
WriteTable = Callable[[dict[str, Any], Path, dict[bytes, bytes] | None], None]


@dataclass(frozen=True)
class DatasetSize:
    """Number of episodes and frames of a dataset."""

    episodes: int
    frames: int


def write_lerobot(
    episodes: Sequence[RecordedEpisode],
    folder: Path,
    write_table: WriteTable,
    fps: float | None = None,
) -> DatasetSize:
    """Write episodes as a dataset in the format of LeRobot.

    Args:
        episodes: Runs, or parts of runs between gaps.
        folder: Folder of the dataset.
        write_table: Writes columns as a Parquet file, with metadata of its schema.
        fps: Frames per second, a divisor of the control rate of the robot; None for that rate.

    Returns:
        The number of episodes and frames that were written. Episodes without a frame are left out.

    Raises:
        ConfigError: The runs have different joints or rates, or a run has no frame.
    """
    robot_hz = _find_common_rate_hz([episode.record for episode in episodes])
    ticks_per_frame = _compute_ticks_per_frame(robot_hz, fps)
    content = _DatasetContent.from_episodes(episodes)
    dataset = _DatasetWriter(
        folder, write_table, content, seconds_per_frame=ticks_per_frame / robot_hz
    )

    frames_by_episode = [
        _select_frame_rows(episode, content, ticks_per_frame) for episode in episodes
    ]
    folders_with_frames: set[Path] = set()
    for episode, (rows, _) in zip(episodes, frames_by_episode, strict=True):
        if len(rows):
            folders_with_frames.add(episode.record.path)
    for episode in episodes:
        if episode.record.path not in folders_with_frames:
            raise ConfigError(
                f"{episode.record.path}: no picture came while it was armed; export it without --images",
                code="recording/missing-data",
            )

    for episode, (rows, image_indices) in zip(episodes, frames_by_episode, strict=True):
        if len(rows):
            dataset.add_episode(episode, rows, image_indices)
    dataset.write_metadata(_make_dataset_info(episodes[0], content, robot_hz // ticks_per_frame))
    return DatasetSize(len(dataset.episode_rows), dataset.frame_count)


class _DatasetWriter:
    """Writes the files of a dataset: first episode by episode, then the files about the whole dataset."""

    def __init__(
        self,
        folder: Path,
        write_table: WriteTable,
        content: "_DatasetContent",
        *,
        seconds_per_frame: float,
    ) -> None:
        """Prepare an empty dataset; nothing is written yet.

        Args:
            folder: Folder of the dataset.
            write_table: Writes columns by name into a Parquet file, with the metadata of its schema.
            content: Observations, actions and cameras of every frame.
            seconds_per_frame: Duration of a frame.
        """
        self._folder = folder
        self._write_table = write_table
        self._content = content
        self._seconds_per_frame = seconds_per_frame
        self._tasks: list[str] = []
        self._frames_by_episode: list[Frames] = []
        self._image_statistics: dict[str, list[Statistics]] = {
            camera: [] for camera in content.size_by_camera
        }
        self._record_by_episode: list[RunRecord] = []
        self.episode_rows: list[dict[str, Any]] = []  # the table meta/episodes, a row for each
        self.frame_count = 0

    def add_episode(
        self,
        episode: RecordedEpisode,
        rows: NDArray[np.int64],
        image_indices_by_camera: dict[str, NDArray[np.int64]],
    ) -> None:
        """Write the frames of an episode as a file, and add the episode to the metadata.

        Args:
            episode: The episode.
            rows: (frames,) rows of the record that become frames.
            image_indices_by_camera: For each camera, (frames,) the index of the image that each frame shows.
        """
        episode_index = len(self.episode_rows)
        frame_count = len(rows)
        if episode.task not in self._tasks:
            self._tasks.append(episode.task)
        frames = _make_frames(episode, self._content, rows)
        frames["timestamp"] = (np.arange(frame_count) * self._seconds_per_frame).astype(np.float32)
        frames["frame_index"] = np.arange(frame_count)
        frames["episode_index"] = np.full(frame_count, episode_index)
        frames["index"] = np.arange(self.frame_count, self.frame_count + frame_count)
        frames["task_index"] = np.full(frame_count, self._tasks.index(episode.task))
        chunk, file = divmod(episode_index, FILES_PER_CHUNK)
        row: dict[str, Any] = {
            "episode_index": episode_index,
            "tasks": [episode.task],
            "length": frame_count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.frame_count,
            "dataset_to_index": self.frame_count + frame_count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        columns: dict[str, Any] = {}
        for name, values in frames.items():
            columns[name] = list(values) if values.ndim > 1 else values
            row |= _make_statistics_columns(name, compute_feature_statistics(values))
        for camera, image_indices in image_indices_by_camera.items():
            pictures = episode.pictures[camera]
            columns[IMAGE_PREFIX + camera] = [
                {"bytes": pictures.png[i], "path": f"frame-{i:06d}.png"} for i in image_indices
            ]
            statistics = compute_image_statistics(pictures, image_indices)
            self._image_statistics[camera].append(statistics)
            row |= _make_statistics_columns(IMAGE_PREFIX + camera, statistics)
        self._write_table(
            columns, self._folder / DATA_PATTERN.format(chunk_index=chunk, file_index=file), None
        )
        self._frames_by_episode.append(frames)
        self._record_by_episode.append(episode.record)
        self.episode_rows.append(row)
        self.frame_count += frame_count

    def write_metadata(self, info: dict[str, Any]) -> None:
        """Write the metadata files of the whole dataset: episodes, tasks, statistics, missing data and info.

        At least one episode must have been added before.

        Args:
            info: Content of `meta/info.json` without the totals, which are added.
        """
        self._write_episodes_and_tasks()
        self._write_statistics()
        self._write_missing_data()
        totals = {
            "total_episodes": len(self.episode_rows),
            "total_frames": self.frame_count,
            "total_tasks": len(self._tasks),
            "splits": {"train": f"0:{len(self.episode_rows)}"},
        }
        self._write_json("meta/info.json", info | totals)

    def _write_episodes_and_tasks(self) -> None:
        """Write the tables of all episodes and of all tasks."""
        episode_columns = {
            name: [row[name] for row in self.episode_rows] for name in self.episode_rows[0]
        }
        self._write_table(episode_columns, self._folder / EPISODES_PATH, None)

        task_columns = {"task_index": list(range(len(self._tasks))), TASK_COLUMN: self._tasks}
        task_metadata = {b"pandas": json.dumps(_PANDAS_METADATA).encode()}
        self._write_table(task_columns, self._folder / "meta" / "tasks.parquet", task_metadata)

    def _write_statistics(self) -> None:
        """Write the statistics of every feature over all episodes."""
        statistics: dict[str, Statistics] = {}
        for name in self._frames_by_episode[0]:
            values = np.concatenate([frames[name] for frames in self._frames_by_episode])
            statistics[name] = compute_feature_statistics(values)
        for camera, parts in self._image_statistics.items():
            statistics[IMAGE_PREFIX + camera] = merge_image_statistics(parts)
        self._write_json("meta/stats.json", statistics)

    def _write_missing_data(self) -> None:
        """Write the missing data of incomplete episodes, if there are any."""
        missing_by_episode: dict[int, list[str]] = {}
        for episode_index, record in enumerate(self._record_by_episode):
            if record.missing:
                missing_by_episode[episode_index] = record.missing
        if missing_by_episode:
            self._write_json(MISSING_PATH, missing_by_episode)

    def _write_json(self, name: str, content: Any) -> None:
        write_text(self._folder / name, json.dumps(content, indent=2) + "\n")


def _make_statistics_columns(feature: str, statistics: Statistics) -> Statistics:
    """Make the columns of `meta/episodes` with the statistics of a feature."""
    return {f"stats/{feature}/{name}": numbers for name, numbers in statistics.items()}


@dataclass(frozen=True)
class _DatasetContent:
    """The optional features of a dataset: those that are known in every episode."""

    has_pose: bool
    has_reward: bool
    has_success: bool
    size_by_camera: dict[str, tuple[int, int]]  # width and height

    @staticmethod
    def from_episodes(episodes: Sequence[RecordedEpisode]) -> "_DatasetContent":
        """Determine the features that are known in every episode."""
        cameras = _find_camera_sizes(episodes[0])
        for episode in episodes[1:]:
            cameras &= _find_camera_sizes(episode)
        return _DatasetContent(
            has_pose=all(bool(episode.record.has_pose.all()) for episode in episodes),
            has_reward=all(episode.reward_m is not None for episode in episodes),
            has_success=all(episode.success is not None for episode in episodes),
            size_by_camera=dict(sorted(cameras)),
        )


def _find_camera_sizes(episode: RecordedEpisode) -> set[tuple[str, tuple[int, int]]]:
    """Find the name, width and height of each camera with images in an episode."""
    sizes: set[tuple[str, tuple[int, int]]] = set()
    for name, pictures in episode.pictures.items():
        if pictures.ticks:
            sizes.add((name, (pictures.width, pictures.height)))
    return sizes


def _compute_ticks_per_frame(robot_hz: int, fps: float | None) -> int:
    """Compute the number of ticks between frames. Raises ConfigError if `fps` does not divide the robot's rate."""
    if fps is None:
        return 1
    ticks_per_frame = max(round(robot_hz / fps), 1)
    if fps != round(fps) or robot_hz != ticks_per_frame * fps:
        allowed = ", ".join(str(hz) for hz in range(1, robot_hz + 1) if robot_hz % hz == 0)
        raise ConfigError(
            f"--fps {fps:g}: of a robot at {robot_hz} Hz give one of {allowed}",
            code="command/invalid-option",
        )
    return ticks_per_frame


def _select_frame_rows(
    episode: RecordedEpisode, content: _DatasetContent, ticks_per_frame: int
) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]]]:
    """Select the rows of an episode that become frames, and the newest image of each camera at each frame.

    The frames start at the first row at which every camera has taken an image during this episode.

    Args:
        episode: The episode; its rows are indices into the record of the run.
        content: What the dataset holds, with the names of its cameras.
        ticks_per_frame: Number of ticks between frames.

    Returns:
        rows: (frames,) rows of the record; empty if a camera has no image.
        image_indices: For each camera, (frames,) the index of the image that each frame shows.
    """
    ticks = episode.record.ticks[episode.rows]
    has_all_images = np.ones(len(ticks), dtype=bool)
    newest_images: dict[str, NDArray[np.int64]] = {}
    for camera in content.size_by_camera:
        image_ticks = np.array(episode.pictures[camera].ticks)
        newest = np.searchsorted(image_ticks, ticks, side="right") - 1
        # Images up to `pictures_after_tick` were taken before the gap in front of the episode.
        first_usable = int(np.searchsorted(image_ticks, episode.pictures_after_tick, side="right"))
        has_all_images &= newest >= first_usable
        newest_images[camera] = newest
    if not has_all_images.any():
        return episode.rows[:0], {}
    first = int(np.argmax(has_all_images))
    image_indices = {
        camera: newest[first::ticks_per_frame] for camera, newest in newest_images.items()
    }
    return episode.rows[first::ticks_per_frame], image_indices


def _find_common_rate_hz(records: Sequence[RunRecord]) -> int:
    if any(one.description.layout != records[0].description.layout for one in records):
        raise ConfigError(
            "the runs are of robots with different joints; a dataset is of one",
            code="recording/not-comparable",
        )
    rate_hz = records[0].config.rate_hz
    if any(one.config.rate_hz != rate_hz for one in records) or rate_hz != round(rate_hz):
        raise ConfigError(
            "a dataset has one rate, a whole number of Hz; export the runs of each rate apart",
            code="recording/not-comparable",
        )
    empty = [one.path for one in records if not len(one.time_s)]
    if empty:
        raise ConfigError(
            f"{empty[0]} has no tick after arming, so no frame; leave it out",
            code="recording/missing-data",
        )
    return round(rate_hz)


def _make_dataset_info(
    episode: RecordedEpisode, content: _DatasetContent, fps: int
) -> dict[str, Any]:
    """Make the content of `meta/info.json` in a LeRobot dataset, without the totals.

    Args:
        episode: Any episode of the dataset, for the names of robot and joints.
        content: Optional features of the dataset.
        fps: Frames per second.
    """
    features: dict[str, Any] = {}
    for feature, names in _list_feature_names(episode.record, has_pose=content.has_pose).items():
        features[feature] = {"dtype": "float32", "shape": [len(names)], "names": names}
    for camera, (width, height) in content.size_by_camera.items():
        features[IMAGE_PREFIX + camera] = {
            "dtype": "image",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
        }

    scalar_types = {"timestamp": "float32"}
    for feature in INDEX_COLUMNS:
        scalar_types[feature] = "int64"
    scalar_types["next.done"] = "bool"
    if content.has_reward:
        scalar_types["next.reward"] = "float32"
    if content.has_success:
        scalar_types["next.success"] = "bool"
    for feature, dtype in scalar_types.items():
        features[feature] = {"dtype": dtype, "shape": [1], "names": None}

    return {
        "codebase_version": VERSION,
        "robot_type": episode.record.description.robot,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "data_path": DATA_PATTERN,
        "video_path": None,
        "features": features,
    }


def _list_feature_names(record: RunRecord, *, has_pose: bool) -> dict[str, list[str]]:
    joints = [joint.name for joint in record.description.joints]
    state = [
        f"{name}.{joint}"
        for name in ("angle_rad", "velocity_rad_s", "torque_nm")
        for joint in joints
    ]
    pose = [
        *(f"position_w_m.{axis}" for axis in "xyz"),
        *(f"orientation.{part}" for part in "wxyz"),
    ]
    return {
        "observation.state": [*state, *(pose if has_pose else [])],
        "action": [f"{name}.{joint}" for name in ("target", "mode") for joint in joints],
    }


def _make_frames(
    episode: RecordedEpisode, content: _DatasetContent, rows: NDArray[np.int64]
) -> Frames:
    """Make the values of the features of an episode, (n, width) or (n,), except indices and images."""
    record = episode.record
    state = [record.angle_rad, record.velocity_rad_s, record.torque_nm]
    state += [record.position_w_m, record.orientation_wxyz] if content.has_pose else []
    is_last_frame = np.arange(len(rows)) == len(rows) - 1
    frames: Frames = {
        "observation.state": np.hstack(state)[rows].astype(np.float32),
        "action": np.hstack((record.target, record.mode))[rows].astype(np.float32),
        "next.done": is_last_frame,
    }
    if content.has_reward and episode.reward_m is not None:
        # The last frame earns nothing beyond its episode.
        reward_m = episode.reward_m[: episode.rows[-1] + 1]
        frames["next.reward"] = np.add.reduceat(reward_m, rows).astype(np.float32)
    if content.has_success:
        frames["next.success"] = is_last_frame & bool(episode.success)
    return frames


_PANDAS_METADATA = {  # what pandas needs to read an index: https://pandas.pydata.org/docs/development/developer.html
    "index_columns": [TASK_COLUMN],
    "column_indexes": [
        {
            "name": None,
            "field_name": None,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        }
    ],
    "columns": [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": None,
            "field_name": TASK_COLUMN,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ],
    "pandas_version": "2.0.0",
}
