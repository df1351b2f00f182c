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

from snakesim_gnc.control.bumpless import Blend, BumplessReference
from snakesim_gnc.control.standstill import Standstill
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, is_motion_requested
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import above, bounded, from_zero

AIM_DISTANCE_M = 1.0  # how far ahead on the path the head steers for
JAMMED_M = 0.02  # a body that moves less than this within `jam_after_s` is jammed

Steering = Annotated[float, from_zero(2, "1")]


def aside_rad(nodes_w: NDArray[np.float64], aim_w: NDArray[np.float64]) -> float:
    """Return the angle from the direction of a body to a direction, left positive, in rad.

    Args:
        nodes_w: (n, 2) m, nodes of the body, tail to head.
        aim_w: (2,) the direction, of any length.

    Returns:
        The angle, between -2 pi and 2 pi.
    """
    along_w = nodes_w[-1] - nodes_w[0]
    return math.atan2(aim_w[1], aim_w[0]) - math.atan2(along_w[1], along_w[0])


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

    def __init__(self, robot: Description, parameters: LateralUndulationParameters) -> None:
        super().__init__(robot, parameters)
        self._body = PlanarBody(robot)
        self._bumpless = BumplessReference(robot, parameters.blend_s)
        self._phase_rad = 0.0

    def update(self, observation: Observation) -> ControllerCommand:
        """Advance the wave while there is a path to move along, and keep its phase otherwise."""
        passed_s = 0.0
        if is_motion_requested(observation):
            passed_s = observation.period_s
        reference = self.reference_rad(observation, passed_s)
        setpoints = self._bumpless.follow(observation, reference)
        return ControllerCommand(setpoints, Telemetry(reference_rad=reference.tolist()))

    def start_from(self, angles_rad: NDArray[np.float64]) -> None:
        """Choose the phase at which the wave is most similar to a shape, (n_joints,) rad."""
        lags_rad = self.parameters.lag_rad * np.arange(len(self._body.bends))[::-1]
        correlation = angles_rad[self._body.bends] @ np.exp(1j * lags_rad)
        self._phase_rad = float(np.angle(1j * correlation))

    def reference_rad(self, observation: Observation, passed_s: float) -> NDArray[np.float64]:
        """Return the angles of all joints, (n_joints,), `passed_s` later than in the last call."""
        self._phase_rad += math.tau * passed_s / self.parameters.period_s
        n = np.arange(len(self._body.bends))[::-1]  # 0 at the head
        waves = np.sin(self._phase_rad - self.parameters.lag_rad * n)
        reference = np.zeros(len(self.robot.joints))
        reference[self._body.bends] = self._amplitude_rad(observation, waves, passed_s) * waves + self._bend_rad(
            observation
        )
        return reference

    def _amplitude_rad(
        self, _observation: Observation, _waves: NDArray[np.float64], _passed_s: float
    ) -> float | NDArray[np.float64]:
        """Return the amplitude of all joints, or of each joint that bends, (n_bends,)."""
        return self.parameters.amplitude_rad

    def _bend_rad(self, observation: Observation) -> float | NDArray[np.float64]:
        """Return the bend of every joint that turns the body towards the path ahead.

        A body that moves by a wave towards the head turns against its bend, so the bend has the sign of the lag.
        """
        if self.parameters.steering == 0.0 or observation.world is None or observation.trajectory is None:
            return 0.0
        nodes_w = self._body.nodes_w(observation.world, observation.joints.angle_rad).T
        head_w = nodes_w[-1]
        aim_w = _find_aim(np.array(observation.trajectory.path_w), head_w)
        angle_rad = math.remainder(aside_rad(nodes_w, aim_w - head_w), math.tau)
        return math.copysign(self.parameters.steering, self.parameters.lag_rad) * angle_rad / len(self._body.bends)


def _find_aim(path_w: NDArray[np.float64], head_w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point of a path, (n, 2), that is AIM_DISTANCE_M ahead of the head, or its last point."""
    nearest = np.argmin(np.hypot(*(path_w - head_w).T))
    ahead_w = path_w[nearest:]
    distances_m = np.hypot(*(ahead_w - head_w).T)
    aim = np.searchsorted(distances_m, AIM_DISTANCE_M)
    return ahead_w[min(aim, len(ahead_w) - 1)]


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

    def __init__(self, robot: Description, parameters: CompliantUndulationParameters) -> None:
        super().__init__(robot, parameters)
        self._yielded_amplitude_rad = parameters.amplitude_rad
        # Resolving jams; None: never.
        self._standstill: Standstill | None = None
        if parameters.jam_after_s > 0.0:
            self._standstill = Standstill(parameters.jam_after_s)
        self._reverse_s = parameters.back_s
        self._reverse_until_s = -math.inf

    def reference_rad(self, observation: Observation, passed_s: float) -> NDArray[np.float64]:
        """Return the angles of all joints, (n_joints,), later than in the last call, or earlier during a jam."""
        if passed_s > 0.0 and self._is_reversing(observation, passed_s):
            passed_s = -passed_s
        return super().reference_rad(observation, passed_s)

    def _is_reversing(self, observation: Observation, passed_s: float) -> bool:
        """Whether the wave travels the other way at this tick; a jam that is detected starts it at the next tick."""
        if self._standstill is None or observation.world is None:
            return False
        if observation.time_s < self._reverse_until_s:
            return True
        center_w = self._body.nodes_w(observation.world, observation.joints.angle_rad).mean(axis=1)
        if self._standstill.update(observation.time_s, passed_s, center_w, JAMMED_M):
            self._reverse_until_s = observation.time_s + self._reverse_s
            self._standstill.reset()
        return False

    def _amplitude_rad(self, observation: Observation, waves: NDArray[np.float64], passed_s: float) -> float:
        """Return the amplitude A: a first-order lag of A0 + softness sum_i w_i tau_i, bounded to 0 to 2 A0."""
        parameters = self.parameters
        assert isinstance(parameters, CompliantUndulationParameters)
        # Drives measure their own torque; the torque from outside is opposite to it.
        generalized_force_nm = -float(waves @ np.array(observation.joints.torque_nm)[self._body.bends])
        desired_rad = parameters.amplitude_rad + parameters.softness_rad_per_nm * generalized_force_nm
        bounded_rad = min(max(desired_rad, 0.0), 2.0 * parameters.amplitude_rad)
        gain = 1.0 - math.exp(-abs(passed_s) / parameters.yield_s)
        self._yielded_amplitude_rad += gain * (bounded_rad - self._yielded_amplitude_rad)
        return self._yielded_amplitude_rad
