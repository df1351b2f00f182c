"""Compares how the links of a robot suspended by its tail turn, by their gyros, with what the encoders measure. Pure.

The tail link is clamped. So the encoders alone give the rate of every link, link by link from the tail. The first link
whose gyro disagrees is ahead of a joint with backlash, or with another gear or sign than the robot file has. The links
further ahead turn with it, and cannot be judged.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.commissioning.joint_check.measurements import PITCH, YAW
from snakesim_operator.features.commissioning.system_identification.suspended_load import (
    UNIT_VECTOR_BY_AXIS,
    make_rotations_about,
)

MIN_SAMPLES = 20  # of a gyro
# Of the link's rate, rms; intact joints show 0.02 of it, 10 mrad of backlash 0.12.
MAX_DISAGREEMENT = 0.06
MIN_DISAGREEMENT_RAD_S = 0.03  # less may be noise of gyros and of encoders
MAX_RATIO_ERROR = 0.12  # of an intact joint, whose ratio is 1


@dataclass(frozen=True)
class LinkMismatch:
    """The first joint from the tail whose link does not turn as its encoder measures."""

    joint_index: int
    cause: Literal["backlash", "ratio"]
    ratio: float  # of the link's rate to that of the encoder

    @property
    def reason(self) -> str:
        """What it means, and what to do."""
        again = "run `snakesim run joint_check`, correct it, and identify again"
        if self.cause == "ratio":
            return f"its link turns {self.ratio:+.2f} times as far as its encoder measures: {again}"
        clamp = ""
        if self.joint_index == 0:
            clamp = ", or a clamp that lets the tail link move"
        return f"its link does not follow its encoder: backlash, a gear that slips{clamp}; {again}"


def find_link_mismatch(
    robot: RobotFile,
    period_s: float,
    angle_rad: Floats,
    velocity_rad_s: Floats,
    link_rate_rad_s: Floats,
) -> LinkMismatch | None:
    """Return the first joint from the tail whose link does not turn as its encoder measures.

    The angular rate of each link is computed from the encoders, starting at the clamped tail link, which does not
    move, and compared with the gyro on that link.

    Args:
        robot: The robot, whose tail link is clamped.
        period_s: Period of a tick.
        angle_rad: (n, joints) joint angles by the encoders.
        velocity_rad_s: (n, joints) joint velocities by the encoders.
        link_rate_rad_s: (n, links, 3) angular rates by the gyros, each in the frame of its link; NaN where no gyro
            reported.

    Returns:
        The joint and how it disagrees; None if all joints agree, or if no link has a gyro.
    """
    omega_rad_s = np.zeros((len(angle_rad), 3))  # angular velocity of a link, in its own frame
    for joint, axis_name in enumerate(robot.axes):
        axis = np.array(UNIT_VECTOR_BY_AXIS[axis_name])
        component = YAW if axis_name == "yaw" else PITCH
        # From the link ahead to the link behind the joint.
        rotation = make_rotations_about(axis, angle_rad[:, joint])
        # In the frame of the link ahead.
        link_behind_rad_s = np.einsum("nji,nj->ni", rotation, omega_rad_s)
        omega_rad_s = link_behind_rad_s + velocity_rad_s[:, joint, None] * axis
        mismatch = _find_gyro_mismatch(
            joint,
            joint_velocity_rad_s=velocity_rad_s[:, joint],
            link_behind_rad_s=link_behind_rad_s[:, component],
            acceleration_rad_s2=np.gradient(omega_rad_s[:, component], period_s),
            gyro_rad_s=link_rate_rad_s[:, joint + 1, component],
        )
        if mismatch is not None:
            return mismatch
    return None


def _find_gyro_mismatch(
    joint_index: int,
    *,
    joint_velocity_rad_s: Floats,
    link_behind_rad_s: Floats,
    acceleration_rad_s2: Floats,
    gyro_rad_s: Floats,
) -> LinkMismatch | None:
    """Compare the gyro on the link ahead of a joint with the encoders.

    Ratio of the joint, delay and bias of the gyro are fitted by least squares; what remains is the disagreement:

        gyro = behind + ratio * joint - delay * acceleration + bias

    Args:
        joint_index: Index of the joint.
        joint_velocity_rad_s: (n,) velocity of the joint by its encoder.
        link_behind_rad_s: (n,) angular rate of the link behind the joint by the encoders, about the joint's axis.
        acceleration_rad_s2: (n,) angular acceleration of the link ahead by the encoders, about the joint's axis.
        gyro_rad_s: (n,) angular rate of the link ahead by its gyro, about the joint's axis; NaN where unknown.

    Returns:
        How the link disagrees with its encoder; None if it agrees, or if the gyro reported too rarely.
    """
    is_known = ~np.isnan(gyro_rad_s)
    if is_known.sum() < MIN_SAMPLES:
        return None
    bias_column = np.ones(len(joint_velocity_rad_s))
    regressors = np.column_stack((joint_velocity_rad_s, acceleration_rad_s2, bias_column))[is_known]
    joint_velocity_by_gyro_rad_s = (gyro_rad_s - link_behind_rad_s)[is_known]
    coefficients = np.linalg.lstsq(regressors, joint_velocity_by_gyro_rad_s, rcond=None)[0]
    ratio = float(coefficients[0])
    residuals_rad_s = joint_velocity_by_gyro_rad_s - regressors @ coefficients
    disagreement_rad_s = float(np.std(residuals_rad_s))
    rate_rad_s = float(np.std(joint_velocity_rad_s + link_behind_rad_s))
    if disagreement_rad_s > max(MAX_DISAGREEMENT * rate_rad_s, MIN_DISAGREEMENT_RAD_S):
        return LinkMismatch(joint_index, "backlash", ratio)
    if abs(ratio - 1) > MAX_RATIO_ERROR:
        return LinkMismatch(joint_index, "ratio", ratio)
    return None
