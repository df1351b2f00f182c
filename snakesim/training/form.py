"""The form of a trained policy: a wave from head to tail, bent towards the goal, that yields to what the joints feel.

    target = ramp (amplitude + x @ yielding) sin(omega t - lag) + x @ steering + tanh(x @ feeling) FELT_RAD

x is the observation. Every joint has the same gains on its own and its neighbors' numbers, so that a policy has few
parameters whatever the length of the robot. The same arrays compute it in NumPy and as ONNX.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OBSERVE = ("time_s", "goal_bearing", "angle_rad", "velocity_rad_s", "torque_nm", "contact_n")
FELT_RAD = 0.4  # largest reaction of a joint to what the joints measure
RAMP_PER_S = 1.0  # the wave grows to its full amplitude in 1 s
UNITS = {"angle_rad": 0.5, "velocity_rad_s": 2.0, "torque_nm": 5.0, "contact_n": 50.0}
"""Values of an observation that count as 1 for a gain."""
FELT_PARTS = ("angle_rad", "velocity_rad_s", "torque_nm")
NEIGHBORS = {"behind": -1, "itself": 0, "ahead": 1}  # steps along the joints that bend sideways
Array = NDArray[np.float32]


@dataclass(frozen=True)
class Parameter:
    """One number that is learned: where the search begins, and how far it looks at first."""

    start: float
    sigma: float
    about: str


WAVE = {
    "amplitude": Parameter(0.4, 0.1, "rad, at the head"),
    "growth": Parameter(0.0, 0.1, "rad, of the amplitude at the tail"),
    "omega": Parameter(3.5, 0.7, "rad/s"),
    "lag": Parameter(0.9, 0.1, "rad, of a joint behind the one ahead of it"),
    "steering": Parameter(0.06, 0.03, "rad of every joint, times the sine of the goal's bearing"),
    "head_steering": Parameter(0.0, 0.05, "the same, growing towards the head"),
}
FEELING = {
    f"{part}_{where}": Parameter(0.0, 0.15, f"gain of {part} of the joint {where}")
    for part in FELT_PARTS
    for where in NEIGHBORS
} | {
    "contact_behind": Parameter(0.0, 0.05, "rad of amplitude for each 50 N on the link behind"),
    "contact_ahead": Parameter(0.0, 0.05, "rad of amplitude for each 50 N on the link ahead"),
}
FORMS = {"wave": WAVE, "feeling": WAVE | FEELING}


@dataclass(frozen=True)
class Policy:
    """The arrays of one policy. Each matrix is (observation, joints); vectors are (joints,)."""

    time: Array
    omega: Array  # rad/s
    lag: Array  # rad
    amplitude: Array  # rad
    yielding: Array
    steering: Array
    feeling: Array

    @staticmethod
    def of(values: Mapping[str, float], axes: Sequence[str], sizes: Mapping[str, int]) -> "Policy":
        """Return the policy of given parameters.

        Args:
            values: Parameters by the names of a form; those of FEELING that are missing are 0.
            axes: "yaw" or "pitch" of every joint, tail to head. Only yaw joints move.
            sizes: Width of each part of the observation in OBSERVE.
        """
        count = len(axes)
        parameters = {**dict.fromkeys(FEELING, 0.0), **values}
        bends = np.array([axis == "yaw" for axis in axes], dtype=np.float64)
        bends_ahead = np.cumsum(bends[::-1])[::-1] - 1  # between a joint and the head
        fraction = np.clip(bends_ahead / max(bends.sum() - 1, 1), 0, 1)  # 0 at the head, 1 at the tail

        width = 0
        first_row: dict[str, int] = {}  # of each part of the observation
        for part in OBSERVE:
            first_row[part] = width
            width += sizes[part]
        time = np.zeros((width, count))
        yielding = np.zeros((width, count))
        steering = np.zeros((width, count))
        feeling = np.zeros((width, count))

        time[first_row["time_s"]] = 1.0
        sine_of_bearing = first_row["goal_bearing"] + 1
        steering[sine_of_bearing] = parameters["steering"] + parameters["head_steering"] * (1 - fraction)
        bending_joints = np.flatnonzero(bends)
        for place, joint in enumerate(bending_joints):
            for where, step in NEIGHBORS.items():
                if not 0 <= place + step < len(bending_joints):
                    continue
                neighbor = bending_joints[place + step]
                for part in FELT_PARTS:
                    feeling[first_row[part] + neighbor, joint] = parameters[f"{part}_{where}"] / UNITS[part]
            link_behind = first_row["contact_n"] + joint
            yielding[link_behind, joint] = parameters["contact_behind"] / UNITS["contact_n"]
            yielding[link_behind + 1, joint] = parameters["contact_ahead"] / UNITS["contact_n"]

        omega = np.full(count, parameters["omega"])
        lag = parameters["lag"] * bends_ahead
        amplitude = bends * (parameters["amplitude"] + parameters["growth"] * fraction)
        return Policy(
            time=time.astype(np.float32),
            omega=omega.astype(np.float32),
            lag=lag.astype(np.float32),
            amplitude=amplitude.astype(np.float32),
            yielding=yielding.astype(np.float32),
            steering=(steering * bends).astype(np.float32),
            feeling=feeling.astype(np.float32),
        )

    def targets(self, seen: Array) -> Array:
        """Return the target angle of every joint in rad, (joints,), for an observation, (observation,)."""
        time = seen @ self.time
        wave = np.sin(time * self.omega - self.lag)
        swing = np.minimum(time * np.float32(RAMP_PER_S), np.float32(1)) * (self.amplitude + seen @ self.yielding)
        targets = swing * wave + seen @ self.steering + np.tanh(seen @ self.feeling) * np.float32(FELT_RAD)
        return targets.astype(np.float32)
