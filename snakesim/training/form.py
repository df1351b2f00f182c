"""The form of a trained policy: a wave from head to tail, bent towards the goal, that yields to what the joints feel.

    target = ramp (amplitude + x @ yielding) sin(omega t - lag) + x @ steering + tanh(x @ feeling) MAX_REACTION_RAD

x is the observation. Every joint has the same gains on its own and its neighbors' numbers, so that a policy has few
parameters whatever the length of the robot. The same arrays compute it in NumPy and as ONNX.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OBSERVE = ("time_s", "goal_bearing", "angle_rad", "velocity_rad_s", "torque_nm", "contact_n")
MAX_REACTION_RAD = 0.4  # largest reaction of a joint to what the joints measure
RAMP_PER_S = 1.0  # the wave grows to its full amplitude in 1 s
INPUT_SCALES = {"angle_rad": 0.5, "velocity_rad_s": 2.0, "torque_nm": 5.0, "contact_n": 50.0}
"""Values of an observation that count as 1 for a gain."""
REACTION_PARTS = ("angle_rad", "velocity_rad_s", "torque_nm")
# Steps along the joints that bend sideways.
NEIGHBOR_STEPS = {"behind": -1, "itself": 0, "ahead": 1}
Array = NDArray[np.float32]


@dataclass(frozen=True)
class LearnedParameter:
    """One number that is learned: where the search begins, and how far it looks at first."""

    start: float
    sigma: float
    description: str


WAVE = {
    "amplitude": LearnedParameter(0.4, 0.1, "rad, at the head"),
    "growth": LearnedParameter(0.0, 0.1, "rad, of the amplitude at the tail"),
    "omega": LearnedParameter(3.5, 0.7, "rad/s"),
    "lag": LearnedParameter(0.9, 0.1, "rad, of a joint behind the one ahead of it"),
    "steering": LearnedParameter(
        0.06, 0.03, "rad of every joint, times the sine of the goal's bearing"
    ),
    "head_steering": LearnedParameter(0.0, 0.05, "the same, growing towards the head"),
}
FEELING = {
    f"{part}_{where}": LearnedParameter(0.0, 0.15, f"gain of {part} of the joint {where}")
    for part in REACTION_PARTS
    for where in NEIGHBOR_STEPS
} | {
    "contact_behind": LearnedParameter(
        0.0, 0.05, "rad of amplitude for each 50 N on the link behind"
    ),
    "contact_ahead": LearnedParameter(
        0.0, 0.05, "rad of amplitude for each 50 N on the link ahead"
    ),
}
FORMS = {"wave": WAVE, "feeling": WAVE | FEELING}


@dataclass(frozen=True)
class PolicyArrays:
    """The arrays of one policy. Each matrix is (observation, joints); vectors are (joints,)."""

    time: Array
    omega: Array  # rad/s
    lag: Array  # rad
    amplitude: Array  # rad
    yielding: Array
    steering: Array
    feeling: Array

    @staticmethod
    def make_from_parameters(
        values: Mapping[str, float], axes: Sequence[str], sizes: Mapping[str, int]
    ) -> "PolicyArrays":
        """Return the policy for a set of parameters and a robot.

        Args:
            values: Parameters by their names in a form of FORMS. Missing parameters of FEELING are 0.
            axes: Axis of every joint, "yaw" or "pitch", tail to head. Only yaw joints move.
            sizes: Number of values in each part of the observation, by the part's name in OBSERVE.
        """
        joint_count = len(axes)
        parameters = {**dict.fromkeys(FEELING, 0.0), **values}
        is_yaw = np.array([axis == "yaw" for axis in axes], dtype=np.float64)  # 1.0 or 0.0
        # Number of yaw joints between a joint and the head.
        yaw_joints_ahead = np.cumsum(is_yaw[::-1])[::-1] - 1
        # 0 at the head, 1 at the tail.
        tail_fraction = np.clip(yaw_joints_ahead / max(is_yaw.sum() - 1, 1), 0, 1)

        observation_size = 0
        first_row_by_part: dict[str, int] = {}  # of each part of the observation
        for part in OBSERVE:
            first_row_by_part[part] = observation_size
            observation_size += sizes[part]
        time = np.zeros((observation_size, joint_count))
        yielding = np.zeros((observation_size, joint_count))
        steering = np.zeros((observation_size, joint_count))
        feeling = np.zeros((observation_size, joint_count))

        time[first_row_by_part["time_s"]] = 1.0
        # The part has the cosine and the sine of the bearing.
        bearing_sine_row = first_row_by_part["goal_bearing"] + 1
        steering[bearing_sine_row] = parameters["steering"] + parameters["head_steering"] * (
            1 - tail_fraction
        )
        yaw_joints = np.flatnonzero(is_yaw)
        for position, joint in enumerate(yaw_joints):
            for neighbor_name, step in NEIGHBOR_STEPS.items():
                if not 0 <= position + step < len(yaw_joints):
                    continue
                neighbor = yaw_joints[position + step]
                for part in REACTION_PARTS:
                    gain = parameters[f"{part}_{neighbor_name}"]
                    feeling[first_row_by_part[part] + neighbor, joint] = gain / INPUT_SCALES[part]
            # Joint i is between link i behind it and link i + 1 ahead of it.
            contact_row_behind = first_row_by_part["contact_n"] + joint
            yielding[contact_row_behind, joint] = (
                parameters["contact_behind"] / INPUT_SCALES["contact_n"]
            )
            yielding[contact_row_behind + 1, joint] = (
                parameters["contact_ahead"] / INPUT_SCALES["contact_n"]
            )

        omega = np.full(joint_count, parameters["omega"])
        lag = parameters["lag"] * yaw_joints_ahead
        amplitude = is_yaw * (parameters["amplitude"] + parameters["growth"] * tail_fraction)
        return PolicyArrays(
            time=time.astype(np.float32),
            omega=omega.astype(np.float32),
            lag=lag.astype(np.float32),
            amplitude=amplitude.astype(np.float32),
            yielding=yielding.astype(np.float32),
            steering=(steering * is_yaw).astype(np.float32),
            feeling=feeling.astype(np.float32),
        )

    def compute_targets(self, observation: Array) -> Array:
        """Return the target angle of every joint in rad, (joints,), for one observation vector."""
        time = observation @ self.time
        wave = np.sin(time * self.omega - self.lag)
        ramp = np.minimum(time * np.float32(RAMP_PER_S), np.float32(1))
        swing = ramp * (self.amplitude + observation @ self.yielding)
        reaction = np.tanh(observation @ self.feeling) * np.float32(MAX_REACTION_RAD)
        targets = swing * wave + observation @ self.steering + reaction
        return targets.astype(np.float32)
