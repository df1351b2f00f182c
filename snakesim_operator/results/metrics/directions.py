"""Computes speed, energy use and slip of a whole run along the body's first heading and along its displacement.

A body that travels sideways goes far, but hardly along its heading. None is unknown, or the distance is too short.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import ForwardKinematics
from snakesim_operator.results.metrics.advance import (
    MIN_DISTANCE_M,
    SAMPLE_PERIOD_S,
    ForwardProgress,
    compute_energy_j,
)
from snakesim_operator.results.metrics.effort import (
    compute_propulsive_efficiency,
    get_body_length_m,
    get_weight_n,
)
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True)
class HeadingEffort:
    """Speed and energy use along the first heading of the body."""

    heading_advance_m: float | None = None
    heading_energy_j_per_m: float | None = None
    heading_body_lengths_s: float | None = None
    heading_cost_of_transport: float | None = None

    @classmethod
    def from_run(
        cls,
        record: RunRecord,
        progress: ForwardProgress | None,
        tracked_duration_s: float,
        *,
        has_torque_and_velocity: bool,
    ) -> Self:
        """Compute speed and energy use along the heading.

        Args:
            record: The recorded run.
            progress: Path of the center of mass, and its advance along the heading. None if the pose is unknown.
            tracked_duration_s: Time from the first known pose to the last, in s.
            has_torque_and_velocity: Whether joint torques and velocities are known, so that energy can be computed.

        Returns:
            The metrics. All are None if the pose is unknown, or known at one time only. Metrics of energy are None if
            torques or velocities are unknown.
        """
        if progress is None or tracked_duration_s <= 0:
            return cls()  # all metrics are None
        distance_m = float(progress.max_heading_advance_m[-1])
        cost = _compute_energy_cost(
            record, distance_m, has_torque_and_velocity=has_torque_and_velocity
        )
        return cls(
            heading_advance_m=distance_m,
            heading_energy_j_per_m=cost.energy_j_per_m,
            heading_body_lengths_s=distance_m / tracked_duration_s / get_body_length_m(record),
            heading_cost_of_transport=cost.cost_of_transport,
        )


@dataclass(frozen=True)
class DisplacementMetrics:
    """Speed, energy use and slip along the net displacement of the center of mass, for every gait."""

    # Speed: length of the displacement over the time that it took.
    displacement_m_s: float | None = None
    displacement_bearing_rad: float | None = None  # from the first heading; left is positive
    displacement_energy_j_per_m: float | None = None
    displacement_body_lengths_s: float | None = None
    displacement_cost_of_transport: float | None = None
    # Friction of the whole weight over the distance, over energy.
    displacement_efficiency: float | None = None
    # 1 minus the displacement over the mean path length of the links.
    displacement_slip: float | None = None
    lateral_slip: float | None = None  # fraction of the links' paths that is across their own axes

    @classmethod
    def from_run(
        cls,
        record: RunRecord,
        progress: ForwardProgress | None,
        tracked_duration_s: float,
        *,
        has_torque_and_velocity: bool,
    ) -> Self:
        """Compute speed, energy use and slip along the net displacement of the center of mass.

        Args:
            record: The recorded run.
            progress: Path of the center of mass, and its advance along the heading. None if the pose is unknown.
            tracked_duration_s: Time from the first known pose to the last, in s.
            has_torque_and_velocity: Whether joint torques and velocities are known, so that energy can be computed.

        Returns:
            The metrics. All are None if the pose is unknown, or known at one time only. Metrics of energy are None if
            torques or velocities are unknown.
        """
        if progress is None or tracked_duration_s <= 0:
            return cls()  # all metrics are None
        displacement_w = progress.center_w[-1] - progress.center_w[0]
        distance_m = float(np.linalg.norm(displacement_w))
        cost = _compute_energy_cost(
            record, distance_m, has_torque_and_velocity=has_torque_and_velocity
        )
        slip = measure_slip(record, distance_m)
        return cls(
            displacement_m_s=distance_m / tracked_duration_s,
            displacement_bearing_rad=_find_bearing_rad(progress, displacement_w),
            displacement_energy_j_per_m=cost.energy_j_per_m,
            displacement_body_lengths_s=distance_m / tracked_duration_s / get_body_length_m(record),
            displacement_cost_of_transport=cost.cost_of_transport,
            displacement_efficiency=compute_propulsive_efficiency(record, cost.cost_of_transport),
            displacement_slip=slip.longitudinal,
            lateral_slip=slip.lateral,
        )


@dataclass(frozen=True)
class SlipFractions:
    """Fractions of the links' motion that do not move the body forward. None if the links hardly moved."""

    longitudinal: float | None = None
    lateral: float | None = None


