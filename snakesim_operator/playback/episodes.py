"""Divides runs into the episodes of a data set: task, success, reward of each step, pictures.

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
from snakesim_operator.playback.demonstrations import EPISODES, EpisodeLabel
from snakesim_operator.playback.pictures import Pictures, read_pictures
from snakesim_operator.results.metrics.advance import Advance
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import find_recording


@dataclass(frozen=True)
class Episode:
    """A run, or a part of it between two gaps of its recording."""

    record: RunRecord
    task: str
    success: bool | None  # None: unknown
    reward_m: Floats | None  # (n,) advance from each row of the record to the next; None: the pose is unknown
    rows: NDArray[np.int64]  # of the record, without a gap between them
    pictures: dict[str, Pictures] = field(default_factory=dict[str, Pictures])  # of the whole run, by camera
    pictures_after_tick: int = -1  # older pictures are from before a gap, and show another scene


def read_episodes(runs: Sequence[Path], task: str | None, *, images: bool) -> list[Episode]:
    """Read the episodes of several runs and folders of demonstrations.

    Args:
        runs: Folders of runs, recordings, and folders of demonstrations. A folder of demonstrations holds a recording
            for each episode, and a file of labels with the operator's judgment.
        task: The task of all episodes in words; None: the task that each run or label names.
        images: Whether to read the pictures of the cameras.

    Returns:
        The episodes, in the order of `runs`.

    Raises:
        ConfigError: A run or its labels cannot be read.
    """
    episodes: list[Episode] = []
    for run in runs:
        labels_path = run / EPISODES
        is_demonstrations = labels_path.is_file()
        if not is_demonstrations:
            episodes += _read_run(run, task, None, images=images)
            continue
        for label in read_labels(labels_path):
            recording = run / label.file
            episodes += _read_run(recording, task or label.task, label.success, images=images)
    return episodes


def describe_gaps(episodes: Sequence[Episode]) -> list[str]:
    """Return a sentence for each gap that ended an episode."""
    sentences: list[str] = []
    for before, after in pairwise(episodes):
        if after.record is not before.record:
            continue
        begin_s = after.record.time_s[before.rows[-1]]
        end_s = after.record.time_s[after.rows[0]]
        sentences.append(
            f"{after.record.folder}: no tick is recorded between {begin_s:.2f} and {end_s:.2f} s of robot time; an "
            f"episode ends there and another one begins"
        )
    return sentences


def read_labels(path: Path) -> list[EpisodeLabel]:
    """Return the operator's label of each episode. Raises ConfigError."""
    try:
        lines = path.read_bytes().splitlines()
        return [msgspec.json.decode(line, type=EpisodeLabel) for line in lines if line.strip()]
    except (msgspec.DecodeError, OSError) as error:
        raise ConfigError(
            f"{path}: {str(error)[:200]}; it has a line of JSON for each episode", code="recording/not-readable"
        ) from None


def _read_run(run: Path, task: str | None, success: bool | None, *, images: bool) -> list[Episode]:
    """Read the episodes of one run. A gap in the record ends an episode and begins the next one.

    Args:
        run: Folder of a run, or a recording.
        task: The task in words; None: the name of the scenario.
        success: The operator's label; None: the run succeeded if it reached its goal.
        images: Whether to read the pictures of the cameras.

    Returns:
        The episodes in order of time. If the run succeeded, only the last one counts as a success. A run that was
        never armed has one episode without rows.
    """
    record = RunRecord.load(run)
    reward_m = None
    advance = Advance.from_run(record)
    if advance is not None:
        reward_m = _compute_reward_m(record, advance)
        if success is None and advance.goal_m is not None:
            success = advance.crossed_s is not None
    pictures: dict[str, Pictures] = {}
    if images:
        pictures = read_pictures(find_recording(run))

    stretches = record.stretches
    if not stretches:  # the robot was never armed
        stretches = [np.arange(0)]
    episodes: list[Episode] = []
    for number, rows in enumerate(stretches):
        is_first = number == 0
        is_last = number == len(stretches) - 1
        episode_success = success
        if success and not is_last:  # it ended at a gap, not at the goal
            episode_success = False
        pictures_after_tick = -1
        if not is_first:  # pictures from before the gap do not show this episode
            pictures_after_tick = int(record.ticks[rows[0] - 1])
        episode = Episode(
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


def _compute_reward_m(record: RunRecord, advance: Advance) -> Floats:
    """Return the advance from each row to the next, (n,); 0 at the end and at a gap."""
    along_m = np.interp(record.time_s - record.time_s[0], advance.time_s, advance.along_m)
    reward_m = np.append(np.diff(along_m), 0.0)
    for rows in record.stretches:
        reward_m[rows[-1]] = 0.0
    return reward_m
