"""Steps many environments at once, in one process: every array has a row for each environment."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import error, logger
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.random import Generator
from numpy.typing import NDArray

from snakesim.environments.armed import Mask
from snakesim.environments.environment import SnakeEnv
from snakesim.environments.episodes import BatchStepResult, EpisodeBatch
from snakesim.environments.infos import InfoArrays
from snakesim.environments.setup import RENDER_MODES
from snakesim_hal.base.errors import ConfigError
from snakesim_sim_backend.batch.simulations import describe_loop_cost


class SnakeVectorEnv(VectorEnv[Any, Any, Any]):
    """Many environments of one scenario, each in a scene of its own. Each has the same bits as `SnakeEnv` alone.

    A pickle holds the arguments and no robots, so an environment that is loaded from one needs a `reset`.
    """

    metadata = {"render_modes": RENDER_MODES, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        *,
        thread_count: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        """Load and check the scenario. `reset` makes the robots.

        Args:
            num_envs: Number of environments.
            thread_count: Number of threads that step the physics. None takes one for each processor that this process
                may use. The results do not depend on it.
            autoreset_mode: When an environment whose episode is over is reset: in the next step, in the same step, or
                ("Disabled") only by `reset` with the option `reset_mask`.
            **arguments: Those of `SnakeEnv`.

        Raises:
            ConfigError: An argument is wrong.
        """
        for name, number in (("num_envs", num_envs), ("thread_count", thread_count)):
            is_count = type(number) is int and number >= 1
            if not is_count and (name != "thread_count" or number is not None):
                raise ConfigError(
                    f"{name}={number!r:.60}: give a whole number, 1 or more",
                    code="python/invalid-argument",
                )
        try:
            self._autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            raise ConfigError(
                f"autoreset_mode={autoreset_mode!r:.60}: give one of {', '.join(mode.value for mode in AutoresetMode)}",
                code="python/invalid-argument",
            ) from None
        self._arguments = {
            "num_envs": num_envs,
            "thread_count": thread_count,
            "autoreset_mode": self._autoreset_mode,
            **arguments,
        }
        setup = SnakeEnv(**arguments).setup
        self._setup = setup
        self._episodes = EpisodeBatch(setup, num_envs, thread_count or len(os.sched_getaffinity(0)))
        if setup.config.backend == "sim" and num_envs > 1 and (cost := describe_loop_cost()):
            logger.warn(cost)
        self._rngs: list[Generator] = [np_random(None)[0] for _ in range(num_envs)]
        self._has_unfinished_step = False

        self.num_envs = num_envs
        self.render_mode = setup.render_mode
        self.metadata = {
            "render_modes": RENDER_MODES,
            "autoreset_mode": self._autoreset_mode,
            "render_fps": setup.render_fps,
        }
        self.single_observation_space = setup.observation_space
        self.single_action_space = setup.action_space
        self.observation_space = batch_space(setup.observation_space, num_envs)
        self.action_space = batch_space(setup.action_space, num_envs)

    def __reduce__(self) -> Any:
        return _rebuild_vector, (type(self), self._arguments, self.spec)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all environments, or some of them.

        Args:
            seed: Seed of the first environment, from which the seeds of the next ones count up, or a seed for each
                environment. None keeps the random generators.
            options: Options with the key `reset_mask`, whose value selects the environments to reset, (num_envs,).
                Without this key, all are reset. Other keys are ignored.

        Returns:
            Observations of all environments, stacked, and the merged info dicts of those that were reset.

        Raises:
            gymnasium.error.Error: A seed is not a Python integer of 0 or more, as in Gymnasium.
            ValueError: The number of seeds or the mask is wrong.
            ConfigError: The obstacles of a random field find no place.
        """
        seeds = _expand_seeds(seed, self.num_envs)
        mask = _read_mask(options, self.num_envs)
        self._has_unfinished_step = True
        for environment in np.flatnonzero(mask).tolist():
            self._reset_environment(environment, seeds[environment])
        observations = self._episodes.observe(self._episodes.has_robot)
        self._has_unfinished_step = not self._episodes.has_robot.all()
        return self._setup.split(observations), self._make_reset_infos(mask).read()

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Step every environment.

        Args:
            actions: An action for each environment, (num_envs, joints).

        Returns:
            Stacked observations, then rewards, terminated and truncated, each (num_envs,), and merged info dicts.

        Raises:
            gymnasium.error.ResetNeeded: The step or reset before this one did not finish, by Ctrl-C for example, or
                an episode is over, and the autoreset mode is "Disabled".
            ValueError: The number of rows is wrong, or a row is no action. No environment has taken a step then.
        """
        targets = self._setup.commands.convert_actions(actions, self.num_envs)
        if self._has_unfinished_step:
            raise error.ResetNeeded(
                "the last step or reset did not finish, so some environments may be a step ahead of the others; "
                "call reset()"
            )
        was_episode_over = self._episodes.is_over.copy()
        if self._autoreset_mode is AutoresetMode.DISABLED and was_episode_over.any():
            over = np.flatnonzero(was_episode_over).tolist()
            raise error.ResetNeeded(
                f"the episodes of environments {over} are over; reset them with `reset_mask`"
            )
        self._has_unfinished_step = True
        for environment in np.flatnonzero(was_episode_over).tolist():
            self._reset_environment(environment, None)
        result = self._episodes.step(targets, ~was_episode_over)
        infos = self._make_step_infos(result, ~was_episode_over)
        observations = result.observations
        if was_episode_over.any():
            infos.update(self._make_reset_infos(was_episode_over), was_episode_over)
            observations = self._update_observations(was_episode_over, observations)
        if self._autoreset_mode is AutoresetMode.SAME_STEP and self._episodes.is_over.any():
            observations, infos = self._reset_in_same_step(observations, infos)
        self._has_unfinished_step = False
        return (
            self._setup.split(observations),
            np.where(was_episode_over, 0.0, result.rewards),
            result.terminated,
            result.truncated,
            infos.read(),
        )

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of each environment. None without a `render_mode`.

        Raises:
            gymnasium.error.ResetNeeded: There are no robots before the first `reset`, nor after `close`.
        """
        if self.render_mode is None:
            return None
        if not self._episodes.has_robot.all():
            raise error.ResetNeeded("there is no robot yet; call reset()")
        return tuple(self._episodes.render(environment) for environment in range(self.num_envs))

    def close_extras(self, **_named: Any) -> None:
        """Release all robots."""
        for environment in range(self.num_envs):
            self._episodes.close(environment)
        self._has_unfinished_step = True

    def _reset_environment(self, environment: int, seed: int | None) -> None:
        """Start an episode of one environment."""
        if seed is not None:
            self._rngs[environment] = np_random(seed)[0]
        self._episodes.reset(environment, seed, self._rngs[environment])

    def _update_observations(
        self, environments: Mask, observations: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return observations in which those of some environments are new."""
        return np.where(environments[:, None], self._episodes.observe(environments), observations)

    def _reset_in_same_step(
        self, observations: NDArray[np.float32], infos: InfoArrays
    ) -> tuple[NDArray[np.float32], InfoArrays]:
        """Reset the environments whose episodes are over. Their last observations and infos go into the new infos."""
        over = self._episodes.is_over.copy()
        final_observations = np.full(self.num_envs, None, dtype=object)
        for environment in np.flatnonzero(over).tolist():
            final_observations[environment] = self._setup.split(observations[environment])
            self._reset_environment(environment, None)
        merged_infos = infos.select(~over)
        merged_infos.add("final_obs", final_observations, over)
        merged_infos.add_group("final_info", infos.select(over), over)
        merged_infos.update(self._make_reset_infos(over), over)
        return self._update_observations(over, observations), merged_infos

    # --- infos -----------------------------------------------------------------------------------------------

    def _make_reset_infos(self, environments: Mask) -> InfoArrays:
        """Return the merged info dicts of environments that have just been reset."""
        infos = InfoArrays(self.num_envs)
        infos.add(
            "seed", np.array([config.seed for config in self._episodes.configs]), environments
        )
        self._add_robot_infos(infos, environments)
        return infos

    def _make_step_infos(self, result: BatchStepResult, environments: Mask) -> InfoArrays:
        """Return the merged info dicts of environments that have taken a step."""
        infos = InfoArrays(self.num_envs)
        self._add_robot_infos(infos, environments)
        infos.add("energy_j", result.energy_j, environments)
        terms = InfoArrays(self.num_envs)
        for name, term in result.terms.items():
            terms.add(name, term, environments)
        infos.add_group("reward_terms", terms, environments)
        if result.endings:
            robots = self._episodes.robots
            infos.add_objects("ended", result.endings)
            infos.add_objects(
                "digest",
                {environment: robots.read_digest(environment) for environment in result.endings},
            )
        return infos

    def _add_robot_infos(self, infos: InfoArrays, environments: Mask) -> None:
        """Add the values that describe the robots at this tick to the infos of some environments.

        Every environment gets `time_s`, `advance_m` and `lifecycle`. Those with limited joints also get `limited`, and
        those that are not armed get `reason`.

        Args:
            infos: Infos to add the values to.
            environments: Which environments get values, (num_envs,).
        """
        robots = self._episodes.robots
        rows = np.flatnonzero(environments).tolist()
        lifecycle_by_row = {row: robots.read_lifecycle(row) for row in rows}
        infos.add("time_s", self._episodes.time_s, environments)
        infos.add("advance_m", self._episodes.advance_m, environments)
        infos.add_objects("lifecycle", lifecycle_by_row)
        # (num_envs, joints), None where no limit changed the target.
        limit_names = robots.read_limit_names()
        has_limited_joint = (limit_names != None).any(axis=1) & environments  # noqa: E711 - element by element
        if has_limited_joint.any():
            limit_infos = InfoArrays(self.num_envs)
            for joint_index, joint_name in enumerate(self._setup.action_names):
                is_limited = (limit_names[:, joint_index] != None) & environments  # noqa: E711
                if is_limited.any():
                    limit_infos.add(joint_name, limit_names[:, joint_index], is_limited)
            infos.add_group("limited", limit_infos, has_limited_joint)
        reason_by_row = {
            row: robots.read_reason(row)
            for row, lifecycle in lifecycle_by_row.items()
            if lifecycle != "armed"
        }
        if reason_by_row:
            infos.add_objects("reason", reason_by_row)


def _rebuild_vector(
    env_class: type[SnakeVectorEnv], arguments: dict[str, Any], spec: Any
) -> SnakeVectorEnv:
    """Return a new vector environment like the one that was pickled."""
    env = env_class(**arguments)
    env.spec = spec
    return env


def _read_mask(options: dict[str, Any] | None, count: int) -> Mask:
    """Return which environments a reset concerns. Raises ValueError for what is no mask, as Gymnasium does."""
    mask = None if options is None else options.get("reset_mask")
    if mask is None:
        return np.ones(count, dtype=np.bool_)
    if (
        not isinstance(mask, np.ndarray)
        or mask.shape != (count,)
        or mask.dtype != np.bool_
        or not mask.any()
    ):
        raise ValueError(
            f"options['reset_mask'] is {mask!r:.60}, must be an array of {count} booleans, at least one of them True"
        )
    return mask


def _expand_seeds(seed: Any, count: int) -> list[int | None]:
    """Expand the argument `seed` of `reset` to a seed for each environment, by the rules of Gymnasium.

    Args:
        seed: None, the seed of the first environment (those of the others count up from it), or a sequence of seeds.
        count: Number of environments.

    Returns:
        A seed for each environment. None keeps the random generator of the environment.

    Raises:
        gymnasium.error.Error: A seed is not a Python integer of 0 or more.
        ValueError: There is not one seed for each environment.
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, int):
        _validate_seed("seed", seed)
        return [seed + environment for environment in range(count)]
    try:
        seeds = list(seed)
    except TypeError:
        _validate_seed("seed", seed)
        raise
    if len(seeds) != count:
        raise ValueError(f"seed has {len(seeds)} entries, must be one number, or {count}")
    for environment, environment_seed in enumerate(seeds):
        _validate_seed(f"seed[{environment}]", environment_seed)
    return seeds


def _validate_seed(name: str, seed: Any) -> None:
    """Raise gymnasium.error.Error, with the name of the argument, for a value that is not a valid seed."""
    try:
        np_random(seed)
    except error.Error as refusal:
        raise error.Error(f"{name} is {seed!r:.60}: {refusal}") from None