def measure_slip(record: RunRecord, distance_m: float) -> SlipFractions:
    """Measure the slip of the links: how much longer their paths are than the displacement, and how far sideways.

    With the horizontal steps d of the center of each link i from one sample to the next, the link masses m, and the
    unit vector n that is perpendicular to the link in the middle of the step:

        longitudinal = 1 - distance / (sum of m_i |d| / sum of m_i)
        lateral      = sum of m_i |d . n| / sum of m_i |d|

    Args:
        record: The recorded run. Its poses are sampled every SAMPLE_PERIOD_S, so that sensor noise between two ticks
            does not lengthen the paths.
        distance_m: Length of the net displacement of the body, in m.

    Returns:
        The slip. Both fractions are None if fewer than two poses are known, or if the links moved less than
        MIN_DISTANCE_M on average.
    """
    row_step = max(round(SAMPLE_PERIOD_S * record.config.rate_hz), 1)
    rows = np.flatnonzero(record.has_pose)[::row_step]
    if len(rows) < 2:
        return SlipFractions()
    forward_kinematics = ForwardKinematics(record.description)
    body_points_w = forward_kinematics.compute_body_points_w(
        record.position_w_m[rows], record.orientation_wxyz[rows], record.angle_rad[rows]
    )[..., :2]  # (samples, joints + 2, 2): tail end, joints and head end
    link_centers_w = 0.5 * (body_points_w[:, 1:] + body_points_w[:, :-1])  # (samples, links, 2)
    link_axes_w = body_points_w[:, 1:] - body_points_w[:, :-1]
    steps_w = np.diff(link_centers_w, axis=0)
    step_lengths_m = np.linalg.norm(steps_w, axis=2)
    # |direction x step| is the part of a step that is perpendicular to the link, which is |d . n| above.
    link_directions_w = _normalize(link_axes_w[1:] + link_axes_w[:-1])
    lateral_steps_m = np.abs(_compute_cross_product(link_directions_w, steps_w))
    masses_kg = np.array([link.mass_kg for link in record.description.links])
    path_m = float((step_lengths_m @ masses_kg).sum() / masses_kg.sum())
    lateral_path_m = float((lateral_steps_m @ masses_kg).sum() / masses_kg.sum())
    if path_m < MIN_DISTANCE_M:
        return SlipFractions()
    return SlipFractions(
        longitudinal=max(1.0 - distance_m / path_m, 0.0), lateral=lateral_path_m / path_m
    )


def _find_bearing_rad(progress: ForwardProgress, displacement_w: Floats) -> float | None:
    """Return the angle from the body's first heading to the displacement, in -pi to pi."""
    if np.linalg.norm(displacement_w) < MIN_DISTANCE_M:
        return None
    forward_w = progress.head_w[0] - progress.center_w[0]
    return float(
        np.arctan2(
            _compute_cross_product(forward_w, displacement_w), np.dot(forward_w, displacement_w)
        )
    )


@dataclass(frozen=True)
class _EnergyCost:
    """Energy for a distance. None if the energy is unknown, or the distance is shorter than MIN_DISTANCE_M."""

    energy_j_per_m: float | None = None
    cost_of_transport: float | None = None  # energy over weight times distance


def _compute_energy_cost(
    record: RunRecord, distance_m: float, *, has_torque_and_velocity: bool
) -> _EnergyCost:
    """Compute the energy of the whole run for a distance, per meter and relative to the weight.

    Args:
        record: The recorded run.
        distance_m: The distance that the body moved, in m.
        has_torque_and_velocity: Whether joint torques and velocities are known, so that energy can be computed.
    """
    if not has_torque_and_velocity or distance_m < MIN_DISTANCE_M:
        return _EnergyCost()
    energy_j_per_m = compute_energy_j(record) / distance_m
    return _EnergyCost(energy_j_per_m, energy_j_per_m / get_weight_n(record))


def _normalize(vectors: Floats) -> Floats:
    """Scale vectors (..., 2) to length 1. A vector of length 0, such as that of a vertical link, stays 0."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def _compute_cross_product(a: Floats, b: Floats) -> Floats:
    """Return the z component of the cross product of horizontal vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
