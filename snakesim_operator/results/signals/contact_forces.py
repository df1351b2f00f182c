"""Contact forces of obstacles on the body: of each link in its own frame, and of each touched obstacle in the world."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames, rotation_from_quaternion
from snakesim_operator.results.contact_log import ContactLog
from snakesim_operator.results.run_log import RunRecord


def find_contact_signals(record: RunRecord) -> dict[str, Floats]:
    """Return the contact forces of a run by signal. Each row has the newest sample of the contact sensor.

    Args:
        record: The run.

    Returns:
        `link_force_n` (n, links) and `link_force_l_n` (n, links, 3): the sum over the contacts of each link, as
        magnitude and in the link's frame. `obstacle_force_n` (n, obstacles) and `obstacle_force_w_n` (n, obstacles, 3):
        the sum over the contacts with each obstacle that was touched, as magnitude and in the world frame. NaN before
        the first sample, and in the world frame while the pose is unknown. Empty for a robot without contact sensors.
    """
    if not record.feels_contacts:
        return {}
    log = record.contact_log
    newest = np.searchsorted(log.ticks, record.ticks, side="right") - 1  # (n,) sample of each row; -1: none yet
    link_force_l_n = _spread(_sum_by_link(log, len(record.description.links)), newest)
    signals = {"link_force_n": np.linalg.norm(link_force_l_n, axis=2), "link_force_l_n": link_force_l_n}
    if log.obstacles:
        force_w_n, is_in_world = _sum_by_obstacle(record, log)
        magnitude_n = _spread(np.linalg.norm(force_w_n, axis=2), newest)
        force_w_n[~is_in_world] = np.nan
        signals["obstacle_force_n"] = magnitude_n
        signals["obstacle_force_w_n"] = _spread(force_w_n, newest)
    return signals


def _spread(samples: Floats, newest: NDArray[np.int64]) -> Floats:
    """Return the sample of each row, (n, ...); NaN for rows without one."""
    rows = np.full((len(newest), *samples.shape[1:]), np.nan)
    known = newest >= 0
    rows[known] = samples[newest[known]]
    return rows


def _sum_by_link(log: ContactLog, link_count: int) -> Floats:
    """Return the sum of the forces on each link in each sample, (s, links, 3)."""
    sums_n = np.zeros((len(log.ticks), link_count, 3))
    fits = log.link < link_count
    np.add.at(sums_n, (log.sample[fits], log.link[fits]), log.force_l_n[fits])
    return sums_n


def _sum_by_obstacle(record: RunRecord, log: ContactLog) -> tuple[Floats, NDArray[np.bool_]]:
    """Sum the forces on the body from each obstacle.

    Args:
        record: The run, with the poses of the links.
        log: The contacts.

    Returns:
        forces_n: (s, obstacles, 3) in the world frame; while the pose is unknown in the frame of the base, so that the
            magnitude is known even then.
        is_in_world: (s,) whether the pose is known.
    """
    robot = record.description
    lengths_m = [link.length_m for link in robot.links]
    axes = [joint.axis for joint in robot.joints]
    forces_n = np.zeros((len(log.ticks), len(log.obstacles), 3))
    is_in_world = np.zeros(len(log.ticks), dtype=bool)
    rows = np.clip(np.searchsorted(record.ticks, log.ticks), 0, max(len(record.ticks) - 1, 0))
    is_in_world[:] = record.posed[rows] if len(record.ticks) else False

    first = np.searchsorted(log.sample, np.arange(len(log.ticks)))
    end = np.searchsorted(log.sample, np.arange(len(log.ticks)), side="right")
    for sample in np.flatnonzero(end > first):
        row = rows[sample]
        base_rotation = np.eye(3)
        if is_in_world[sample]:
            base_rotation = rotation_from_quaternion(record.orientation_wxyz[row])
        _, rotations = link_frames(np.zeros(3), base_rotation, record.angle_rad[row], axes, lengths_m)
        contacts = slice(first[sample], end[sample])
        fits = log.link[contacts] < len(lengths_m)
        links = log.link[contacts][fits]
        turned_n = np.einsum("cij,cj->ci", rotations[links], log.force_l_n[contacts][fits])
        np.add.at(forces_n[sample], log.obstacle[contacts][fits], turned_n)
    return forces_n, is_in_world
