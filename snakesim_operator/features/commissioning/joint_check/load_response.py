"""Measures the response of torques to the large and the small motion of a joint, without IMUs. Pure.

The floor loads a joint through its gear. A motion that reverses unloads and loads the gear again:

    sound gear   even a small motion bends the body against the friction of the floor, so its torque follows the angle
    backlash     a small motion stays within the backlash, so it needs only the torque of the drive's own friction

Its neighbors are the nearest joints with the same axis. They hold the same load, and their torques do not contain the
friction of the joint that moves. A drive that does not measure its torque is judged by the torque that its servo must
exert at its distance from the target.

A coupling that slips passes on the torque at which it slips, in the direction of the motion. So the torque of the
neighbors changes its sign when the motion reverses:

    torque of a neighbor = offset + drift * time + stiffness * angle + passed torque * direction of the motion
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.joint_check.measurements import CheckMeasurements
from snakesim_operator.features.commissioning.joint_check.tooth_contact import (
    JointMotion,
    ToothContact,
    measure_tooth_contact,
)

SMOOTHING_TICKS = 5  # of torques; shorter than any change of the load
MIN_STEP = 1e-9  # less is a rounding error
SETTLING_TICKS = 5  # after a motion, in which the torque still changes
# Of the torque that a joint passes on to its neighbors; less proves nothing.
MIN_PASSED_NM = 0.003
MIN_PASSED_ERRORS = 6.0  # standard deviations


@dataclass(frozen=True)
class PassedTorque:
    """The torque that a joint passes on to a neighbor in the direction of its motion."""

    torque_nm: float
    error_nm: float  # standard deviation

    @property
    def is_certain(self) -> bool:
        """Whether it is surely a torque, and not noise."""
        return self.torque_nm >= max(MIN_PASSED_NM, MIN_PASSED_ERRORS * self.error_nm)


@dataclass(frozen=True)
class LoadResponse:
    """The ranges of torques while one joint moved, in N·m. For its neighbors, that of the one that changes more."""

    small_motion_rad: float  # range of the joint's encoder in the second cycle of the small motion
    large_range_nm: float  # of the joint's torque in its large motions
    small_range_nm: float  # of the joint's torque in that cycle
    # Part of `small_range_nm` that follows the angle, like a spring, and not its direction, like friction.
    elastic_nm: float
    neighbor_large_range_nm: float
    neighbor_small_range_nm: float
    noise_nm: float  # largest range while the robot rested, or resolution of the torque if that is coarser
    # Passed on to a neighbor in the direction of the small motion, or of all motions. In the large motion, links that
    # turn need a torque in this direction as well.
    passed_in_small_motion: PassedTorque
    passed_in_all_motions: PassedTorque
    contact: ToothContact  # of the teeth of its gear

    @property
    def load_nm(self) -> float:
        """Torque range of the large motion minus that of the small one, which removes the friction of the drive."""
        return self.large_range_nm - self.small_range_nm


def measure_load_response(measurements: CheckMeasurements, joint_index: int) -> LoadResponse | None:
    """Return the response of the torques to the motions of a joint.

    None if it did not make the large and the small motion, or if the robot did not rest long enough before.
    """
    small = measurements.find_second_small_cycle(joint_index)
    large_ticks = np.flatnonzero(measurements.is_in_large_motion(joint_index))
    rest_ticks = np.flatnonzero(measurements.is_before_motion())
    if small is None or not len(large_ticks) or len(rest_ticks) <= SMOOTHING_TICKS:
        return None
    large = slice(large_ticks[0], large_ticks[-1] + 1 + SETTLING_TICKS)
    rest = slice(rest_ticks[0], rest_ticks[-1] + 1)

    estimated_torque_nm = _estimate_torques_nm(measurements)
    torque_nm = _smooth(estimated_torque_nm)
    angle_rad = measurements.angle_rad[small, joint_index]
    small_motion_rad = float(np.ptp(angle_rad))
    stiffness_nm_per_rad = _fit_slope(angle_rad, torque_nm[small, joint_index])
    neighbors = find_neighbors_of_same_axis(measurements.axes, joint_index)
    small_ticks = np.flatnonzero(measurements.is_in_small_motion(joint_index))
    all_small = slice(small_ticks[0], small_ticks[-1] + 1)
    all_motions = slice(
        min(small_ticks[0], large_ticks[0]), max(small_ticks[-1], large_ticks[-1]) + 1
    )
    passed_in_small_motion, passed_in_all_motions = (
        _measure_passed_torque(
            measurements.angle_rad[ticks, joint_index], estimated_torque_nm[ticks][:, neighbors]
        )
        for ticks in (all_small, all_motions)
    )
    resolution_nm = max(
        _find_resolution_nm(measurements, estimated_torque_nm, i) for i in [joint_index, *neighbors]
    )
    return LoadResponse(
        small_motion_rad=small_motion_rad,
        large_range_nm=float(np.ptp(torque_nm[large, joint_index])),
        small_range_nm=float(np.ptp(torque_nm[small, joint_index])),
        elastic_nm=stiffness_nm_per_rad * small_motion_rad,
        neighbor_large_range_nm=_find_max_range(torque_nm[large][:, neighbors]),
        neighbor_small_range_nm=_find_max_range(torque_nm[small][:, neighbors]),
        noise_nm=max(resolution_nm, _find_max_range(torque_nm[rest][:, [joint_index, *neighbors]])),
        passed_in_small_motion=passed_in_small_motion,
        passed_in_all_motions=passed_in_all_motions,
        contact=_measure_contact(measurements, joint_index, small, estimated_torque_nm),
    )


def _measure_contact(
    measurements: CheckMeasurements, joint_index: int, second_cycle: slice, torque_nm: Floats
) -> ToothContact:
    """Measure the contact of the teeth of a joint.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        second_cycle: Ticks of the second cycle of the small motion.
        torque_nm: Torques of all joints, (n, joints).
    """
    joint_torque_nm = torque_nm[:, joint_index]
    smooth_torque_nm = _smooth(torque_nm)[:, joint_index]
    small_ticks = np.flatnonzero(measurements.is_in_small_motion(joint_index))
    large_ticks = np.flatnonzero(measurements.is_in_large_motion(joint_index))
    small = slice(small_ticks[0], small_ticks[-1] + 1 + SETTLING_TICKS)
    large = slice(large_ticks[0], large_ticks[-1] + 1)
    resting_torque_nm = smooth_torque_nm[measurements.is_before_motion()]
    resolution_nm = _find_resolution_nm(measurements, torque_nm, joint_index)
    return measure_tooth_contact(
        _get_motion(measurements, joint_index, small, smooth_torque_nm),
        _get_motion(measurements, joint_index, second_cycle, smooth_torque_nm),
        _get_motion(measurements, joint_index, large, joint_torque_nm),
        noise_nm=max(resolution_nm, float(np.ptp(resting_torque_nm))),
        angle_step_rad=_find_smallest_step(measurements.angle_rad[:, joint_index]),
        window_ticks=SMOOTHING_TICKS,
    )


def _get_motion(
    measurements: CheckMeasurements, joint_index: int, ticks: slice, torque_nm: Floats
) -> JointMotion:
    """Return the motion of a joint in some ticks. `torque_nm` is that of this joint in all ticks, (n,)."""
    angle_rad = measurements.angle_rad[ticks, joint_index]
    return JointMotion(
        angle_rad=angle_rad,
        target_rad=measurements.target_rad[ticks, joint_index],
        torque_nm=torque_nm[ticks],
        direction=_find_directions(angle_rad),
    )


def _find_directions(angle_rad: Floats) -> Floats:
    """Return the direction in which a joint moves, +1 or -1 at each tick, (n,); 0 if there is only one tick."""
    if len(angle_rad) < 2:
        return np.zeros(len(angle_rad))
    return np.sign(np.gradient(_smooth(angle_rad[:, None])[:, 0]))


def find_neighbors_of_same_axis(axes: Sequence[str], joint_index: int) -> list[int]:
    """Return the nearest joints towards the tail and the head that turn about the same axis as a joint."""
    same = [i for i, axis in enumerate(axes) if axis == axes[joint_index]]
    position = same.index(joint_index)
    return [*same[max(position - 1, 0) : position], *same[position + 1 : position + 2]]


def _measure_passed_torque(angle_rad: Floats, neighbor_torque_nm: Floats) -> PassedTorque:
    """Measure the torque that a joint passes on in the direction of its motion.

    Args:
        angle_rad: Angle of the joint in its motion, (n,).
        neighbor_torque_nm: Torque of each neighbor, (n, neighbors). The one that is most certainly large counts.
    """
    ticks = np.arange(len(angle_rad), dtype=np.float64)
    direction = _find_directions(angle_rad)
    regressors = np.column_stack(
        (np.ones_like(ticks), ticks - np.mean(ticks), angle_rad - np.mean(angle_rad), direction)
    )
    normalized_covariance = np.linalg.pinv(regressors.T @ regressors)
    estimates: list[PassedTorque] = []
    for torque_nm in neighbor_torque_nm.T:
        coefficients = normalized_covariance @ regressors.T @ torque_nm
        residual_nm = torque_nm - regressors @ coefficients
        variance = float(residual_nm @ residual_nm) / max(len(ticks) - regressors.shape[1], 1)
        error_nm = float(np.sqrt(variance * normalized_covariance[-1, -1]))
        estimates.append(PassedTorque(abs(float(coefficients[-1])), error_nm))
    return max(
        estimates,
        key=lambda passed: passed.torque_nm - passed.error_nm,
        default=PassedTorque(0.0, 0.0),
    )


def _estimate_torques_nm(measurements: CheckMeasurements) -> Floats:
    """Return the torques of all joints, (n, joints): measured, or estimated from the distance to the target."""
    torque_nm = measurements.torque_nm.copy()
    for joint, (drive, motor) in enumerate(
        zip(measurements.drives, measurements.motors, strict=True)
    ):
        if "torque" not in drive.measures:
            lag_rad = measurements.target_rad[:, joint] - measurements.angle_rad[:, joint]
            torque_nm[:, joint] = (
                motor.stiffness_nm_per_rad * lag_rad
                - motor.damping_nm_s_per_rad * measurements.velocity_rad_s[:, joint]
            )
    return torque_nm


def _find_resolution_nm(
    measurements: CheckMeasurements, torque_nm: Floats, joint_index: int
) -> float:
    """Return the smallest step of a joint's torque; of an estimated one, that of its encoder as a torque."""
    if "torque" in measurements.drives[joint_index].measures:
        return _find_smallest_step(torque_nm[:, joint_index])
    stiffness_nm_per_rad = measurements.motors[joint_index].stiffness_nm_per_rad
    return stiffness_nm_per_rad * _find_smallest_step(measurements.angle_rad[:, joint_index])


def _find_smallest_step(signal: Floats) -> float:
    """Return the smallest step from one value of a signal to another; 0 if it never changes."""
    steps = np.abs(np.diff(signal))
    steps = steps[steps > MIN_STEP]
    return float(np.min(steps)) if len(steps) else 0.0


def _smooth(signals: Floats) -> Floats:
    """Return moving averages of the columns; the first and the last value are repeated beyond the ends."""
    margin = SMOOTHING_TICKS // 2
    padded = np.pad(signals, ((margin, margin), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, SMOOTHING_TICKS, axis=0)
    return windows.mean(axis=-1)


def _find_max_range(signals: Floats) -> float:
    """Return the largest range of the columns; 0 if there are no columns."""
    return float(np.max(np.ptp(signals, axis=0), initial=0.0))


def _fit_slope(x: Floats, y: Floats) -> float:
    """Return the slope of the line through points by least squares; 0 if `x` does not change."""
    centered = x - np.mean(x)
    variance = float(centered @ centered)
    if variance == 0.0:
        return 0.0
    return float(centered @ y) / variance
