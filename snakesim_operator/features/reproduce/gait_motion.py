"""Speed, joint angles and work against the ground of a gait, from the record of a run over whole periods."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.kinematics import ForwardKinematics
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scene_file.friction import (
    DirectionalFriction,
    ViscousFriction,
    compute_surface_friction,
)
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2
from snakesim_operator.results.metrics.advance import compute_center_of_mass_w
from snakesim_operator.results.metrics.effort import get_body_length_m, get_weight_n
from snakesim_operator.results.run_log import RunRecord

HARMONICS = 6  # of the joint angles that are kept
MIN_SLIP_M_S = 1e-9  # slower links do no work


@dataclass(frozen=True)
class GroundFriction:
    """Friction of the ground on the links, as a configuration has it."""

    dry: DirectionalFriction
    along_s_per_m: float
    across_s_per_m: float

    @staticmethod
    def from_config(config: RunConfig) -> "GroundFriction":
        """Return the friction between the ground and the underside of the robot."""
        ground = config.scene.ground
        robot = config.robot
        dry = compute_surface_friction(ground.friction, ground, robot.skin, robot.wheels)
        viscous = ground.viscous or ViscousFriction(along_s_per_m=0.0, across_s_per_m=0.0)
        return GroundFriction(dry, viscous.along_s_per_m, viscous.across_s_per_m)


@dataclass(frozen=True)
class GaitMotion:
    """What was measured over whole periods of a gait."""

    speed_m_s: float  # of the center of mass, along the mean direction from tail to head
    ground_power_w: float  # mean work against friction per time
    # (HARMONICS, joints): angle = real part of sum c_h exp(i h phase).
    angle_harmonics: NDArray[np.complex128]
    body_length_m: float
    weight_n: float


def measure_gait(record: RunRecord, period_s: float, skipped_periods: int) -> GaitMotion:
    """Measure a gait of a planar body on flat ground, over the last whole periods of a run.

    Args:
        record: The run. Its sensors should be without noise, because velocities are differences of places.
        period_s: Period of the gait, a multiple of the control period.
        skipped_periods: Periods at the start that do not count.

    Raises:
        ConfigError: The run is shorter than that.
    """
    rows = _select_whole_periods(record, period_s, skipped_periods)
    duration_s = (len(rows) - 1) / record.config.rate_hz
    # (rows, joints + 2, 2): tail end, joints and head end, seen from above.
    body_points_w = ForwardKinematics(record.description).compute_body_points_w(
        record.position_w_m[rows], record.orientation_wxyz[rows], record.angle_rad[rows]
    )[..., :2]
    center_w = compute_center_of_mass_w(record.description, body_points_w)
    # Mean vector from tail to head. The last row is left out, because it begins the next period.
    axis_w = (body_points_w[:-1, -1] - body_points_w[:-1, 0]).mean(axis=0)
    displacement_w = center_w[-1] - center_w[0]
    return GaitMotion(
        speed_m_s=float(displacement_w @ axis_w / np.linalg.norm(axis_w)) / duration_s,
        ground_power_w=_measure_ground_power_w(record, body_points_w),
        angle_harmonics=_find_harmonics(
            record.angle_rad[rows[:-1]], period_s, record.config.rate_hz
        ),
        body_length_m=get_body_length_m(record),
        weight_n=get_weight_n(record),
    )


def _select_whole_periods(
    record: RunRecord, period_s: float, skipped_periods: int
) -> NDArray[np.int64]:
    """Return the numbers of the rows of the last whole periods, both ends included."""
    rows_per_period = round(period_s * record.config.rate_hz)
    last = len(record.time_s) - 1
    periods = last // rows_per_period - skipped_periods
    if periods < 1:
        raise ConfigError(
            f"a run of {last / record.config.rate_hz:g} s has no whole period of {period_s:g} s after the first "
            f"{skipped_periods}; make it longer",
            code="python/invalid-argument",
        )
    return np.arange(last - periods * rows_per_period, last + 1)


def _find_harmonics(angles_rad: Floats, period_s: float, rate_hz: float) -> NDArray[np.complex128]:
    """Return the Fourier series of the joint angles, (HARMONICS, joints). Phase 0 is the first row."""
    phases = 2 * np.pi * np.arange(len(angles_rad)) / (period_s * rate_hz)
    waves = np.exp(-1j * np.outer(np.arange(HARMONICS), phases))
    series: NDArray[np.complex128] = (2 * waves @ angles_rad / len(angles_rad)).astype(
        np.complex128
    )
    series[0] /= 2
    return series


def _measure_ground_power_w(record: RunRecord, body_points_w: Floats) -> float:
    """Return the mean power of friction on flat ground.

    Friction acts at the joints and ends. Each of these feet has half of the weight of both of its links, and their mean
    direction, as in the simulator.

    Args:
        record: The run.
        body_points_w: (rows, feet, 2) positions of the feet in consecutive rows of the run, m.
    """
    friction = GroundFriction.from_config(record.config)
    masses_kg = np.array([link.mass_kg for link in record.description.links])
    loads_n = find_foot_loads_n(masses_kg)
    # Vectors in the plane as complex numbers: (rows, feet), and (rows - 1, feet) between two rows.
    positions = body_points_w[..., 0] + 1j * body_points_w[..., 1]
    velocities = np.diff(positions, axis=0) * record.config.rate_hz
    tangents = find_foot_tangents(np.diff(positions, axis=1))
    mean_tangents = tangents[1:] + tangents[:-1]
    # Rotated into the direction of the body: real parts along it, imaginary parts across it.
    slips = velocities * np.conj(mean_tangents / np.abs(mean_tangents))
    forces_per_load = find_friction_per_load(slips, friction, MIN_SLIP_M_S)
    powers_w = -(forces_per_load * np.conj(slips)).real @ loads_n
    return float(powers_w.mean())


def find_foot_loads_n(masses_kg: Floats) -> Floats:
    """Return the load of each foot, (links + 1,): half of the weight of both of its links."""
    return 0.5 * GRAVITY_M_S2 * (np.append(masses_kg, 0.0) + np.append(0.0, masses_kg))


def find_foot_tangents(links: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the direction of the body at each foot, (..., links + 1): the mean of both links.

    Args:
        links: (..., links) vectors from the rear end of each link to its front end, as complex numbers.
    """
    directions = links / np.abs(links)
    zeros = np.zeros_like(directions[..., :1])
    sums = np.concatenate((directions, zeros), axis=-1) + np.concatenate(
        (zeros, directions), axis=-1
    )
    return sums / np.abs(sums)


def find_friction_per_load(
    slips: NDArray[np.complex128], friction: GroundFriction, smooth_m_s: float
) -> NDArray[np.complex128]:
    """Return the force of friction on sliding feet, divided by their load: real part along the body, imaginary across.

    Source: the law of D. L. Hu, J. Nirody, T. Scott and M. J. Shelley, PNAS 106, 2009, and viscous friction.

    Args:
        slips: Velocities of the feet in m/s, along the body and across it.
        friction: Coefficients.
        smooth_m_s: Speed below which dry friction becomes smaller.
    """
    along = slips.real
    across = slips.imag
    speeds_m_s = np.sqrt(along**2 + across**2 + smooth_m_s**2)
    along_coefficients = np.where(along > 0, friction.dry.forward, friction.dry.backward)
    dry = (along_coefficients * along + 1j * friction.dry.sideways * across) / speeds_m_s
    viscous = friction.along_s_per_m * along + 1j * friction.across_s_per_m * across
    return -dry - viscous
