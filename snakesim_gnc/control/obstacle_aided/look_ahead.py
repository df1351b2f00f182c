"""A PI law of the speed error: how far along its path the shape of the body is commanded ahead of the body."""

from snakesim_gnc.control.obstacle_aided.parameters import ObstacleAidedParameters
from snakesim_gnc.control.progress import BodyLocation


class LookAhead:
    """Computes the look-ahead l = speed_kp e + integral_per_s integral e dt, with the speed error e.

    The integral and the sum are bounded by `max_look_ahead_m`, which limits how hard the shape pushes.
    """

    def __init__(self, parameters: ObstacleAidedParameters) -> None:
        """Start with a look-ahead of zero.

        Args:
            parameters: Gains and limits of the look-ahead.
        """
        self._parameters = parameters
        self._integral_m = 0.0

    def update(self, location: BodyLocation, period_s: float) -> float:
        """Add the speed error of this tick to the integral, and return the look-ahead in m.

        Args:
            location: Speed of the body along the path, and the desired speed.
            period_s: Time since the last update.
        """
        max_m = self._parameters.max_look_ahead_m
        error_m_s = location.trajectory.speed_m_s - location.speed_m_s
        self._integral_m += self._parameters.integral_per_s * error_m_s * period_s
        self._integral_m = min(max(self._integral_m, -max_m), max_m)
        return min(max(self._integral_m + self._parameters.speed_kp_s * error_m_s, -max_m), max_m)

    def limit_for_new_path(self) -> None:
        """Reduce the integral to `fresh_look_ahead_m`, because the shape will jump to another reference."""
        self._integral_m = min(self._integral_m, self._parameters.fresh_look_ahead_m)

    def reset(self) -> None:
        """Set the integral to zero."""
        self._integral_m = 0.0
