"""A Gymnasium wrapper whose actions correct a wave, in a few smooth shapes of the body."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from snakesim.training.form import PolicyArrays

SHAPE_COUNT = 7  # number of numbers in an action
MAX_CORRECTION_RAD = 0.3  # of one shape


class WaveCorrection(VectorWrapper):
    """Turns actions between -1 and 1 into joint targets: those of the wave, plus the corrections of the shapes."""

    def __init__(self, env: VectorEnv, wave: PolicyArrays) -> None:
        """Wrap environments that observe `form.OBSERVE` and take joint angles.

        Args:
            env: Environments of one robot.
            wave: The wave to correct.
        """
        super().__init__(env)
        self.wave = wave
        self.shapes_rad = make_shapes_rad(env.single_action_space.shape[0])
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (SHAPE_COUNT,), np.float32)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self._observations: NDArray[np.float32] | None = None  # the newest ones, (num_envs, n)

    def reset(self, **arguments: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset the environments as `env.reset` does."""
        self._observations, infos = self.env.reset(**arguments)
        return self._observations, infos

    def step(self, actions: NDArray[np.float32]) -> tuple[Any, ...]:
        """Correct the wave at the time of each environment, and step."""
        targets_rad = self.wave.compute_targets(self._observations) + actions @ self.shapes_rad
        self._observations, *results = self.env.step(targets_rad)
        return self._observations, *results


def make_shapes_rad(joint_count: int) -> NDArray[np.float32]:
    """Return the joint angles of each shape, (SHAPE_COUNT, joints): cosines with 0, 1, 2, ... half waves."""
    # Of each joint on the body, from 0 at the tail to 1 at the head.
    position = (np.arange(joint_count) + 0.5) / joint_count
    half_waves = np.arange(SHAPE_COUNT)
    shapes = np.cos(np.pi * half_waves[:, None] * position)
    return (MAX_CORRECTION_RAD * shapes).astype(np.float32)
