"""Winding temperatures of joint modules, and their supply currents. For the simulator and emulated modules.

The model is of first order: copper losses are proportional to torque squared, and the housing dissipates them.

    time constant * d(temperature)/dt = ambient + rise * (torque / rated)^2 - temperature

The robot file's `[heat]` has the numbers. The defaults are typical of a small geared servo: rated torque is available
at stall for seconds, and half of it continuously (80 °C at 20 °C ambient, so 240 K at rated torque). The time constant
is a minute.

`HeatLimits` is the only derating curve: the host uses it, and so do the simulator's motors and emulated modules. Each
of them computes an upper bound of the torque, so the lower bound applies; the bounds never multiply.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint

MIN_TORQUE_FRACTION = 0.2  # fraction of its torque that the hottest winding may still use
INJECTED_ABOVE_STOP_K = 5.0  # how far above its `stop_at_c` an injected fault heats a winding


@dataclass(frozen=True)
class HeatLimits:
    """Winding temperatures at which derating begins, and at which the robot stops; from the robot file."""

    derate_from_c: float
    stop_at_c: float

    def compute_remaining_fraction(self, winding_temperature_c: float) -> float:
        """Return the fraction of the full torque that a motor may use at a winding temperature.

        It is 1 up to `derate_from_c`, `MIN_TORQUE_FRACTION` from `stop_at_c` on, and falls linearly in between.
        """
        derating_progress = (winding_temperature_c - self.derate_from_c) / (
            self.stop_at_c - self.derate_from_c
        )
        return 1.0 - (1.0 - MIN_TORQUE_FRACTION) * min(max(derating_progress, 0.0), 1.0)


class ThermalModel:
    """Winding temperatures of all motors, and the power that they draw."""

    def __init__(self, joints: Sequence[Joint]) -> None:
        """Start with every winding at the ambient temperature."""
        # Limits of each winding, (n_joints,).
        self.limits = [
            HeatLimits(joint.limits.derate_from_c, joint.limits.stop_at_c) for joint in joints
        ]
        self.stop_at_c: Floats = np.array([limits.stop_at_c for limits in self.limits])
        self._derate_from_c = np.array([limits.derate_from_c for limits in self.limits])

        # Parameters, (n_joints,).
        self._ambient_c = np.array([joint.heat.ambient_c for joint in joints])
        self._rated_torque_nm = np.array([joint.rated_nm for joint in joints])
        self._rise_per_torque_squared = np.array(
            [joint.heat.rise_at_rated_k / joint.rated_nm**2 for joint in joints]
        )  # K/(N·m)²
        self._negative_time_constant_s = np.array([-joint.heat.time_constant_s for joint in joints])
        self._loss_at_rated_w = np.array([joint.heat.loss_at_rated_w for joint in joints])
        self._board_fraction = np.array([joint.heat.board_fraction for joint in joints])

        # Fraction of its distance to the final temperature by which a winding changes in a time step. It is cached,
        # because all time steps are equal.
        self._cached_duration_s = 0.0
        self._cached_settling_fraction: Floats = np.zeros(len(joints))

        # State.
        self.winding_temperature_c: Floats = self._ambient_c.copy()
        self._is_kept_hot = np.zeros(len(joints), dtype=np.bool_)  # by an injected fault
        self._is_any_kept_hot = False
        self._is_any_derated = False  # when `compute_remaining_fractions` was last called

    def advance_temperatures(self, duration_s: float, torque_squared: Floats) -> None:
        """Update the winding temperatures after a time under load. The result is exact for a constant torque.

        A temperature changes by (final temperature - temperature) * (1 - exp(-duration / time constant)).

        Args:
            duration_s: Time that has elapsed since the last call.
            torque_squared: Mean square of each torque in this time, N²·m², (n_joints,).
        """
        if duration_s != self._cached_duration_s:
            self._cached_duration_s = duration_s
            self._cached_settling_fraction = -np.expm1(duration_s / self._negative_time_constant_s)
        final_temperature_c = self._ambient_c + self._rise_per_torque_squared * torque_squared
        self.winding_temperature_c += (
            final_temperature_c - self.winding_temperature_c
        ) * self._cached_settling_fraction
        if self._is_any_kept_hot:
            np.copyto(
                self.winding_temperature_c,
                self.stop_at_c + INJECTED_ABOVE_STOP_K,
                where=self._is_kept_hot,
            )

    def inject_heat(self, motor_index: int, *, heat: bool, hold: bool) -> None:
        """Inject an overheating fault into one winding, or remove it.

        Args:
            motor_index: Index of the joint, from 0 at the tail.
            heat: If True, the winding is heated above its `stop_at_c` now.
            hold: If True, it keeps that temperature until a call with False. If False, it cools down.
        """
        if heat:
            self.winding_temperature_c[motor_index] = (
                self.stop_at_c[motor_index] + INJECTED_ABOVE_STOP_K
            )
        self._is_kept_hot[motor_index] = hold
        self._is_any_kept_hot = bool(self._is_kept_hot.any())

    def compute_remaining_fractions(self) -> Floats | None:
        """Return the fraction of its torque that each motor may use, (n_joints,), if it may have changed.

        Returns:
            None while all windings are cool. When the last one has cooled down, one more array, which is all 1.
        """
        was_derated = self._is_any_derated
        self._is_any_derated = bool((self.winding_temperature_c > self._derate_from_c).any())
        if not (self._is_any_derated or was_derated):
            return None
        fractions = [
            limits.compute_remaining_fraction(winding_c)
            for limits, winding_c in zip(
                self.limits, self.winding_temperature_c.tolist(), strict=True
            )
        ]
        return np.array(fractions)

    def compute_board_temperatures_c(self) -> Floats:
        """Return the temperatures of the electronics beside the windings, (n_joints,)."""
        return self._ambient_c + self._board_fraction * (
            self.winding_temperature_c - self._ambient_c
        )

    def compute_power_w(self, torque_nm: Floats, speed_rad_s: Floats) -> Floats:
        """Return the power that each motor draws, (n_joints,): mechanical power and copper losses.

        The current that a module draws at rest, `JointSupply.idle_a`, is not included.
        """
        mechanical_w = torque_nm * speed_rad_s
        copper_loss_w = self._loss_at_rated_w * (torque_nm / self._rated_torque_nm) ** 2
        return mechanical_w + copper_loss_w
