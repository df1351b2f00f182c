"""Computes contact forces on the body: on each link in its frame, and from each touched obstacle in the world."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_operator.results.contact_log import ContactLog
from snakesim_operator.results.run_log import RunRecord


def compute_contact_signals(record: RunRecord) -> dict[str, Floats]:
    """Compute the contact forces of a run by signal. Each row has the newest sample of the contact sensor.

    Args:
        record: The recorded run.

    Returns:
        `link_force_n` (n, links) and `link_force_l_n` (n, links, 3): the sum over the contacts of each link, as
        magnitude and in the link's frame. `obstacle_force_n` (n, obstacles) and `obstacle_force_w_n` (n, obstacles, 3):
        the sum over the contacts with each obstacle that was touched, as magnitude and in the world frame. NaN before
        the first sample, and in the world frame while the pose is unknown. Empty for a robot without contact sensors.
    """
    if not record.has_contact_sensors:
        return {}
    log = record.contact_log
    # (n,) sample of each row; -1: none yet.
    newest = np.searchsorted(log.ticks, record.ticks, side="right") - 1
    link_force_l_n = _repeat_newest_samples(
        _sum_by_link(log, len(record.description.links)), newest
    )
    signals = {
        "link_force_n": np.linalg.norm(link_force_l_n, axis=2),
        "link_force_l_n": link_force_l_n,
    }
    if log.obstacles:
        force_w_n, is_in_world = _sum_by_obstacle(record, log)
        magnitude_n = _repeat_newest_samples(np.linalg.norm(force_w_n, axis=2), newest)
        force_w_n[~is_in_world] = np.nan
        signals["obstacle_force_n"] = magnitude_n
        signals["obstacle_force_w_n"] = _repeat_newest_samples(force_w_n, newest)
    return signals


def _repeat_newest_samples(samples: Floats, newest: NDArray[np.int64]) -> Floats:
    """Return the newest sample for each row, (n, ...); NaN for rows before the first sample."""
    rows = np.full((len(newest), *samples.shape[1:]), np.nan)
    known = newest >= 0
    rows[known] = samples[newest[known]]
    return rows


def _sum_by_link(log: ContactLog, link_count: int) -> Floats:
    """Sum the forces on each link in each sample, (s, links, 3), in the frames of the links."""
    sums_n = np.zeros((len(log.ticks), link_count, 3))
    is_on_known_link = log.link_index < link_count
    np.add.at(
        sums_n,
        (log.sample_index[is_on_known_link], log.link_index[is_on_known_link]),
        log.force_l_n[is_on_known_link],
    )
    return sums_n


def _sum_by_obstacle(record: RunRecord, log: ContactLog) -> tuple[Floats, NDArray[np.bool_]]:
    """Sum the forces on the body from each obstacle.

    Args:
        record: The recorded run, with the poses of the robot.
        log: The contacts of the run.

    Returns:
        forces_n: (s, obstacles, 3) forces in the world frame, or in the frame of the base while the pose is unknown, so
            that the magnitude is known even then.
        is_in_world: (s,) whether the pose is known.
    """
    robot = record.description
    lengths_m = [link.length_m for link in robot.links]
    axes = [joint.axis for joint in robot.joints]
    forces_n = np.zeros((len(log.ticks), len(log.obstacles), 3))
    is_in_world = np.zeros(len(log.ticks), dtype=bool)
    rows = np.clip(np.searchsorted(record.ticks, log.ticks), 0, max(len(record.ticks) - 1, 0))
    is_in_world[:] = record.has_pose[rows] if len(record.ticks) else False

    first_contact = np.searchsorted(log.sample_index, np.arange(len(log.ticks)))
    end_contact = np.searchsorted(log.sample_index, np.arange(len(log.ticks)), side="right")
    for sample in np.flatnonzero(end_contact > first_contact):
        row = rows[sample]
        base_rotation = np.eye(3)
        if is_in_world[sample]:
            base_rotation = rotation_from_quaternion(record.orientation_wxyz[row])
        _, rotations = compute_link_frames(
            np.zeros(3), base_rotation, record.angle_rad[row], axes, lengths_m
        )
        contacts = slice(first_contact[sample], end_contact[sample])
        is_on_known_link = log.link_index[contacts] < len(lengths_m)
        links = log.link_index[contacts][is_on_known_link]
        rotated_forces_n = np.einsum(
            "cij,cj->ci", rotations[links], log.force_l_n[contacts][is_on_known_link]
        )
        np.add.at(
            forces_n[sample], log.obstacle_index[contacts][is_on_known_link], rotated_forces_n
        )
    return forces_n, is_in_world
