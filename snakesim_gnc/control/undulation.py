"""Baselines that use no map: waves that travel along the body, whatever obstacles are around it.

Lateral undulation is the serpenoid curve: every joint swings by `amplitude_rad`, with a phase `lag_rad` behind that of
the joint ahead of it. Head-steered undulation adds a bend to all joints, in proportion to the direction of the path as
seen from the head. Compliant undulation lets obstacles change the amplitude of the wave. It can resolve jams: when the
body is stationary, the wave travels the other way for a while.
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.bumpless import Blend, BumplessFollower
from snakesim_gnc.control.standstill import StandstillDetector
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    is_motion_requested,
)
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import above, bounded, from_zero

STEERING_DISTANCE_M = 1.0  # how far ahead on the path the head steers for
MAX_JAM_DISTANCE_M = 0.02  # a body that moves less than this within `jam_after_s` is jammed

Steering = Annotated[float, from_zero(2, "1")]


def compute_direction_angle_rad(
    body_points_w: NDArray[np.float64], direction_w: NDArray[np.float64]
) -> float:
    """Compute the angle from the direction of a body (tail to head) to another direction, left positive.

    Args:
        body_points_w: (n, 2) points of the body, tail to head, m.
        direction_w: (2,) vector in the other direction, of any length.

    Returns:
        The angle in rad, between -2 pi and 2 pi.
    """
    body_direction_w = body_points_w[-1] - body_points_w[0]
    return math.atan2(direction_w[1], direction_w[0]) - math.atan2(
        body_direction_w[1], body_direction_w[0]
    )


class LateralUndulationParameters(FileStruct, frozen=True, kw_only=True):
    """Parameters of the wave, and how much it bends towards the path."""

    amplitude_rad: Annotated[float, from_zero(2, "rad")] = 0.5
    """Amplitude of every joint."""

    period_s: Annotated[float, above(100, "s")] = 2.0
    """Period of the wave."""

    lag_rad: Annotated[float, bounded(-3.2, 3.2, "rad")] = 0.9
    """Phase of a joint behind the one ahead of it. Negative: the wave travels to the head."""

    steering: Steering = 0.0
    """Bend of all joints for each radian that the path leads aside. 0: no steering."""

    blend_s: Blend = 1.0
    """Time over which the command changes smoothly to a new reference."""


class LateralUndulation(Controller[LateralUndulationParameters]):
    """A wave of the yaw joints: theta_n = A sin(phi - n lag) + bend, with n = 0 at the head.

    The phase phi grows by 2 pi in each period.
    """

    Parameters = LateralUndulationParameters

    def __init__(self, robot: RobotDescription, parameters: LateralUndulationParameters) -> None:
        super().__init__(robot, parameters)
        self._body = PlanarBody(robot)
        self._bumpless_follower = BumplessFollower(robot, parameters.blend_s)
        self._phase_rad = 0.0

    def update(self, observation: Observation) -> ControllerCommand:
        """Advance the wave while there is a path to move along, and keep its phase otherwise."""
        elapsed_s = 0.0
        if is_motion_requested(observation):
            elapsed_s = observation.period_s
        reference = self.compute_reference_rad(observation, elapsed_s)
        setpoints = self._bumpless_follower.make_setpoints(observation, reference)
        return ControllerCommand(setpoints, Telemetry(reference_rad=reference.tolist()))

    def match_phase_to_angles(self, angles_rad: NDArray[np.float64]) -> None:
        """Set the phase at which the wave is most similar to measured joint angles, (n_joints,) in rad."""
        lags_rad = self.parameters.lag_rad * np.arange(len(self._body.yaw_joints))[::-1]
        correlation = angles_rad[self._body.yaw_joints] @ np.exp(1j * lags_rad)
        self._phase_rad = float(np.angle(1j * correlation))

    def compute_reference_rad(
        self, observation: Observation, elapsed_s: float
    ) -> NDArray[np.float64]:
        """Advance the phase of the wave, and compute the reference angles of all joints.

        Args:
            observation: The inputs of this tick.
            elapsed_s: Time by which the wave advances; negative to let the wave travel the other way.

        Returns:
            (n_joints,) angles in rad, tail to head.
        """
        self._phase_rad += math.tau * elapsed_s / self.parameters.period_s
        n = np.arange(len(self._body.yaw_joints))[::-1]  # 0 at the head
        waves = np.sin(self._phase_rad - self.parameters.lag_rad * n)
        reference = np.zeros(len(self.robot.joints))
        reference[self._body.yaw_joints] = self._compute_amplitude_rad(
            observation, waves, elapsed_s
        ) * waves + self._compute_bend_rad(observation)
        return reference

    def _compute_amplitude_rad(
        self, _observation: Observation, _waves: NDArray[np.float64], _elapsed_s: float
    ) -> float | NDArray[np.float64]:
        """Compute the amplitude of the wave: one for all yaw joints, or one for each, (n_yaw_joints,) in rad."""
        return self.parameters.amplitude_rad

    def _compute_bend_rad(self, observation: Observation) -> float | NDArray[np.float64]:
        """Compute the bend in rad that is added to every yaw joint to turn the body towards the path ahead.

        A body that moves by a wave towards the head turns against its bend, so the bend has the sign of the lag.
        """
        if (
            self.parameters.steering == 0.0
            or observation.world is None
            or observation.trajectory is None
        ):
            return 0.0
        body_points_w = self._body.compute_body_points_w(
            observation.world, observation.joints.angle_rad
        ).T
        head_w = body_points_w[-1]
        target_w = _find_steering_target(np.array(observation.trajectory.path_w), head_w)
        angle_rad = math.remainder(
            compute_direction_angle_rad(body_points_w, target_w - head_w), math.tau
        )
        return (
            math.copysign(self.parameters.steering, self.parameters.lag_rad)
            * angle_rad
            / len(self._body.yaw_joints)
        )


def _find_steering_target(
    path_w: NDArray[np.float64], head_w: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the point of a path, (n, 2), that is STEERING_DISTANCE_M ahead of the head, or its last point."""
    nearest_index = np.argmin(np.hypot(*(path_w - head_w).T))
    ahead_w = path_w[nearest_index:]
    distances_m = np.hypot(*(ahead_w - head_w).T)
    target_index = np.searchsorted(distances_m, STEERING_DISTANCE_M)
    return ahead_w[min(target_index, len(ahead_w) - 1)]


