"""Moves all joints at once, so that a recording shows friction, rotor inertia, torque constant and response of each.

The robot hangs by its tail, head down: on the ground, friction under the body would count as friction of the joints.
Each joint moves slowly back and forth, which shows dry friction, and on top of that shakes at frequencies that no other
joint has. Neighbors start in opposite directions, so that the body stays near the vertical. `snakesim robot identify`
evaluates the recording.
"""

import math
import random
from dataclasses import dataclass
from typing import Annotated

from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import bounded

JOINT_LIMIT_MARGIN_RAD = 0.02  # between a target and the joint's limit
# Of a target's maximum speed to the joint's limit, so that the drive never limits the motion itself.
MAX_SPEED_RATIO = 0.8
TONES_PER_JOINT = 4  # one in each quarter of the band
MAX_TO_MIN_FREQUENCY_RATIO = 10  # of the highest to the lowest frequency
PHASE_SEED = 25  # of the phases, so that every run moves alike


@dataclass(frozen=True)
class SineTone:
    """One of the sine waves whose sum is the fast motion of a joint."""

    frequency_hz: float
    amplitude: float  # fraction of the sum of all amplitudes of the joint
    phase_rad: float


class IdentifyParameters(FileStruct, frozen=True):
    """How far and how fast."""

    swing_rad: Annotated[float, bounded(0.01, 0.5, "rad")] = 0.25
    """Amplitude of the slow motion."""

    swing_s: Annotated[float, bounded(0.5, 60.0, "s")] = 2.0
    """Period of the fastest slow motion, there and back."""

    shake_rad: Annotated[float, bounded(0.0, 0.3, "rad")] = 0.05
    """Maximum of the sum of all tones."""

    shake_to_hz: Annotated[float, bounded(0.5, 50.0, "Hz")] = 6.0
    """Frequency of the highest tone. That of the lowest is a tenth of it."""

    shake_after_s: Annotated[float, bounded(0.0, 600.0, "s")] = 6.0
    """Time with the slow motion alone, before the shaking."""

    fade_s: Annotated[float, bounded(0.1, 10.0, "s")] = 0.5
    """Time until each motion reaches its full size."""


