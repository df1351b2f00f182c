"""The actions of an environment: a target for every joint, with unit and bounds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, suggest_word
from snakesim_hal.wire.messages import Description, Mode

RESIDUAL = "residual:"
KINDS = {"position": (Mode.POSITION, "rad"), "velocity": (Mode.VELOCITY, "rad/s"), "torque": (Mode.TORQUE, "N·m")}


@dataclass(frozen=True)
class Commands:
    """What an action of an environment commands, joint by joint, tail to head."""

    kind: str
    mode: Mode
    unit: str
    names: Sequence[str]  # of the joints
    low: Sequence[float]
    high: Sequence[float]

    @staticmethod
    def of(robot: Description, kind: str, residual_rad: float) -> "Commands":
        """Return the actions of a robot.

        Args:
            robot: Description with the joints and their limits.
            kind: "position", "velocity", "torque", or "residual:CONTROLLER".
            residual_rad: Largest correction of a joint, for "residual:CONTROLLER".
        """
        joints = robot.joints
        names = [joint.name for joint in joints]
        if kind.startswith(RESIDUAL):
            high = [residual_rad] * len(joints)
            return Commands(kind, Mode.POSITION, "rad", names, [-value for value in high], high)
        mode, unit = KINDS[kind]
        match mode:
            case Mode.POSITION:
                low = [joint.angle_min_rad for joint in joints]
                high = [joint.angle_max_rad for joint in joints]
            case Mode.VELOCITY:
                high = [joint.speed_limit_rad_s for joint in joints]
                low = [-value for value in high]
            case _:
                high = [joint.torque_limit_nm for joint in joints]
                low = [-value for value in high]
        return Commands(kind, mode, unit, names, low, high)

    def target(self, action: Any) -> Floats:
        """Return the targets of an action.

        Args:
            action: (joints,) numbers, tail to head; an array or a sequence.

        Returns:
            A new array, (joints,).

        Raises:
            ValueError: The action has another shape, or holds a number that is not finite.
        """
        values = _read_numbers("action", action, (len(self.names),), f"must be {self._describe_expected()}")
        self._check_finite(values, "action")
        return values

    def targets(self, actions: Any, count: int) -> Floats:
        """Return the targets of the actions of many environments.

        Args:
            actions: (count, joints) numbers; an array or a sequence.
            count: number of environments.

        Returns:
            A new array, (count, joints).

        Raises:
            ValueError: The actions have another shape, or hold a number that is not finite.
        """
        expected = f"must have {count} rows, and each row {self._describe_expected()}"
        values = _read_numbers("actions", actions, (count, len(self.names)), expected)
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(axis=1)))
            self._check_finite(values[row], f"actions[{row}]")
        return values

    def _check_finite(self, values: Floats, name: str) -> None:
        """Raise ValueError for a number that is not finite. `name` is that of the array."""
        if not np.isfinite(values).all():
            bad = int(np.argmin(np.isfinite(values)))
            raise ValueError(
                f"{name}[{bad}] ({self.names[bad]}) is {values[bad]}, must be a finite number of {self.unit}"
            )

    def _describe_expected(self) -> str:
        count = len(self.names)
        what = "a correction" if self.kind.startswith(RESIDUAL) else f"a {self.kind}"
        return f"({count},): {what} in {self.unit} for each joint, {self.names[0]} to {self.names[-1]}"


def _read_numbers(name: str, given: Any, shape: tuple[int, ...], expected: str) -> Floats:
    """Return an argument as a new array.

    Args:
        name: of the argument, for errors.
        given: its value.
        shape: that the array must have.
        expected: what the argument must be, in words.

    Raises:
        ValueError: It is no array of numbers, or has another shape.
    """
    try:
        values: Floats = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {given!r:.60}, {expected}") from None
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}, {expected}")
    return values


def corrected_controller(kind: str) -> str | None:
    """Return the controller whose targets an action corrects, or None if an action is itself a target.

    Raises:
        ConfigError: There is no such kind of action.
    """
    if isinstance(kind, str) and kind.startswith(RESIDUAL) and kind != RESIDUAL:
        return kind.removeprefix(RESIDUAL)
    if kind not in KINDS:
        hint = suggest_word(str(kind), KINDS)
        raise ConfigError(
            f"action={kind!r:.60}: {hint}give 'position', 'velocity', 'torque', or 'residual:' and a controller, such "
            "as 'residual:obstacle_aided'",
            code="python/invalid-argument",
        )
    return None
