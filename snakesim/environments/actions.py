"""What an environment lets its agent command: a target for every joint, with unit and bounds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError, did_you_mean
from snakesim_hal.wire.messages import Description, Mode

RESIDUAL = "residual:"
KINDS = {"position": (Mode.POSITION, "rad"), "velocity": (Mode.VELOCITY, "rad/s"), "torque": (Mode.TORQUE, "N·m")}


@dataclass(frozen=True)
class Commands:
    """The actions of an environment, joint by joint, tail to head."""

    kind: str
    mode: Mode
    unit: str
    names: Sequence[str]
    low: Sequence[float]
    high: Sequence[float]

    @staticmethod
    def of(robot: Description, kind: str, residual_rad: float) -> "Commands":
        """kind: as `controller_of` accepts it."""
        joints, names = robot.joints, [joint.name for joint in robot.joints]
        if kind.startswith(RESIDUAL):
            count = len(joints)
            return Commands(kind, Mode.POSITION, "rad", names, [-residual_rad] * count, [residual_rad] * count)
        mode, unit = KINDS[kind]
        if mode is Mode.POSITION:
            low, high = [joint.angle_min_rad for joint in joints], [joint.angle_max_rad for joint in joints]
            return Commands(kind, mode, unit, names, low, high)
        most = [joint.speed_limit_rad_s if mode is Mode.VELOCITY else joint.torque_limit_nm for joint in joints]
        return Commands(kind, mode, unit, names, [-value for value in most], most)

    def target(self, action: Any) -> list[float]:
        """An action as targets. Raises ValueError for another shape, and for what is no finite number."""
        try:
            values: NDArray[np.float64] = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"action is {action!r:.60}, must be {self._wanted()}") from None
        if values.shape != (len(self.names),):
            raise ValueError(f"action has shape {values.shape}, must be {self._wanted()}")
        if not np.isfinite(values).all():
            bad = int(np.argmin(np.isfinite(values)))
            raise ValueError(
                f"action[{bad}] ({self.names[bad]}) is {values[bad]}, must be a finite number of {self.unit}"
            )
        return values.tolist()

    def _wanted(self) -> str:
        count = len(self.names)
        what = "a correction" if self.kind.startswith(RESIDUAL) else f"a {self.kind}"
        return f"({count},): {what} in {self.unit} for each joint, {self.names[0]} to {self.names[-1]}"


def controller_of(kind: str) -> str | None:
    """The controller whose targets an action corrects; None: it is a target itself. Raises ConfigError."""
    if isinstance(kind, str) and kind.startswith(RESIDUAL) and kind != RESIDUAL:
        return kind.removeprefix(RESIDUAL)
    if kind not in KINDS:
        hint = did_you_mean(str(kind), KINDS)
        raise ConfigError(
            f"action={kind!r:.60}: {hint}give 'position', 'velocity', 'torque', or 'residual:' and a controller, such "
            "as 'residual:obstacle_aided'"
        )
    return None
