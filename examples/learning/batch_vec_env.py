"""An adapter by which Stable-Baselines3 trains on a Gymnasium vector environment that steps all rows in one process."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv


class BatchVecEnv(VecEnv):
    """A Gymnasium vector environment with the interface of Stable-Baselines3.

    When an episode ends, Stable-Baselines3 expects the first observation of the next episode as the result of the same
    step, and the last observation of the old one in the info. This is what the autoreset mode "SameStep" provides.
    """

    def __init__(self, env: VectorEnv) -> None:
        """Adapt environments.

        Args:
            env: Environments with the autoreset mode "SameStep".

        Raises:
            ValueError: The environments have another autoreset mode.
        """
        mode = AutoresetMode(env.metadata["autoreset_mode"])
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"the autoreset mode is {mode.value!r}, must be 'SameStep'")
        self.env = env
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin an episode in every environment, with the seeds of the last call of `seed`, or with new ones."""
        observations, _ = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step every environment, and return observations, rewards, ends of episodes, and an info for each of them."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        is_over = terminated | truncated
        info_by_row: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(is_over):
            info_by_row[row] = {
                "terminal_observation": infos["final_obs"][row],
                # The value of the last observation counts only if the time was over, not if the robot was stopped.
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return observations, rewards.astype(np.float32), is_over, info_by_row

    def close(self) -> None:
        """Release the environments."""
        self.env.close()

    # --- methods that Stable-Baselines3 requires ---------------------------------------------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each selected row."""
        return [getattr(self.env, attr_name, None)] * len(self._list_rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, which all rows share."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Refuse to call a method of one environment, since the rows are no objects."""
        raise NotImplementedError(f"{method_name}: the environments are rows of arrays")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each selected row: no environment has a wrapper of its own."""
        return [False] * len(self._list_rows(indices))

    def _list_rows(self, indices: int | Sequence[int] | None) -> list[int]:
        return list(self._get_indices(indices))
