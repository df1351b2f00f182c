"""The stop mode `hold`: the joints are brought to rest, and held there. Pure.

Also how `damp` brings a joint to rest that has no velocity mode; it is let go then.

A reference angle starts from the measured one at the measured velocity, and slows down by the acceleration limit. The
position target follows it no faster than the speed limit, starting where the motor keeps its torque. Both
stay inside the angle limits, which takes precedence over the rate of the target.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.safety.limiter import Applied, Floats, JointLimits, Measured, bumpless_target
from snakesim_hal.wire.messages import Mode


@dataclass(frozen=True)
class StopRamp:
    """A robot that is brought to rest, (n_joints,) each."""

    wanted_rad: Floats
    velocity_rad_s: Floats  # of the reference angle
    target_rad: Floats

    @staticmethod
    def begin(measured: Measured, last: Applied, limits: JointLimits) -> "StopRamp":
        """From the measured state, and the last setpoints."""
        angle, velocity = measured.angle_rad, measured.velocity_rad_s
        states = zip(limits.joints, angle.tolist(), velocity.tolist(), measured.torque_nm.tolist(), strict=True)
        bumpless = [bumpless_target(joint, Mode.POSITION, *now) for joint, *now in states]
        target = np.where(last.mode == Mode.POSITION, last.target, bumpless)
        near = np.clip(target, angle - limits.max_step_rad, angle + limits.max_step_rad)
        slowed = np.clip(velocity, -limits.speed_rad_s, limits.speed_rad_s)
        return StopRamp(limits.inside(angle), slowed, limits.inside(near))

    def after_a_period(self, limits: JointLimits) -> "StopRamp":
        """One period later."""
        period_s = limits.period_s
        slower = np.maximum(np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s, 0.0)
        slower *= np.sign(self.velocity_rad_s)
        wanted = limits.inside(self.wanted_rad + 0.5 * (self.velocity_rad_s + slower) * period_s)
        step = limits.speed_rad_s * period_s
        target = np.clip(wanted, self.target_rad - step, self.target_rad + step)
        return StopRamp(wanted, slower, target)
