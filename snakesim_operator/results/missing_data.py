"""Describes what is missing in the record of a run: invalid numbers, lost ticks, messages that cannot be decoded.

Each of these is described by a sentence. A command that used an incomplete record prints the descriptions on stderr and
ends with the exit code EXIT_INCOMPLETE.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import RobotDescription

EXIT_INCOMPLETE = 3
"""Exit code of a command that succeeded, but whose record is incomplete."""
INCOMPLETE_ERROR_CODE = "recording/incomplete"

MAX_MAGNITUDE = 1e9  # in SI units; a larger number counts as invalid
JOINT_COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm")
POSE_COLUMNS = ("position_w_m", "orientation_wxyz")
CONTACT_COLUMNS = ("contact_peak_n", "contact_count")


def report_missing_data(path: Path, missing: Sequence[str], code: int = 0) -> int:
    """Print on stderr what is missing in a record, and return the exit code of the command.

    Args:
        path: Path of the run or recording, as the user gave it.
        missing: Sentences about missing data; empty if the record is complete.
        code: Exit code that the command has for other reasons.

    Returns:
        `code`; if that is 0 and the record is incomplete, EXIT_INCOMPLETE.
    """
    if not missing:
        return code
    print_stderr(f"snakesim: {path} is incomplete: {'; '.join(missing)} [{INCOMPLETE_ERROR_CODE}]")
    return code or EXIT_INCOMPLETE


def replace_invalid_numbers(
    columns: dict[str, NDArray[Any]], robot: RobotDescription, *, has_pose: bool
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Replace invalid numbers by NaN, and describe them. An invalid time is replaced by the time of its tick.

    Args:
        columns: Columns of the black box by name.
        robot: Description of the robot, with its joints.
        has_pose: Whether the robot has a pose sensor. Even then its pose is unknown until the first sample.

    Returns:
        The columns without invalid numbers, and one sentence for each column that had invalid numbers.
    """
    cleaned = dict(columns)
    descriptions: list[str] = []

    is_invalid = _mask_invalid_numbers(columns["time_s"])
    time_from_tick_s = columns["tick"] * (robot.period_ns * 1e-9)
    cleaned["time_s"] = np.where(is_invalid, time_from_tick_s, columns["time_s"])
    descriptions += _describe_invalid_samples("time_s", int(is_invalid.sum()), len(is_invalid))

    for name in (*JOINT_COLUMNS, *POSE_COLUMNS, *CONTACT_COLUMNS):
        is_invalid = _mask_invalid_numbers(columns[name])
        cleaned[name] = np.where(is_invalid, np.nan, columns[name])
        if name in JOINT_COLUMNS:
            count: int | str = _describe_counts_by_joint(is_invalid, robot)
        elif name in POSE_COLUMNS:
            count = _count_invalid_poses(columns[name], is_invalid, has_pose=has_pose)
        else:
            count = int(is_invalid.sum())
        descriptions += _describe_invalid_samples(name, count, len(is_invalid))
    return cleaned, descriptions


def describe_unwritten_data(host: HostRecord) -> list[str]:
    """Describe by sentences the data that the host could not write; empty if it wrote all."""
    descriptions: list[str] = []
    if host.failure:
        descriptions.append(host.failure)
    if host.lost_ticks:
        descriptions.append(f"{host.lost_ticks} of {host.ticks} ticks are missing in the black box")
    if host.ended == "running":
        descriptions.append("the last second may be missing: the host did not finish its record")
    return descriptions


def describe_undecodable_messages(undecodable_counts: Counter[str]) -> list[str]:
    """Describe by sentences the messages of a recording that could not be decoded, counted by key and error."""
    return [
        f"recording: {count} messages cannot be read, {what}"
        for what, count in sorted(undecodable_counts.items())
    ]


def _mask_invalid_numbers(values: NDArray[Any]) -> NDArray[np.bool_]:
    return ~(np.abs(values) < MAX_MAGNITUDE)


def _describe_counts_by_joint(is_invalid: NDArray[np.bool_], robot: RobotDescription) -> str:
    """Return the name and the count of invalid numbers of each joint that has any, such as `joint_1 3, joint_2 1`."""
    counts = is_invalid.sum(axis=0).tolist()
    parts: list[str] = []
    for joint, count in zip(robot.joints, counts, strict=True):
        if count:
            parts.append(f"{joint.name} {count}")
    return ", ".join(parts)


def _count_invalid_poses(
    values: NDArray[Any], is_invalid: NDArray[np.bool_], *, has_pose: bool
) -> int:
    """Count the rows with an invalid pose since the first sample of the pose."""
    invalid_rows = np.array(is_invalid.any(axis=1))
    rows_with_sample = np.flatnonzero(~np.isnan(values).all(axis=1))
    if len(rows_with_sample):
        first_row = int(rows_with_sample[0])
    elif has_pose:
        first_row = 0
    else:
        first_row = len(invalid_rows)  # without a pose sensor, no pose is missing
    return int(invalid_rows[first_row:].sum())


def _describe_invalid_samples(signal: str, count: int | str, sample_count: int) -> list[str]:
    if not count:
        return []
    return [f"{signal}: {count} of {sample_count} samples are not numbers"]
