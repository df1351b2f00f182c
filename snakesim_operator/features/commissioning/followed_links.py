"""Whether the links of a robot that hangs by its tail turn as the encoders of its joints say: by their gyros. Pure.

The tail link is clamped. So the encoders alone tell how every link turns, link by link from the tail. The first link
whose gyro disagrees is behind a joint with backlash, or with another gear or sign than the robot file says. What is
further ahead turns with it, and cannot be judged.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot import RobotFile
from snakesim_operator.features.commissioning.hanging import AXES, rotations_about
from snakesim_operator.features.commissioning.measured import PITCH, YAW

MIN_SAMPLES = 20  # of a gyro
MAX_DISAGREEMENT = 0.06  # of the link's rate, rms; sound joints show 0.02 of it, 10 mrad of backlash 0.12
MIN_DISAGREEMENT_RAD_S = 0.03  # less may be noise of gyros and of encoders
NEAR = 0.12  # of 1: the ratio of a sound joint


@dataclass(frozen=True)
class Unfollowed:
    """The first joint from the tail whose link does not turn as its encoder says."""

    joint: int
    cause: Literal["backlash", "ratio"]
    ratio: float  # of the link's rate to that of the encoder

    @property
    def reason(self) -> str:
        """What it means, and what to do."""
        again = "run `snakesim run joint_check`, correct it, and identify again"
        if self.cause == "ratio":
            return f"its link turns {self.ratio:+.2f} times as far as its encoder says: {again}"
        clamp = ", or a clamp that lets the tail link move" if self.joint == 0 else ""
        return f"its link does not follow its encoder: backlash, a gear that slips{clamp}; {again}"


def find_unfollowed(
    robot: RobotFile, period_s: float, angle_rad: Floats, velocity_rad_s: Floats, link_rate_rad_s: Floats
) -> Unfollowed | None:
    """Return the first joint whose link disagrees with its encoder; None if there is none, or no link has a gyro.

    Args:
        robot: whose tail link is clamped.
        period_s: of a tick.
        angle_rad: by the encoders, (n, joints).
        velocity_rad_s: by the encoders, (n, joints).
        link_rate_rad_s: by gyros in the links' frames, (n, links, 3); NaN where none reported.
    """
    turn_rad_s = np.zeros((len(angle_rad), 3))  # of a link, in its own frame
    for joint, axis in enumerate(robot.axes):
        direction = np.array(AXES[axis])
        rotation = rotations_about(direction, angle_rad[:, joint])  # from this link's frame to that of the one before
        before_rad_s = np.einsum("nji,nj->ni", rotation, turn_rad_s)
        turn_rad_s = before_rad_s + velocity_rad_s[:, joint, None] * direction
        component = YAW if axis == "yaw" else PITCH
        found = _compare(
            joint,
            velocity_rad_s[:, joint],
            before_rad_s[:, component],
            np.gradient(turn_rad_s[:, component], period_s),
            link_rate_rad_s[:, joint + 1, component],
        )
        if found is not None:
            return found
    return None


def _compare(
    joint: int, own_rad_s: Floats, before_rad_s: Floats, acceleration_rad_s2: Floats, gyro_rad_s: Floats
) -> Unfollowed | None:
    """Compare a gyro with the encoders, but for a ratio of its own joint's, a bias and a delay of the gyro."""
    known = ~np.isnan(gyro_rad_s)
    if known.sum() < MIN_SAMPLES:
        return None
    rows = np.column_stack((own_rad_s, acceleration_rad_s2, np.ones(len(own_rad_s))))[known]
    ahead_rad_s = (gyro_rad_s - before_rad_s)[known]
    values = np.linalg.lstsq(rows, ahead_rad_s, rcond=None)[0]
    ratio = float(values[0])
    disagreement_rad_s = float(np.std(ahead_rad_s - rows @ values))
    rate_rad_s = float(np.std(own_rad_s + before_rad_s))
    if disagreement_rad_s > max(MAX_DISAGREEMENT * rate_rad_s, MIN_DISAGREEMENT_RAD_S):
        return Unfollowed(joint, "backlash", ratio)
    if abs(ratio - 1) > NEAR:
        return Unfollowed(joint, "ratio", ratio)
    return None
