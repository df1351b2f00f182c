"""Computes the motion of the whole body: center of mass, heading, and velocity in the world and body frames.

The body frame has its origin at the center of mass. Its x axis is horizontal and points from the tail end to the head
end, y points to the left and z upwards. While head and tail are closer than MIN_REACH_RATIO of the body's length, as in
a coil, the frame is unknown.
"""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import ForwardKinematics
from snakesim_operator.results.run_log import RunRecord

# Between the two positions of a velocity: poses may come at only 20 Hz, and are noisy.
VELOCITY_WINDOW_S = 0.1
MIN_REACH_RATIO = 0.05  # horizontal distance from tail to head over body length; below it the heading is undefined


def compute_motion_signals(record: RunRecord) -> dict[str, Floats]:
    """Compute the signals of the motion of the body by name, (n,) or (n, 3). NaN where the pose is unknown."""
    center_w, tail_to_head_w = _find_center_and_reach(record)
    heading_w_rad = _find_heading(record, tail_to_head_w)
    velocity_w = differentiate(record, center_w)
    return {
        "center_w_m": center_w,
        "velocity_w_m_s": velocity_w,
        "velocity_b_m_s": rotate_to_body(velocity_w, heading_w_rad),
        "heading_w_rad": heading_w_rad,
        "turn_rate_rad_s": differentiate(record, heading_w_rad[:, None])[:, 0],
    }


def rotate_to_body(vectors_w: Floats, heading_w_rad: Floats) -> Floats:
    """Rotate world vectors, (n, 3), into the body frame of each row: forward, left, up."""
    cosine = np.cos(heading_w_rad)
    sine = np.sin(heading_w_rad)
    x, y, z = vectors_w.T
    up = np.where(np.isfinite(heading_w_rad), z, np.nan)
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, up], axis=1)


def differentiate(record: RunRecord, values: Floats) -> Floats:
    """Compute the rate of change of values, (n, width), by central differences over VELOCITY_WINDOW_S.

    The window is shorter next to a gap of the record, so that it never extends over the gap.
    """
    rates = np.full_like(values, np.nan)
    half_rows = max(round(0.5 * VELOCITY_WINDOW_S * record.config.rate_hz), 1)
    for rows in record.contiguous_rows:
        if len(rows) < 2:
            continue
        first = rows[0]
        last = rows[-1]
        before = np.maximum(rows - half_rows, first)
        after = np.minimum(rows + half_rows, last)
        elapsed_s = (record.time_s[after] - record.time_s[before])[:, None]
        rates[rows] = (values[after] - values[before]) / elapsed_s
    return rates


def _find_center_and_reach(record: RunRecord) -> tuple[Floats, Floats]:
    """Compute the center of mass, (n, 3), and the horizontal vector from tail to head, (n, 2). NaN if unknown."""
    count = len(record.time_s)
    center_w = np.full((count, 3), np.nan)
    reach_w = np.full((count, 2), np.nan)
    rows: NDArray[np.bool_] = record.has_pose
    if not rows.any():
        return center_w, reach_w
    forward_kinematics = ForwardKinematics(record.description)
    body_points_w = forward_kinematics.compute_body_points_w(
        record.position_w_m[rows], record.orientation_wxyz[rows], record.angle_rad[rows]
    )
    masses_kg = np.array([link.mass_kg for link in record.description.links])
    link_centers_w = 0.5 * (body_points_w[:, :-1] + body_points_w[:, 1:])
    center_w[rows] = np.einsum("nij,i->nj", link_centers_w, masses_kg / masses_kg.sum())
    reach_w[rows] = body_points_w[:, -1, :2] - body_points_w[:, 0, :2]
    return center_w, reach_w


def _find_heading(record: RunRecord, tail_to_head_w: Floats) -> Floats:
    """Compute the direction from tail to head, (n,) in rad, without jumps of a whole revolution. NaN if undefined."""
    body_length_m = sum(link.length_m for link in record.description.links)
    reach_m = np.hypot(*tail_to_head_w.T)
    heading_w_rad = np.arctan2(tail_to_head_w[:, 1], tail_to_head_w[:, 0])
    heading_w_rad[~(reach_m >= MIN_REACH_RATIO * body_length_m)] = np.nan
    known = np.isfinite(heading_w_rad)
    heading_w_rad[known] = np.unwrap(heading_w_rad[known])
    return heading_w_rad
