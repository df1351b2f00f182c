"""Speed, energy use and slip of a whole run along two directions: the body's first heading, and its displacement.

A body that travels sideways goes far, but hardly along its heading. None is unknown, or the distance is too short.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import NodeFinder
from snakesim_operator.results.metrics.advance import MIN_DISTANCE_M, SAMPLE_S, Advance, energy_j
from snakesim_operator.results.metrics.effort import body_length_m, propulsive_efficiency, weight_n
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True)
class HeadingEffort:
    """Speed and energy use along the first heading of the body."""

    heading_advance_m: float | None = None
    heading_energy_j_per_m: float | None = None
    heading_body_lengths_s: float | None = None
    heading_cost_of_transport: float | None = None

    @staticmethod
    def from_run(record: RunRecord, advance: Advance | None, known_s: float, *, has_power: bool) -> "HeadingEffort":
        """Compute speed and energy use along the heading.

        Args:
            record: The recorded run.
            advance: How the run advanced; None: the pose is unknown.
            known_s: Time within which the pose was known, in s.
            has_power: Whether torques and speeds are known, so that the energy can be computed.

        Returns:
            The values. All are None if the pose is unknown; those of energy are None without power.
        """
        if advance is None or known_s <= 0:
            return HeadingEffort()
        distance_m = float(advance.along_heading_m[-1])
        cost = _measure_cost(record, distance_m, has_power=has_power)
        return HeadingEffort(
            heading_advance_m=distance_m,
            heading_energy_j_per_m=cost.energy_j_per_m,
            heading_body_lengths_s=distance_m / known_s / body_length_m(record),
            heading_cost_of_transport=cost.of_transport,
        )


@dataclass(frozen=True)
class Displacement:
    """Speed, energy use and slip along the net displacement of the center of mass, for every gait."""

    displacement_m_s: float | None = None
    displacement_bearing_rad: float | None = None  # from the first heading; left is positive
    displacement_energy_j_per_m: float | None = None
    displacement_body_lengths_s: float | None = None
    displacement_cost_of_transport: float | None = None
    displacement_efficiency: float | None = None  # friction of the whole weight over the distance, over energy
    displacement_slip: float | None = None  # 1 minus the displacement over the mean path length of the links
    lateral_slip: float | None = None  # fraction of the links' paths that is across their own axes

    @staticmethod
    def from_run(record: RunRecord, advance: Advance | None, known_s: float, *, has_power: bool) -> "Displacement":
        """Compute speed, energy use and slip along the net displacement of the center of mass.

        Args:
            record: The recorded run.
            advance: How the run advanced; None: the pose is unknown.
            known_s: Time within which the pose was known, in s.
            has_power: Whether torques and speeds are known, so that the energy can be computed.

        Returns:
            The values. All are None if the pose is unknown; those of energy are None without power.
        """
        if advance is None or known_s <= 0:
            return Displacement()
        displacement_w = advance.center_w[-1] - advance.center_w[0]
        distance_m = float(np.linalg.norm(displacement_w))
        cost = _measure_cost(record, distance_m, has_power=has_power)
        slip = measure_slip(record, distance_m)
        return Displacement(
            displacement_m_s=distance_m / known_s,
            displacement_bearing_rad=_find_bearing_rad(advance, displacement_w),
            displacement_energy_j_per_m=cost.energy_j_per_m,
            displacement_body_lengths_s=distance_m / known_s / body_length_m(record),
            displacement_cost_of_transport=cost.of_transport,
            displacement_efficiency=propulsive_efficiency(record, cost.of_transport),
            displacement_slip=slip.along_path,
            lateral_slip=slip.lateral,
        )


@dataclass(frozen=True)
class Slip:
    """How much of the links' motion does not carry the body on. None: the links moved less than MIN_DISTANCE_M."""

    along_path: float | None = None
    lateral: float | None = None


def measure_slip(record: RunRecord, distance_m: float) -> Slip:
    """Compare the paths of the links with the net displacement, and with the links' own axes.

    With the horizontal steps d of the middle of each link i from one sample to the next, the masses m, and the unit
    vector n across the link in the middle of the step:

        along_path = 1 - distance / (sum of m_i |d| / sum of m_i)
        lateral    = sum of m_i |d . n| / sum of m_i |d|

    Args:
        record: The recorded run. It is sampled every SAMPLE_S.
        distance_m: Length of the net displacement.
    """
    row_step = max(round(SAMPLE_S * record.config.rate_hz), 1)
    rows = np.flatnonzero(record.posed)[::row_step]
    if len(rows) < 2:
        return Slip()
    finder = NodeFinder(record.description)
    nodes_w = finder.find(record.position_w_m[rows], record.orientation_wxyz[rows], record.angle_rad[rows])[..., :2]
    middles_w = 0.5 * (nodes_w[:, 1:] + nodes_w[:, :-1])  # (samples, links, 2)
    axes_w = nodes_w[:, 1:] - nodes_w[:, :-1]
    steps_m = np.diff(middles_w, axis=0)
    step_lengths_m = np.linalg.norm(steps_m, axis=2)
    across_m = np.abs(_cross(_make_unit(axes_w[1:] + axes_w[:-1]), steps_m))
    masses_kg = np.array([link.mass_kg for link in record.description.links])
    path_m = float((step_lengths_m @ masses_kg).sum() / masses_kg.sum())
    across_path_m = float((across_m @ masses_kg).sum() / masses_kg.sum())
    if path_m < MIN_DISTANCE_M:
        return Slip()
    return Slip(along_path=max(1.0 - distance_m / path_m, 0.0), lateral=across_path_m / path_m)


def _find_bearing_rad(advance: Advance, displacement_w: Floats) -> float | None:
    """Return the angle from the body's first heading to the displacement, in -pi to pi."""
    if np.linalg.norm(displacement_w) < MIN_DISTANCE_M:
        return None
    forward_w = advance.head_w[0] - advance.center_w[0]
    return float(np.arctan2(_cross(forward_w, displacement_w), np.dot(forward_w, displacement_w)))


@dataclass(frozen=True)
class _Cost:
    """What a distance costs. None: the energy is unknown, or the distance is shorter than MIN_DISTANCE_M."""

    energy_j_per_m: float | None = None
    of_transport: float | None = None  # energy over weight times distance


def _measure_cost(record: RunRecord, distance_m: float, *, has_power: bool) -> _Cost:
    """Divide the energy of the whole run by a distance. has_power: whether the energy can be computed."""
    if not has_power or distance_m < MIN_DISTANCE_M:
        return _Cost()
    j_per_m = energy_j(record) / distance_m
    return _Cost(j_per_m, j_per_m / weight_n(record))


def _make_unit(vectors: Floats) -> Floats:
    """Return vectors of length 1; a vector of length 0, such as of a vertical link, stays 0."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the z component of the cross product of horizontal vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