class HeadSteeredUndulationParameters(LateralUndulationParameters, frozen=True, kw_only=True):
    """Parameters of lateral undulation, with steering."""

    steering: Steering = 0.8
    """Bend of all joints for each radian that the path leads aside. 0: no steering."""


class HeadSteeredUndulation(LateralUndulation):
    """A wave that bends the body towards the path ahead."""

    Parameters = HeadSteeredUndulationParameters


class CompliantUndulationParameters(HeadSteeredUndulationParameters, frozen=True, kw_only=True):
    """Parameters of head-steered undulation, with a softness."""

    softness_rad_per_nm: Annotated[float, from_zero(10, "rad/(N*m)")] = 0.05
    """Change of the amplitude for the torque that obstacles put on the wave."""

    yield_s: Annotated[float, above(10, "s")] = 0.2
    """Time constant with which the amplitude yields."""

    jam_after_s: Annotated[float, from_zero(1000, "s")] = 0.0
    """Time with less than 2 cm of advance after which the wave travels the other way. 0: never."""

    back_s: Annotated[float, above(1000, "s")] = 1.0
    """Time for which the wave then travels the other way."""


class CompliantUndulation(HeadSteeredUndulation):
    """A wave whose amplitude A yields to the torques that obstacles put on the joints.

    A follows A0 + softness sum_i w_i tau_i with the time constant `yield_s`. tau_i is the torque from outside on joint
    i. The wave w_i = dtheta_i/dA, so the sum is the generalized force on A.

    Source: body-shape compliance, Travers et al. 2018.
    """

    Parameters = CompliantUndulationParameters
    required_measurements = ("torque",)

    def __init__(self, robot: RobotDescription, parameters: CompliantUndulationParameters) -> None:
        super().__init__(robot, parameters)
        self._yielded_amplitude_rad = parameters.amplitude_rad
        # Resolving jams; None if jams are not resolved.
        self._standstill_detector: StandstillDetector | None = None
        if parameters.jam_after_s > 0.0:
            self._standstill_detector = StandstillDetector(parameters.jam_after_s)
        self._reverse_duration_s = parameters.back_s
        self._reverse_end_s = -math.inf

    def compute_reference_rad(
        self, observation: Observation, elapsed_s: float
    ) -> NDArray[np.float64]:
        """Advance the phase of the wave, or turn it back during a jam, and compute the reference angles of all joints.

        Args:
            observation: The inputs of this tick.
            elapsed_s: Time since the last call; 0 to keep the phase.

        Returns:
            (n_joints,) angles in rad, tail to head.
        """
        if elapsed_s > 0.0 and self._is_reversing(observation, elapsed_s):
            elapsed_s = -elapsed_s
        return super().compute_reference_rad(observation, elapsed_s)

    def _is_reversing(self, observation: Observation, elapsed_s: float) -> bool:
        """Return whether the wave travels the other way at this tick, and watch whether the body is jammed.

        A jam that is detected at this tick reverses the wave from the next tick on, for `back_s`.
        """
        if self._standstill_detector is None or observation.world is None:
            return False
        if observation.time_s < self._reverse_end_s:
            return True
        center_w = self._body.compute_body_points_w(
            observation.world, observation.joints.angle_rad
        ).mean(axis=1)
        if self._standstill_detector.update(
            observation.time_s, elapsed_s, center_w, MAX_JAM_DISTANCE_M
        ):
            self._reverse_end_s = observation.time_s + self._reverse_duration_s
            self._standstill_detector.reset()
        return False

    def _compute_amplitude_rad(
        self, observation: Observation, waves: NDArray[np.float64], elapsed_s: float
    ) -> float:
        """Return the amplitude A: a first-order lag of A0 + softness sum_i w_i tau_i, bounded to 0 to 2 A0."""
        parameters = self.parameters
        assert isinstance(parameters, CompliantUndulationParameters)
        # Drives measure their own torque; the torque from outside is opposite to it.
        generalized_force_nm = -float(
            waves @ np.array(observation.joints.torque_nm)[self._body.yaw_joints]
        )
        desired_rad = (
            parameters.amplitude_rad + parameters.softness_rad_per_nm * generalized_force_nm
        )
        bounded_rad = min(max(desired_rad, 0.0), 2.0 * parameters.amplitude_rad)
        alpha = 1.0 - math.exp(-abs(elapsed_s) / parameters.yield_s)
        self._yielded_amplitude_rad += alpha * (bounded_rad - self._yielded_amplitude_rad)
        return self._yielded_amplitude_rad
