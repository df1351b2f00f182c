"""The parameters that one method has estimated for one robot, together with their true values."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.physics.loose_gear import LINK_SIDE_INERTIA_RATIO
from verification.identification_trials import HiddenRobot

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
MAX_CLOSE_ERROR = 0.1  # relative error up to which a value counts as close


@dataclass(frozen=True)
class Estimate:
    """One estimated parameter of one joint, together with its true value."""

    joint_index: int
    parameter: str
    value: float | None  # None: not identified
    half_width: float  # of the 95 % interval
    truth: float

    @property
    def error(self) -> float | None:
        """Return the relative error, or None if the value is unknown."""
        if self.value is None:
            return None
        return abs(self.value / self.truth - 1)

    @property
    def covers(self) -> bool:
        """Return whether the interval covers the true value."""
        return self.value is not None and abs(self.value - self.truth) <= self.half_width

    @property
    def is_close(self) -> bool:
        """Return whether the value is known and close to the true value."""
        return self.error is not None and self.error < MAX_CLOSE_ERROR

    @property
    def misleads(self) -> bool:
        """Return whether the value is known and wrong, and its interval does not cover the true value."""
        return self.value is not None and not self.is_close and not self.covers


@dataclass(frozen=True)
class IdentificationResult:
    """The estimates of one method for one robot, and whether it noticed that the robot does not fit its model."""

    estimates: Sequence[Estimate]
    cpu_s: float
    warns: bool  # whether the method reports that the robot does not fit its model
    suspect: int | None = None  # index of the joint that it names as the reason
    # Rms of the residuals, in standard deviations of the sensor noise; None if the method does not know the noise.
    noise_ratio: float | None = None


def get_truth(robot: HiddenRobot, joint_index: int, parameter: str) -> float:
    """Return the true value of a parameter of a joint."""
    if parameter == "latency_s":
        return robot.latency_s[joint_index]
    joint = robot.config.robot.joint_table[joint_index]
    hidden = getattr(robot.true_drives[joint.name], parameter, None)
    true_value = getattr(joint.motor, parameter) if hidden is None else hidden
    if parameter == "armature_kg_m2" and joint_index == robot.loose_joint:
        # The methods measure rotor and output stage of the gear together.
        true_value *= 1 + LINK_SIDE_INERTIA_RATIO
    return true_value
