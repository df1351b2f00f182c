"""Gaps of a record: invalid numbers, and messages that cannot be decoded. Reported, and marked as NaN. Pure."""

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import Description

LARGEST = 1e9  # no signal is larger, in its SI unit; beyond it a number counts as infinite
OF_JOINTS = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm")
POSE = ("position_w", "orientation_wxyz")
CONTACTS = ("contact_peak_n", "contact_count")


def cleaned(
    columns: dict[str, NDArray[Any]], robot: Description, *, has_pose: bool
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Columns with invalid numbers replaced by NaN, and a list of these as text. Time is computed from the tick.

    has_pose: the robot has a pose sensor; even so its pose is unknown until the first sample.
    """
    found = dict(columns)
    said: list[str] = []
    time_s = columns["tick"] * (robot.period_ns * 1e-9)
    bad = _bad(columns["time_s"])
    found["time_s"] = np.where(bad, time_s, columns["time_s"])
    said += _words("time_s", int(bad.sum()), len(bad))
    for name in (*OF_JOINTS, *POSE, *CONTACTS):
        bad = _bad(columns[name])
        found[name] = np.where(bad, np.nan, columns[name])
        if name in OF_JOINTS:
            counts = zip(robot.joints, bad.sum(axis=0).tolist(), strict=True)
            said += _words(name, ", ".join(f"{joint.name} {count}" for joint, count in counts if count), len(bad))
            continue
        rows = np.array(bad.any(axis=1) if bad.ndim > 1 else bad)
        if name in POSE:
            known = np.flatnonzero(~np.isnan(columns[name]).all(axis=1))
            rows = rows[known[0] if len(known) else 0 if has_pose else len(rows) :]
        said += _words(name, int(rows.sum()), len(bad))
    return found, said


def unwritten(host: HostRecord) -> list[str]:
    """Data that the host could not write."""
    found = [host.failure] if host.failure else []
    if host.lost_ticks:
        found.append(f"{host.lost_ticks} of {host.ticks} ticks are missing in the black box")
    if host.ended == "running":
        found.append("the last second may be missing: the host did not finish its record")
    return found


def unread(refused: Counter[str]) -> list[str]:
    """refused: key and field of the recording that could not be decoded -> how many messages."""
    return [f"recording: {count} messages cannot be read, {what}" for what, count in sorted(refused.items())]


def _bad(values: NDArray[Any]) -> NDArray[np.bool_]:
    return ~(np.abs(values) < LARGEST)


def _words(signal: str, count: int | str, of: int) -> list[str]:
    return [f"{signal}: {count} of {of} samples are not numbers"] if count else []