class Identification(Controller[IdentifyParameters]):
    """Sends position targets: for each joint a slow triangle wave and four tones, which fade in.

    With the triangle wave w of period T_i, and with the tones' frequencies f_ik, amplitudes a_ik and phases p_ik, the
    target of joint i at time t is its start angle plus

        sign_i swing w(t / T_i) + shake sum_k a_ik sin(2 pi f_ik (t - t_shake) + p_ik)

    Targets stay within the joint's limits of angle and speed.
    """

    Parameters = IdentifyParameters
    needs_world = False
    required_measurements = ("torque",)

    def __init__(self, robot: RobotDescription, parameters: IdentifyParameters) -> None:
        super().__init__(robot, parameters)
        self._tones = make_multisine_tones(len(robot.joints), parameters.shake_to_hz)
        self._start_angles_rad: list[float] = []  # empty if there has been no observation yet
        self._last_targets_rad: list[float] = []  # targets of the tick before

    def update(self, observation: Observation) -> ControllerCommand:
        """Return position targets that excite every joint about its start angle, for system identification.

        The excitation of a joint is a slow triangle wave, to which a multisine (a sum of sine tones) is added after
        `shake_after_s`. Amplitudes fade in. Targets are kept within the joint's limits of angle and speed.

        Args:
            observation: The inputs of this tick; the first one sets the start angles.

        Returns:
            Position setpoints of all joints, with telemetry that names the current phase.
        """
        if not self._start_angles_rad:
            self._start_angles_rad = list(observation.joints.angle_rad)
        triangle_amplitude_rad = self.parameters.swing_rad * self._compute_fade_in_fraction(
            observation.time_s
        )
        multisine_time_s = observation.time_s - self.parameters.shake_after_s
        multisine_amplitude_rad = self.parameters.shake_rad * self._compute_fade_in_fraction(
            multisine_time_s
        )
        targets_rad: list[float] = []
        for i, joint in enumerate(self.robot.joints):
            triangle_rad = self._compute_triangle_offset_rad(
                i, observation.time_s, triangle_amplitude_rad
            )
            multisine_rad = self._compute_multisine_offset_rad(
                i, multisine_time_s, multisine_amplitude_rad
            )
            offset_rad = triangle_rad + multisine_rad
            min_rad = joint.angle_min_rad + JOINT_LIMIT_MARGIN_RAD
            max_rad = joint.angle_max_rad - JOINT_LIMIT_MARGIN_RAD
            targets_rad.append(min(max(self._start_angles_rad[i] + offset_rad, min_rad), max_rad))
        if self._last_targets_rad:
            targets_rad = self._limit_target_speed(targets_rad, observation.period_s)
        self._last_targets_rad = targets_rad
        phase = (
            "shaking every joint"
            if multisine_amplitude_rad
            else "slowly back and forth, every joint"
        )
        return ControllerCommand(
            make_position_setpoints(self.robot, targets_rad),
            Telemetry(reason=phase, reference_rad=targets_rad),
        )

    def _compute_fade_in_fraction(self, time_s: float) -> float:
        """Return the fraction of the full amplitude, 0 to 1, at a time after the start of a motion."""
        return min(max(time_s / self.parameters.fade_s, 0.0), 1.0)

    def _compute_triangle_offset_rad(
        self, joint_index: int, time_s: float, amplitude_rad: float
    ) -> float:
        """Return the offset of the slow triangle wave from the start angle of a joint, in rad.

        The period grows towards the head, from `swing_s` to nearly one and a half times as much. The start directions
        repeat as +, -, -, + from the tail, so that the body stays near the vertical.
        """
        period_s = self.parameters.swing_s * (1 + joint_index / (2 * len(self.robot.joints)))
        sign = (-1) ** (joint_index // 2 + joint_index)
        return sign * amplitude_rad * compute_triangle_wave(time_s / period_s)

    def _compute_multisine_offset_rad(
        self, joint_index: int, multisine_time_s: float, amplitude_rad: float
    ) -> float:
        """Return the offset of the multisine from the start angle of a joint, in rad."""
        unit_sum = sum(
            tone.amplitude
            * math.sin(math.tau * tone.frequency_hz * multisine_time_s + tone.phase_rad)
            for tone in self._tones[joint_index]
        )
        return amplitude_rad * unit_sum

    def _limit_target_speed(self, targets_rad: list[float], period_s: float) -> list[float]:
        """Return the targets, bounded so that each joint moves at most at MAX_SPEED_RATIO times its speed limit."""
        limited_rad: list[float] = []
        for joint, target_rad, last_rad in zip(
            self.robot.joints, targets_rad, self._last_targets_rad, strict=True
        ):
            max_step_rad = MAX_SPEED_RATIO * joint.speed_limit_rad_s * period_s
            limited_rad.append(
                min(max(target_rad, last_rad - max_step_rad), last_rad + max_step_rad)
            )
        return limited_rad


def compute_triangle_wave(cycles: float) -> float:
    """Return a triangle wave after a number of cycles: from 0 up to 1, down to -1, and back to 0 in one cycle."""
    return 4 * abs((cycles - 0.25) % 1.0 - 0.5) - 1.0


def make_multisine_tones(joint_count: int, max_frequency_hz: float) -> list[list[SineTone]]:
    """Make the sine tones whose sum (a multisine) excites each joint in system identification.

    The frequencies are in geometric progression from max_frequency_hz / MAX_TO_MIN_FREQUENCY_RATIO to max_frequency_hz,
    and no two joints have one in common. Amplitudes are proportional to 1 / sqrt(frequency), and those of a joint sum
    to 1.

    Args:
        joint_count: Number of joints.
        max_frequency_hz: Highest frequency of any tone.

    Returns:
        TONES_PER_JOINT tones of each joint, tail to head.
    """
    rng = random.Random(PHASE_SEED)
    min_frequency_hz = max_frequency_hz / MAX_TO_MIN_FREQUENCY_RATIO
    tone_count = TONES_PER_JOINT * joint_count
    frequencies_hz = [
        min_frequency_hz * (max_frequency_hz / min_frequency_hz) ** (k / max(tone_count - 1, 1))
        for k in range(tone_count)
    ]
    tones: list[list[SineTone]] = []
    for i in range(joint_count):
        joint_frequencies_hz = [frequencies_hz[i + joint_count * k] for k in range(TONES_PER_JOINT)]
        total_weight = sum(frequency_hz**-0.5 for frequency_hz in joint_frequencies_hz)
        tones.append(
            [
                SineTone(frequency_hz, frequency_hz**-0.5 / total_weight, rng.uniform(0, math.tau))
                for frequency_hz in joint_frequencies_hz
            ]
        )
    return tones
