"""What the record of a run does not hold: invalid numbers, lost ticks, messages that cannot be decoded.

Each of these is described by a sentence. A command that used an incomplete record prints the sentences on stderr and
ends with the exit code INCOMPLETE.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import Description

INCOMPLETE = 3
"""Exit code of a command that succeeded, but whose record is incomplete."""
INCOMPLETE_CODE = "recording/incomplete"

MAX_MAGNITUDE = 1e9  # no signal is larger, in its SI unit; a larger number counts as infinite
OF_JOINTS = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm")
POSE = ("position_w_m", "orientation_wxyz")
CONTACTS = ("contact_peak_n", "contact_count")


def exit_code(path: Path, missing: Sequence[str], code: int = 0) -> int:
    """Return the exit code of a command, and print on stderr what its record does not hold.

    Args:
        path: The run or recording, as the user named it.
        missing: Sentences about missing data.
        code: Exit code that the command has for other reasons.

    Returns:
        `code`, unless that is 0 and the record is incomplete: then INCOMPLETE.
    """
    if not missing:
        return code
    print_stderr(f"snakesim: {path} is incomplete: {'; '.join(missing)} [{INCOMPLETE_CODE}]")
    return code or INCOMPLETE


def replace_invalid_numbers(
    columns: dict[str, NDArray[Any]], robot: Description, *, has_pose: bool
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Replace invalid numbers by NaN, and describe them. An invalid time is computed from its tick.

    Args:
        columns: Columns of the black box, by name.
        robot: The robot whose joints the columns belong to.
        has_pose: Whether the robot has a pose sensor. Even then its pose is unknown until the first sample.

    Returns:
        The columns without invalid numbers, and one sentence for each column that had some.
    """
    cleaned = dict(columns)
    sentences: list[str] = []

    is_invalid = _find_invalid(columns["time_s"])
    time_by_tick_s = columns["tick"] * (robot.period_ns * 1e-9)
    cleaned["time_s"] = np.where(is_invalid, time_by_tick_s, columns["time_s"])
    sentences += _describe_invalid("time_s", int(is_invalid.sum()), len(is_invalid))

    for name in (*OF_JOINTS, *POSE, *CONTACTS):
        is_invalid = _find_invalid(columns[name])
        cleaned[name] = np.where(is_invalid, np.nan, columns[name])
        if name in OF_JOINTS:
            count: int | str = _counts_by_joint(is_invalid, robot)
        elif name in POSE:
            count = _count_invalid_poses(columns[name], is_invalid, has_pose=has_pose)
        else:
            count = int(is_invalid.sum())
        sentences += _describe_invalid(name, count, len(is_invalid))
    return cleaned, sentences


def describe_unwritten(host: HostRecord) -> list[str]:
    """Describe the data that the host could not write."""
    sentences: list[str] = []
    if host.failure:
        sentences.append(host.failure)
    if host.lost_ticks:
        sentences.append(f"{host.lost_ticks} of {host.ticks} ticks are missing in the black box")
    if host.ended == "running":
        sentences.append("the last second may be missing: the host did not finish its record")
    return sentences


def describe_undecodable(refused: Counter[str]) -> list[str]:
    """Describe the messages of a recording that could not be decoded, counted by key and field."""
    return [f"recording: {count} messages cannot be read, {what}" for what, count in sorted(refused.items())]


def _find_invalid(values: NDArray[Any]) -> NDArray[np.bool_]:
    return ~(np.abs(values) < MAX_MAGNITUDE)


def _counts_by_joint(is_invalid: NDArray[np.bool_], robot: Description) -> str:
    """Return, for each joint with invalid numbers, its name and how many there are."""
    counts = is_invalid.sum(axis=0).tolist()
    parts: list[str] = []
    for joint, count in zip(robot.joints, counts, strict=True):
        if count:
            parts.append(f"{joint.name} {count}")
    return ", ".join(parts)


def _count_invalid_poses(values: NDArray[Any], is_invalid: NDArray[np.bool_], *, has_pose: bool) -> int:
    """Count the rows with an invalid pose since its first sample."""
    invalid_rows = np.array(is_invalid.any(axis=1))
    rows_with_sample = np.flatnonzero(~np.isnan(values).all(axis=1))
    if len(rows_with_sample):
        first = int(rows_with_sample[0])
    elif has_pose:
        first = 0
    else:
        first = len(invalid_rows)  # a robot without a pose sensor: nothing is missing
    return int(invalid_rows[first:].sum())


def _describe_invalid(signal: str, count: int | str, sample_count: int) -> list[str]:
    if not count:
        return []
    return [f"{signal}: {count} of {sample_count} samples are not numbers"]
