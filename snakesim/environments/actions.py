"""The actions of an environment: a target for every joint, with unit and bounds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, suggest_word
from snakesim_hal.wire.messages import JointMode, RobotDescription

RESIDUAL_PREFIX = "residual:"
MODE_AND_UNIT_BY_KIND = {
    "position": (JointMode.POSITION, "rad"),
    "velocity": (JointMode.VELOCITY, "rad/s"),
    "torque": (JointMode.TORQUE, "N·m"),
}


@dataclass(frozen=True)
class ActionTargets:
    """What an action of an environment commands, joint by joint, tail to head."""

    kind: str  # "position", "velocity", "torque", or "residual:CONTROLLER"
    mode: JointMode
    unit: str
    names: Sequence[str]  # of the joints
    low: Sequence[float]  # lower bound for each joint, in the unit of the action
    high: Sequence[float]  # upper bound for each joint

    @staticmethod
    def for_robot(robot: RobotDescription, kind: str, residual_rad: float) -> "ActionTargets":
        """Return the targets of the actions of a robot: their mode and unit, and the bounds for each joint.

        Args:
            robot: Description of the robot, with the limits of the joints.
            kind: Kind of action: "position", "velocity", "torque", or "residual:CONTROLLER", as
                `parse_corrected_controller` accepts it.
            residual_rad: Largest correction of a joint, for "residual:CONTROLLER". Ignored for other kinds.

        Raises:
            KeyError: There is no such kind of action.
        """
        joints = robot.joints
        names = [joint.name for joint in joints]
        if kind.startswith(RESIDUAL_PREFIX):
            high = [residual_rad] * len(joints)
            return ActionTargets(
                kind, JointMode.POSITION, "rad", names, [-value for value in high], high
            )
        mode, unit = MODE_AND_UNIT_BY_KIND[kind]
        match mode:
            case JointMode.POSITION:
                low = [joint.angle_min_rad for joint in joints]
                high = [joint.angle_max_rad for joint in joints]
            case JointMode.VELOCITY:
                high = [joint.speed_limit_rad_s for joint in joints]
                low = [-value for value in high]
            case _:  # JointMode.TORQUE, the last mode in MODE_AND_UNIT_BY_KIND
                high = [joint.torque_limit_nm for joint in joints]
                low = [-value for value in high]
        return ActionTargets(kind, mode, unit, names, low, high)

    def convert_action(self, action: Any) -> Floats:
        """Convert the action of one environment to targets.

        Args:
            action: A number for each joint, tail to head, as an array or a sequence.

        Returns:
            The targets as a new array, (joints,), in the unit of the action.

        Raises:
            ValueError: The action has another shape, or holds a number that is not finite.
        """
        values = _convert_to_array(
            "action", action, (len(self.names),), f"must be {self._describe_expected()}"
        )
        self._check_finite(values, "action")
        return values

    def convert_actions(self, actions: Any, count: int) -> Floats:
        """Convert the actions of many environments to targets.

        Args:
            actions: An action for each environment, (count, joints), as an array or a sequence.
            count: Number of environments.

        Returns:
            The targets as a new array, (count, joints), in the unit of the actions.

        Raises:
            ValueError: The actions have another shape, or hold a number that is not finite.
        """
        expected = f"must have {count} rows, and each row {self._describe_expected()}"
        values = _convert_to_array("actions", actions, (count, len(self.names)), expected)
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(axis=1)))
            self._check_finite(values[row], f"actions[{row}]")
        return values

    def _check_finite(self, values: Floats, name: str) -> None:
        """Raise ValueError for a number that is not finite. The error names the array, the joint and the value."""
        if not np.isfinite(values).all():
            bad_index = int(np.argmin(np.isfinite(values)))
            joint_name = self.names[bad_index]
            raise ValueError(
                f"{name}[{bad_index}] ({joint_name}) is {values[bad_index]}, must be a finite number of {self.unit}"
            )

    def _describe_expected(self) -> str:
        """Return the shape and the meaning of a valid action, for an error message."""
        count = len(self.names)
        what = "a correction" if self.kind.startswith(RESIDUAL_PREFIX) else f"a {self.kind}"
        return (
            f"({count},): {what} in {self.unit} for each joint, {self.names[0]} to {self.names[-1]}"
        )


def _convert_to_array(name: str, argument: Any, shape: tuple[int, ...], expected: str) -> Floats:
    """Convert an argument to a new array of a required shape.

    Args:
        name: Name of the argument, for the error message.
        argument: Array or sequence of numbers.
        shape: Shape that the array must have.
        expected: Description of a valid argument, for the error message.

    Raises:
        ValueError: The argument cannot be converted to numbers, or has another shape.
    """
    try:
        values: Floats = np.array(argument, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {argument!r:.60}, {expected}") from None
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}, {expected}")
    return values


def parse_corrected_controller(kind: str) -> str | None:
    """Return the controller whose targets an action corrects, or None if an action is itself a target.

    Raises:
        ConfigError: There is no such kind of action.
    """
    if isinstance(kind, str) and kind.startswith(RESIDUAL_PREFIX) and kind != RESIDUAL_PREFIX:
        return kind.removeprefix(RESIDUAL_PREFIX)
    if kind not in MODE_AND_UNIT_BY_KIND:
        hint = suggest_word(str(kind), MODE_AND_UNIT_BY_KIND)
        raise ConfigError(
            f"action={kind!r:.60}: {hint}give 'position', 'velocity', 'torque', or 'residual:' and a controller, such "
            "as 'residual:obstacle_aided'",
            code="python/invalid-argument",
        )
    return None
