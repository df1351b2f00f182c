"""What one method has identified of one robot, beside the truth."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.physics.loose_gear import LINK_SIDE_INERTIA_RATIO
from verification.commissioning_trials import HiddenRobot

PARAMETERS = (
    "friction_nm",
    "viscous_nm_s_per_rad",
    "armature_kg_m2",
    "response_time_s",
    "torque_constant_nm_per_a",
    "stiffness_nm_per_rad",
    "damping_nm_s_per_rad",
    "latency_s",
)
CLOSE = 0.1  # relative error that counts as close


@dataclass(frozen=True)
class Estimate:
    """One identified value of one joint, beside the truth."""

    joint_index: int
    parameter: str
    value: float | None  # None: not identified
    half_width: float  # of the 95 % interval
    truth: float

    @property
    def error(self) -> float | None:
        """Relative error; None if the value is unknown."""
        return None if self.value is None else abs(self.value / self.truth - 1)

    @property
    def covers(self) -> bool:
        """Whether the interval covers the truth."""
        return self.value is not None and abs(self.value - self.truth) <= self.half_width

    @property
    def is_close(self) -> bool:
        """Whether the value is known and close to the truth."""
        return self.error is not None and self.error < CLOSE

    @property
    def misleads(self) -> bool:
        """Whether the value is not close to the truth, and its interval does not cover the truth either."""
        return self.value is not None and not self.is_close and not self.covers


@dataclass(frozen=True)
class Identified:
    """What one method has found of one robot."""

    estimates: Sequence[Estimate]
    cpu_s: float
    warns: bool  # it reports that the robot does not fit its model
    suspect: int | None = None  # index of the joint that it names as the reason
    # Rms of what the fit leaves unexplained, in standard deviations of the noise. None: the method knows no noise.
    noise_ratio: float | None = None


def get_truth(robot: HiddenRobot, joint_index: int, parameter: str) -> float:
    """Return the true value of a parameter of a joint."""
    if parameter == "latency_s":
        return robot.latency_s[joint_index]
    joint = robot.config.robot.joint_table[joint_index]
    hidden = getattr(robot.truth[joint.name], parameter, None)
    truth = getattr(joint.motor, parameter) if hidden is None else hidden
    if parameter == "armature_kg_m2" and joint_index == robot.loose:
        truth *= (
            1 + LINK_SIDE_INERTIA_RATIO
        )  # the output stage of the gear comes on top of the rotor
    return truth
