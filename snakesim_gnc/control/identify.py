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

from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import bounded

MARGIN_RAD = 0.02  # between a target and the joint's limit
SPEED_RATIO = 0.8  # of a target's maximum speed to the joint's limit, so that the drive never limits the motion itself
TONES_PER_JOINT = 4  # one in each quarter of the band
BAND_RATIO = 10  # of the highest to the lowest frequency
SEED = 25  # of the phases, so that every run moves alike


@dataclass(frozen=True)
class Tone:
    """One of the sine waves that a joint shakes with."""

    frequency_hz: float
    amplitude: float  # as a fraction of the joint's whole shaking
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
    """Frequency of the highest tone; that of the lowest is a tenth of it."""

    shake_after_s: Annotated[float, bounded(0.0, 600.0, "s")] = 6.0
    """Time with the slow motion alone, before the shaking."""

    fade_s: Annotated[float, bounded(0.1, 10.0, "s")] = 0.5
    """Time until each motion reaches its full size."""


class Identify(Controller[IdentifyParameters]):
    """Sends position targets: for each joint a slow triangle wave and four tones, which fade in.

    With the triangle wave w of period T_i, and with the tones' frequencies f_ik, amplitudes a_ik and phases p_ik, the
    target of joint i at time t is its start angle plus

        sign_i swing w(t / T_i) + shake sum_k a_ik sin(2 pi f_ik (t - t_shake) + p_ik)

    Targets stay within the joint's limits of angle and speed.
    """

    Parameters = IdentifyParameters
    needs_world = False
    required_measurements = ("torque",)

    def __init__(self, robot: Description, parameters: IdentifyParameters) -> None:
        super().__init__(robot, parameters)
        self._tones = make_tones(len(robot.joints), parameters.shake_to_hz)
        self._start_rad: list[float] = []  # empty: there has been no observation yet
        self._last_rad: list[float] = []  # targets of the tick before

    def update(self, observation: Observation) -> ControllerCommand:
        """Return position targets that swing and shake every joint about its start angle, within its limits.

        System identification uses the response of the joints. Amplitudes fade in, and the speed is limited.

        Args:
            observation: the inputs of this tick; the first one sets the start angles.

        Returns:
            Position setpoints of all joints, with a telemetry that names the present motion.
        """
        if not self._start_rad:
            self._start_rad = list(observation.joints.angle_rad)
        swing_rad = self.parameters.swing_rad * self._fade_in(observation.time_s)
        shaking_s = observation.time_s - self.parameters.shake_after_s
        shake_rad = self.parameters.shake_rad * self._fade_in(shaking_s)
        targets_rad: list[float] = []
        for i, joint in enumerate(self.robot.joints):
            offset_rad = self._swing(i, observation.time_s, swing_rad) + self._shake(i, shaking_s, shake_rad)
            min_rad = joint.angle_min_rad + MARGIN_RAD
            max_rad = joint.angle_max_rad - MARGIN_RAD
            targets_rad.append(min(max(self._start_rad[i] + offset_rad, min_rad), max_rad))
        if self._last_rad:
            targets_rad = self._limit_speed(targets_rad, observation.period_s)
        self._last_rad = targets_rad
        phase = "shaking every joint" if shake_rad else "slowly back and forth, every joint"
        return ControllerCommand(positions(self.robot, targets_rad), Telemetry(reason=phase, reference_rad=targets_rad))

    def _fade_in(self, time_s: float) -> float:
        """Return the fraction of the full size at a time after the beginning of a motion, 0 to 1."""
        return min(max(time_s / self.parameters.fade_s, 0.0), 1.0)

    def _swing(self, i: int, time_s: float, swing_rad: float) -> float:
        """Return the slow motion of a joint. The period grows towards the head, to one and a half times the first."""
        period_s = self.parameters.swing_s * (1 + i / (2 * len(self.robot.joints)))
        sign = (-1) ** (i // 2 + i)
        return sign * swing_rad * triangle_wave(time_s / period_s)

    def _shake(self, i: int, shaking_s: float, shake_rad: float) -> float:
        """Return the shaking of a joint."""
        total = sum(
            tone.amplitude * math.sin(math.tau * tone.frequency_hz * shaking_s + tone.phase_rad)
            for tone in self._tones[i]
        )
        return shake_rad * total

    def _limit_speed(self, targets_rad: list[float], period_s: float) -> list[float]:
        """Return targets that no joint has to move too fast for."""
        limited_rad: list[float] = []
        for joint, target_rad, last_rad in zip(self.robot.joints, targets_rad, self._last_rad, strict=True):
            max_step_rad = SPEED_RATIO * joint.speed_limit_rad_s * period_s
            limited_rad.append(min(max(target_rad, last_rad - max_step_rad), last_rad + max_step_rad))
        return limited_rad


def triangle_wave(cycles: float) -> float:
    """Return a triangle wave after a number of cycles: from 0 up to 1, down to -1, and back to 0 in one cycle."""
    return 4 * abs((cycles - 0.25) % 1.0 - 0.5) - 1.0


def make_tones(joint_count: int, max_hz: float) -> list[list[Tone]]:
    """Make the tones of each joint.

    The frequencies are in geometric progression from max_hz / BAND_RATIO to max_hz, and no two joints have one in
    common. Amplitudes are proportional to 1 / sqrt(frequency), and those of a joint sum to 1.

    Args:
        joint_count: number of joints.
        max_hz: highest frequency.

    Returns:
        TONES_PER_JOINT tones of each joint, tail to head.
    """
    rng = random.Random(SEED)
    min_hz = max_hz / BAND_RATIO
    count = TONES_PER_JOINT * joint_count
    frequencies_hz = [min_hz * (max_hz / min_hz) ** (k / max(count - 1, 1)) for k in range(count)]
    tones: list[list[Tone]] = []
    for i in range(joint_count):
        joint_hz = [frequencies_hz[i + joint_count * k] for k in range(TONES_PER_JOINT)]
        total = sum(hz**-0.5 for hz in joint_hz)
        tones.append([Tone(hz, hz**-0.5 / total, rng.uniform(0, math.tau)) for hz in joint_hz])
    return tones
