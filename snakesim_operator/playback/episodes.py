"""Runs as episodes of a data set: what each was for, whether it succeeded, the reward of each step, the pictures.

`snakesim record --episodes` leaves a folder with EPISODES in it, which says what the operator says of each episode. Of
other runs the task is the scenario, and success is the mission's goal; where there is none, success is unknown.

A gap in a recording ends an episode, because neither the time nor the motion in the gap is known; what follows the gap
is an episode of its own.
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
    """A run, or what lies between two gaps of its recording."""

    record: RunRecord
    task: str
    success: bool | None  # None: unknown
    # (n,) of every row of the record: how far the robot comes on until the next row; None: its pose is unknown
    reward_m: Floats | None
    rows: NDArray[np.int64]  # of the record, without a gap between them
    pictures: dict[str, Pictures] = field(default_factory=dict[str, Pictures])
    pictures_after_tick: int = -1  # older pictures are from before a gap, and show what the robot no longer sees


def read_episodes(runs: Sequence[Path], task: str | None, *, images: bool) -> list[Episode]:
    """Reads folders of runs, recordings, and folders of demonstrations. Raises ConfigError. task: for all of them."""
    found: list[Episode] = []
    for run in runs:
        if (run / EPISODES).is_file():
            for label in read_labels(run / EPISODES):
                found += _episodes_of(run / label.file, task or label.task, label.success, images=images)
        else:
            found += _episodes_of(run, task, None, images=images)
    return found


def gaps_in_words(episodes: Sequence[Episode]) -> list[str]:
    """Returns a sentence for each gap that ended an episode."""
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
    """What the operator said of each episode. Raises ConfigError."""
    try:
        return [msgspec.json.decode(line, type=EpisodeLabel) for line in path.read_bytes().splitlines() if line.strip()]
    except (msgspec.DecodeError, OSError) as error:
        raise ConfigError(f"{path}: {str(error)[:200]}; it has a line of JSON for each episode") from None


def _episodes_of(run: Path, task: str | None, success: bool | None, *, images: bool) -> list[Episode]:
    """Returns the episodes of one recording: one, and one more for each gap."""
    record = RunRecord.load(run)
    advance = Advance.of(record)
    reward_m = None
    if advance is not None:
        reward_m = _reward_m(record, advance)
        if success is None and advance.goal_m is not None:
            success = advance.crossed_s is not None
    pictures = read_pictures(find_recording(run)) if images else {}
    stretches = record.stretches or [np.arange(0)]  # of a run that was never armed: no row
    episodes: list[Episode] = []
    for number, rows in enumerate(stretches):
        is_last = number == len(stretches) - 1
        episodes.append(
            Episode(
                record,
                task or record.config.name,
                success=success if success is None else success and is_last,  # the others end at a gap, not at the goal
                reward_m=reward_m,
                rows=rows,
                pictures=pictures,
                pictures_after_tick=int(record.ticks[rows[0] - 1]) if number > 0 else -1,
            )
        )
    return episodes


def _reward_m(record: RunRecord, advance: Advance) -> Floats:
    """Returns (n,) how far the robot comes on from each row to the next; 0 at the end and at a gap."""
    along_m = np.interp(record.time_s - record.time_s[0], advance.time_s, advance.along_m)
    reward_m = np.append(np.diff(along_m), 0.0)
    for rows in record.stretches:
        reward_m[rows[-1]] = 0.0
    return reward_m
