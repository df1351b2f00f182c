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
FELT_RAD, RAMP_PER_S = 0.4, 1.0
UNITS = {"angle_rad": 0.5, "velocity_rad_s": 2.0, "torque_nm": 5.0, "contact_n": 50.0}  # that are 1 for a gain
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
    for part in ("angle_rad", "velocity_rad_s", "torque_nm")
    for where in ("behind", "itself", "ahead")
} | {
    "contact_behind": Parameter(0.0, 0.05, "rad of amplitude for each 50 N on the link behind"),
    "contact_ahead": Parameter(0.0, 0.05, "rad of amplitude for each 50 N on the link ahead"),
}
FORMS = {"wave": WAVE, "feeling": WAVE | FEELING}


@dataclass(frozen=True)
class Policy:
    """The arrays of one policy. Each matrix is (observation, joints); vectors are (joints,)."""

    time: Array
    omega: Array
    lag: Array
    amplitude: Array
    yielding: Array
    steering: Array
    feeling: Array

    @staticmethod
    def of(values: Mapping[str, float], axes: Sequence[str], sizes: Mapping[str, int]) -> "Policy":
        """values: by the names of a form. axes: of every joint, tail to head. sizes: of the parts in OBSERVE."""
        count, get = len(axes), {**dict.fromkeys(FEELING, 0.0), **values}
        bends = np.array([axis == "yaw" for axis in axes], dtype=np.float64)
        behind = np.cumsum(bends[::-1])[::-1] - 1  # how many bends there are between a joint and the head
        share = np.clip(behind / max(bends.sum() - 1, 1), 0, 1)
        first = dict(zip(OBSERVE, np.cumsum([0, *(sizes[part] for part in OBSERVE)]).tolist(), strict=False))
        empty = np.zeros((sum(sizes[part] for part in OBSERVE), count))
        time, yielding, steering, feeling = (empty.copy() for _ in range(4))
        time[first["time_s"]] = 1.0
        steering[first["goal_bearing"] + 1] = get["steering"] + get["head_steering"] * (1 - share)
        neighbors = np.flatnonzero(bends)
        for place, joint in enumerate(neighbors):
            for where, step in (("behind", -1), ("itself", 0), ("ahead", 1)):
                if 0 <= place + step < len(neighbors):
                    for part in ("angle_rad", "velocity_rad_s", "torque_nm"):
                        row = first[part] + neighbors[place + step]
                        feeling[row, joint] = get[f"{part}_{where}"] / UNITS[part]
            yielding[first["contact_n"] + joint, joint] = get["contact_behind"] / UNITS["contact_n"]
            yielding[first["contact_n"] + joint + 1, joint] = get["contact_ahead"] / UNITS["contact_n"]
        found = (
            time,
            np.full(count, get["omega"]),
            get["lag"] * behind,
            bends * (get["amplitude"] + get["growth"] * share),
            yielding,
            steering * bends,
            feeling,
        )
        return Policy(*(array.astype(np.float32) for array in found))

    def targets(self, seen: Array) -> Array:
        """rad, for every joint."""
        time = seen @ self.time
        wave = np.sin(time * self.omega - self.lag)
        swing = np.minimum(time * np.float32(RAMP_PER_S), np.float32(1)) * (self.amplitude + seen @ self.yielding)
        targets = swing * wave + seen @ self.steering + np.tanh(seen @ self.feeling) * np.float32(FELT_RAD)
        return targets.astype(np.float32)
