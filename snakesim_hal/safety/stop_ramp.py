"""The setpoints of a robot that is not armed, and the ramp that brings an armed robot to rest after a fault. Pure.

The robot file chooses the stop mode of a fault: `passive`, `damp` or `hold`. In every other state that is not armed,
all joints are passive.

For `hold`, the joints are brought to rest and held there. A reference angle starts from the measured angle at the
measured velocity, and slows down by the acceleration limit. The position target follows it no faster than the speed
limit, starting where the motor keeps its torque. Both stay inside the angle limits, which takes precedence over the
rate of the target.

For `damp`, a joint with a velocity mode gets the velocity target 0. A joint without one follows the ramp, and becomes
passive when the ramp is at rest.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, MeasuredState
from snakesim_hal.safety.limiter import compute_bumpless_target
from snakesim_hal.wire.messages import JointMode, LifecycleState, StopMode


@dataclass(frozen=True)
class StopRamp:
    """The state of the ramp that brings joints to rest, (n_joints,) each."""

    reference_rad: Floats
    velocity_rad_s: Floats  # of the reference angle
    target_rad: Floats

    @staticmethod
    def start(measured: MeasuredState, last: AppliedSetpoints, limits: JointLimits) -> "StopRamp":
        """Return a ramp that starts from the measured state and the last setpoints, without a jump of the torque.

        Args:
            measured: Measured joint state.
            last: Setpoints of the last period.
            limits: Limits of the robot.
        """
        angle_rad = measured.angle_rad
        joint_states = zip(
            limits.joints,
            angle_rad.tolist(),
            measured.velocity_rad_s.tolist(),
            measured.torque_nm.tolist(),
            strict=True,
        )
        bumpless_rad = [
            compute_bumpless_target(joint, JointMode.POSITION, angle, velocity, torque)
            for joint, angle, velocity, torque in joint_states
        ]
        # A joint in position mode continues from its last target, any other one where its motor keeps its torque.
        start_target_rad = np.where(last.mode == JointMode.POSITION, last.target, bumpless_rad)
        lower_rad = angle_rad - limits.max_step_rad
        upper_rad = angle_rad + limits.max_step_rad
        limited_target_rad = np.clip(start_target_rad, lower_rad, upper_rad)
        velocity_rad_s = np.clip(measured.velocity_rad_s, -limits.speed_rad_s, limits.speed_rad_s)
        return StopRamp(
            reference_rad=limits.clip_angles(angle_rad),
            velocity_rad_s=velocity_rad_s,
            target_rad=limits.clip_angles(limited_target_rad),
        )

    def advance(self, limits: JointLimits) -> "StopRamp":
        """Return the ramp after one control period T.

        The reference brakes from v0 to v1 = sign(v0) max(|v0| - a T, 0), and moves by (v0 + v1) T / 2.
        """
        period_s = limits.period_s
        next_velocity_rad_s = np.maximum(
            np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s, 0.0
        )
        next_velocity_rad_s *= np.sign(self.velocity_rad_s)
        mean_velocity_rad_s = 0.5 * (self.velocity_rad_s + next_velocity_rad_s)
        reference_rad = limits.clip_angles(self.reference_rad + mean_velocity_rad_s * period_s)
        step_rad = limits.speed_rad_s * period_s
        target_rad = np.clip(reference_rad, self.target_rad - step_rad, self.target_rad + step_rad)
        return StopRamp(reference_rad, next_velocity_rad_s, target_rad)


class StopReaction:
    """The setpoints of a robot that is not armed, by its stop mode."""

    def __init__(self, limits: JointLimits, stop_mode: StopMode) -> None:
        self._limits = limits
        self._stop_mode: StopMode = stop_mode
        # None unless the robot was armed when the current fault was latched.
        self._ramp: StopRamp | None = None

    def start_ramp(self, measured: MeasuredState, last: AppliedSetpoints) -> None:
        """Start the ramp that brings a moving robot to rest. Call this when its lifecycle leaves `armed`."""
        self._ramp = StopRamp.start(measured, last, self._limits)

    def cancel_ramp(self) -> None:
        """Remove the ramp, so that the next setpoints are passive."""
        self._ramp = None

    def make_setpoints(self, state: LifecycleState, torque_nm: Floats) -> AppliedSetpoints:
        """Return the setpoints of the next period in a state other than `armed`, and advance the ramp.

        Args:
            state: Current lifecycle state.
            torque_nm: (n_joints,) torque limits after derating.
        """
        if state != "fault" or self._ramp is None:
            return self._make_passive_setpoints(torque_nm)
        match self._stop_mode:
            case "passive":
                return self._make_passive_setpoints(torque_nm)
            case "damp":
                return self._make_damping_setpoints(self._ramp, torque_nm)
            case "hold":
                self._ramp = self._ramp.advance(self._limits)
                return make_uniform_setpoints(JointMode.POSITION, self._ramp.target_rad, torque_nm)

    def _make_passive_setpoints(self, torque_nm: Floats) -> AppliedSetpoints:
        return make_uniform_setpoints(JointMode.PASSIVE, np.zeros_like(torque_nm), torque_nm)

    def _make_damping_setpoints(self, ramp: StopRamp, torque_nm: Floats) -> AppliedSetpoints:
        """Return velocity targets of 0. Joints without a velocity mode follow the ramp until they are at rest."""
        has_velocity_mode = self._limits.has_velocity_mode
        if has_velocity_mode.all():
            return make_uniform_setpoints(JointMode.VELOCITY, np.zeros_like(torque_nm), torque_nm)
        ramp = ramp.advance(self._limits)
        self._ramp = ramp
        at_rest = ramp.velocity_rad_s == 0.0
        modes = np.select(
            [has_velocity_mode, at_rest],
            [int(JointMode.VELOCITY), int(JointMode.PASSIVE)],
            int(JointMode.POSITION),
        )
        target = np.where(modes == int(JointMode.POSITION), ramp.target_rad, 0.0)
        return AppliedSetpoints(modes.astype(np.int64), target, torque_nm)


def make_uniform_setpoints(mode: JointMode, target: Floats, torque_nm: Floats) -> AppliedSetpoints:
    """Return setpoints of one mode for all joints. `target` and `torque_nm` have the shape (n_joints,)."""
    return AppliedSetpoints(np.full(len(target), int(mode), dtype=np.int64), target, torque_nm)
