"""Divides runs into the episodes of a dataset: task, success, reward of each step, images.

`snakesim record --episodes` leaves a folder with the file EPISODES, in which the operator labels each episode. The task
of any other run is its scenario, and its success is that it reached the mission's goal. Without a goal, success is
unknown.

A gap in a recording ends an episode, because neither the time nor the motion in the gap is known. What follows the gap
is another episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_operator.playback.demonstrations import LABELS_FILENAME, EpisodeLabel
from snakesim_operator.playback.pictures import CameraImages, read_camera_images
from snakesim_operator.results.metrics.advance import ForwardProgress
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import find_recording_path


@dataclass(frozen=True)
class RecordedEpisode:
    """A run, or a part of it between two gaps of its recording."""

    record: RunRecord
    task: str
    success: bool | None  # None if unknown
    # (n,) advance from each row of the record to the next; None if the pose is unknown.
    reward_m: Floats | None
    rows: NDArray[np.int64]  # indices into the record, without a gap between them
    # Images of the whole run, by camera.
    pictures: dict[str, CameraImages] = field(default_factory=dict[str, CameraImages])
    # Images up to this tick were taken before the gap in front of the episode.
    pictures_after_tick: int = -1


def read_episodes(runs: Sequence[Path], task: str | None, *, images: bool) -> list[RecordedEpisode]:
    """Read the episodes of several runs and folders of demonstrations.

    Args:
        runs: Folders of runs, recordings, and folders of demonstrations. A folder of demonstrations holds a recording
            for each episode, and a file of labels with the operator's judgment.
        task: Task of all episodes in words; None for the task that each run or label names.
        images: Whether to read the images of the cameras.

    Returns:
        The episodes, in the order of `runs`.

    Raises:
        ConfigError: A run or its labels cannot be read.
    """
    episodes: list[RecordedEpisode] = []
    for run in runs:
        labels_path = run / LABELS_FILENAME
        is_demonstrations = labels_path.is_file()
        if not is_demonstrations:
            episodes += _read_run_episodes(run, task, None, images=images)
            continue
        for label in read_labels(labels_path):
            recording = run / label.file
            episodes += _read_run_episodes(
                recording, task or label.task, label.success, images=images
            )
    return episodes


def describe_gaps(episodes: Sequence[RecordedEpisode]) -> list[str]:
    """Return a sentence for each gap that ended an episode."""
    sentences: list[str] = []
    for before, after in pairwise(episodes):
        if after.record is not before.record:
            continue
        begin_s = after.record.time_s[before.rows[-1]]
        end_s = after.record.time_s[after.rows[0]]
        sentences.append(
            f"{after.record.path}: no tick is recorded between {begin_s:.2f} and {end_s:.2f} s of robot time; an "
            f"episode ends there and another one begins"
        )
    return sentences


def read_labels(path: Path) -> list[EpisodeLabel]:
    """Read the label of each episode from a file of labels. Raises ConfigError if it cannot be read."""
    try:
        lines = path.read_bytes().splitlines()
        return [msgspec.json.decode(line, type=EpisodeLabel) for line in lines if line.strip()]
    except (msgspec.DecodeError, OSError) as error:
        raise ConfigError(
            f"{path}: {str(error)[:200]}; it has a line of JSON for each episode",
            code="recording/not-readable",
        ) from None


def _read_run_episodes(
    run: Path, task: str | None, success: bool | None, *, images: bool
) -> list[RecordedEpisode]:
    """Read the episodes of one run. A gap in the record ends an episode and begins the next one.

    Args:
        run: Folder of a run, or a recording.
        task: Task in words; None for the name of the scenario.
        success: Label of the operator; None if a run counts as a success when it reached its goal.
        images: Whether to read the images of the cameras.

    Returns:
        The episodes in order of time. If the run succeeded, only the last one counts as a success. A run that was
        never armed has one episode without rows.
    """
    record = RunRecord.load(run)
    reward_m = None
    progress = ForwardProgress.from_run(record)
    if progress is not None:
        reward_m = _compute_reward_m(record, progress)
        if success is None and progress.goal_distance_m is not None:
            success = progress.goal_reached_s is not None
    pictures: dict[str, CameraImages] = {}
    if images:
        pictures = read_camera_images(find_recording_path(run))

    row_groups = record.contiguous_rows
    if not row_groups:  # the robot was never armed
        row_groups = [np.arange(0)]
    episodes: list[RecordedEpisode] = []
    for number, rows in enumerate(row_groups):
        is_first = number == 0
        is_last = number == len(row_groups) - 1
        episode_success = success
        if success and not is_last:  # this episode ended at a gap, not at the goal
            episode_success = False
        pictures_after_tick = -1
        if not is_first:  # pictures from before the gap do not show this episode
            pictures_after_tick = int(record.ticks[rows[0] - 1])
        episode = RecordedEpisode(
            record=record,
            task=task or record.config.name,
            success=episode_success,
            reward_m=reward_m,
            rows=rows,
            pictures=pictures,
            pictures_after_tick=pictures_after_tick,
        )
        episodes.append(episode)
    return episodes


def _compute_reward_m(record: RunRecord, progress: ForwardProgress) -> Floats:
    """Compute the advance from each row to the next in m, (n,); 0 at the last row and before a gap."""
    advance_m = np.interp(record.time_s - record.time_s[0], progress.time_s, progress.max_advance_m)
    reward_m = np.append(np.diff(advance_m), 0.0)
    for rows in record.contiguous_rows:
        reward_m[rows[-1]] = 0.0
    return reward_m
