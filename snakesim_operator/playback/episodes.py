"""Runs as episodes of a data set: what each was for, whether it succeeded, the reward of each step, the pictures.

`snakesim record --episodes` leaves a folder with EPISODES in it, which says what the operator says of each episode. Of
other runs the task is the scenario, and success is the mission's goal; where there is none, success is unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.arrays import Floats
from snakesim_hal.errors import ConfigError
from snakesim_operator.playback.info import recording_of
from snakesim_operator.playback.pictures import Pictures, read_pictures
from snakesim_operator.results.advance import Advance
from snakesim_operator.results.record import RunRecord
from snakesim_operator.tools.demonstrations import EPISODES, EpisodeLabel


@dataclass(frozen=True)
class Episode:
    """One run."""

    record: RunRecord
    task: str
    success: bool | None  # None: unknown
    reward_m: Floats | None  # (n,) how far it comes on in the step that follows; None: its pose is unknown
    pictures: dict[str, Pictures] = field(default_factory=dict[str, Pictures])


def read_episodes(runs: Sequence[Path], task: str | None, *, images: bool) -> list[Episode]:
    """Of folders of runs, recordings, and folders of demonstrations. Raises ConfigError. task: for all of them."""
    found: list[Episode] = []
    for run in runs:
        if (run / EPISODES).is_file():
            labels = read_labels(run / EPISODES)
            found += [_episode(run / one.file, task or one.task, one.success, images=images) for one in labels]
        else:
            found.append(_episode(run, task, None, images=images))
    return found


def read_labels(path: Path) -> list[EpisodeLabel]:
    """What the operator said of each episode. Raises ConfigError."""
    try:
        return [msgspec.json.decode(line, type=EpisodeLabel) for line in path.read_bytes().splitlines() if line.strip()]
    except (msgspec.DecodeError, OSError) as error:
        raise ConfigError(f"{path}: {str(error)[:200]}; it has a line of JSON for each episode") from None


def _episode(run: Path, task: str | None, success: bool | None, *, images: bool) -> Episode:
    record = RunRecord.load(run)
    advance = Advance.of(record)
    reward_m = None
    if advance is not None:
        along_m = np.interp(record.time_s - record.time_s[0], advance.time_s, advance.along_m)
        reward_m = np.append(np.diff(along_m), 0.0)
        if success is None and advance.goal_m is not None:
            success = advance.crossed_s is not None
    pictures = read_pictures(recording_of(run)) if images else {}
    return Episode(record, task or record.config.name, success, reward_m, pictures)
