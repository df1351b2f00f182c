"""The episodes of many environments, stepped together: what `SnakeEnv` and `SnakeVectorEnv` have in common.

A step of all environments is, in this order:

1. `EnvironmentRobots.step` once in each tick: commands, limiters, motors, physics, heat, sensors
2. `BatchObserver.observe`: observations and advance, once
3. the terms of the reward and the ends of episodes, from arrays that were collected in the ticks

Every array has one row for each environment, and no row depends on another one. So an environment has the same bits
alone and among others.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from snakesim.environments.armed import Mask
from snakesim.environments.array_limiter import Masks
from snakesim.environments.observing import BatchObserver
from snakesim.environments.robots import EnvironmentRobots
from snakesim.environments.setup import MAX_SEED, EnvironmentSetup
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.controller import Task
from snakesim_hal.model.plugins import FILMS, load_plugin
from snakesim_hal.model.scenario import RunConfig

# A reset gives up after so many random fields without room for their obstacles.
MAX_FIELD_ATTEMPTS = 20


@dataclass(frozen=True)
class BatchStepResult:
    """The result of a step, a row for each environment; rows of environments that took no step mean nothing."""

    observations: NDArray[np.float32]
    rewards: Floats
    terminated: Mask
    truncated: Mask
    energy_j: Floats
    terms: dict[str, Floats]  # of the reward, weighted
    endings: dict[int, str]  # how episodes ended in this step, by environment


@dataclass(frozen=True)
class _StepTicks:
    """The ticks that a step has run."""

    count: int  # of the ticks in which at least one robot took part
    count_by_environment: NDArray[np.int64]  # (environments,)
    is_everyone_active: bool  # whether all environments took part in all ticks


class EpisodeBatch:
    """The current episodes of a number of environments.

    Attributes:
        robots: Robots of all environments.
        configs: Configuration of the episode of each environment.
        is_over: Whether each environment needs a reset before its next step, (environments,).
        has_robot: Whether each environment has a robot, (environments,).
    """

    def __init__(self, setup: EnvironmentSetup, count: int, thread_count: int) -> None:
        """Allocate the arrays for a number of environments. `reset` makes their robots.

        Args:
            setup: Checked arguments that all environments share.
            count: Number of environments.
            thread_count: Number of threads that step the physics.
        """
        self._setup = setup
        self._count = count
        joint_count = len(setup.action_names)
        self.robots = EnvironmentRobots(
            count,
            joint_count,
            assisted=setup.is_assisted,
            safe=setup.is_safe,
            thread_count=thread_count,
        )
        self._observer = BatchObserver(count, setup.description, setup.parts)
        self.configs: list[RunConfig] = [setup.config] * count
        self._period_ns: NDArray[np.int64] = np.full(count, setup.config.period_ns)
        self.has_robot: Mask = np.zeros(count, dtype=np.bool_)
        self.is_over: Mask = np.ones(count, dtype=np.bool_)
        self._elapsed_ticks: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
        self._remaining_ticks: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
        self._renderers: dict[int, Any] = {}

        # Samples of every tick of a step. The first axis is the tick.
        max_ticks = setup.frame_skip
        self._active_by_tick: Masks = np.zeros((max_ticks, count), dtype=np.bool_)
        self._joints_by_tick: Floats = np.zeros((max_ticks, count, 3 * joint_count))
        self._is_limited_by_tick = np.zeros((max_ticks, count, joint_count), dtype=np.bool_)

    @property
    def time_s(self) -> Floats:
        """Robot time since arming, (environments,)."""
        return np.asarray(self._elapsed_ticks * self._period_ns * 1e-9, dtype=np.float64)

    @property
    def advance_m(self) -> Floats:
        """Advance towards the goal, (environments,)."""
        return np.array([progress.advance_m for progress in self._observer.progress])

    def reset(self, environment: int, seed: int | None, rng: Generator) -> None:
        """Start an episode: make the robot in its scene, and arm it.

        Args:
            environment: Row of the environment.
            seed: Seed of sensor noise and of random fields. None draws a seed from `rng`.
            rng: Random generator for seeds.

        Raises:
            ConfigError: The obstacles of this seed's random field find no place. With `seed=None`, those of
                MAX_FIELD_ATTEMPTS fields.
        """
        self.close(environment)
        config = self._start_robot(environment, seed, rng)
        self.configs[environment] = config
        self._observer.restart(environment, self._setup.describe(config), Task.from_config(config))
        self._period_ns[environment] = config.period_ns
        self._elapsed_ticks[environment] = 0
        self._remaining_ticks[environment] = round(config.duration_s * config.rate_hz)
        self.has_robot[environment] = True
        self.is_over[environment] = False

    def observe(self, environments: Mask) -> NDArray[np.float32]:
        """Return the observations of this tick, (environments, n). Only the rows of these environments are valid."""
        return self._observer.observe(self.robots, self.time_s, environments)

    def step(self, actions: Floats, environments: Mask) -> BatchStepResult:
        """Take a step: command the same targets for `frame_skip` ticks, and compute observations and rewards.

        A robot that is stopped by a fault, or whose time is over, takes part in no further tick of the step.

        Args:
            actions: Targets of all joints, (environments, joints), in the unit of the actions. The array must not
                change afterwards.
            environments: Which environments take the step, (environments,). None of their episodes may be over. The
                array must not change afterwards. A call with the array of the last step is faster.

        Returns:
            Observations, rewards and ends of episodes. Rows of environments that took no step are not valid.
        """
        setup = self._setup
        # Until the step is complete: after an interrupt the environments need a reset, because ticks are not counted.
        self.is_over = self.is_over | environments
        start_advance_m = self.advance_m
        ticks = self._run_ticks(actions, environments)
        self._elapsed_ticks = self._elapsed_ticks + ticks.count_by_environment
        self._remaining_ticks = self._remaining_ticks - ticks.count_by_environment

        # The terms of the rewards. `observe` also updates the advance and whether the goal is reached.
        observations = self.observe(environments)
        energy_j, limited_count = self._sum_energy_and_limited_joints(
            ticks.count, ticks.is_everyone_active
        )
        is_goal_reached = np.array(
            [progress.is_goal_reached for progress in self._observer.progress]
        )
        is_stopped = ~self.robots.is_armed
        term_values = {
            "advance": self.advance_m - start_advance_m,
            "energy": energy_j,
            "limited": limited_count
            / (np.maximum(ticks.count_by_environment, 1) * actions.shape[1]),
            "goal": is_goal_reached.astype(np.float64),
            "stopped": is_stopped.astype(np.float64),
        }
        terms = {name: setup.weights[name] * value for name, value in term_values.items()}

        # The ends of episodes.
        terminated = (is_goal_reached | is_stopped) & environments
        truncated = (self._remaining_ticks == 0) & environments
        self.is_over = np.where(environments, terminated | truncated, self.is_over)
        endings: dict[int, str] = {}
        for environment in np.flatnonzero(terminated | truncated).tolist():
            endings[environment] = _describe_ending(
                is_stopped=bool(is_stopped[environment]),
                is_goal_reached=bool(is_goal_reached[environment]),
            )
        return BatchStepResult(
            observations, sum_terms(terms), terminated, truncated, energy_j, terms, endings
        )

    def _run_ticks(self, actions: Floats, environments: Mask) -> _StepTicks:
        """Run the ticks of a step, and store the samples of each tick in the arrays `..._by_tick`.

        A robot takes part until a fault stops it, or its time is over.

        Args:
            actions: Targets of all joints, (environments, joints).
            environments: Which environments take the step, (environments,).
        """
        frame_skip = self._setup.frame_skip
        count_by_environment = np.zeros(self._count, dtype=np.int64)
        tick_count = 0
        is_everyone_active = True
        # No robot's time is over before this tick of the step.
        min_remaining_ticks = int(self._remaining_ticks[environments].min(initial=frame_skip))
        environment_count = np.count_nonzero(environments)
        active = environments
        is_armed: Mask | None = None  # as of the last computation of `active`
        for tick in range(frame_skip):
            # Which robots are active can change only when one was stopped (a new array), or when the time may be over.
            if is_armed is not self.robots.is_armed or tick >= min_remaining_ticks:
                is_armed = self.robots.is_armed
                active = environments & is_armed & (count_by_environment < self._remaining_ticks)
                active_count = np.count_nonzero(active)
                is_everyone_active = is_everyone_active and active_count == self._count
                if not active_count:
                    break
                # If possible the object of the last step, for which the robots have cached their masks.
                if active_count == environment_count:
                    active = environments
            self.robots.step(self._setup.commands.mode, actions, active)
            self._active_by_tick[tick] = active
            self._joints_by_tick[tick] = self.robots.joints
            self._is_limited_by_tick[tick] = self.robots.is_limited
            count_by_environment = count_by_environment + active
            tick_count += 1
        return _StepTicks(tick_count, count_by_environment, is_everyone_active)

    def render(self, environment: int) -> NDArray[np.uint8]:
        """Return a picture of a robot in its scene, (height, width, 3), drawn as by `snakesim recording video`."""
        if environment not in self._renderers:
            make_renderer = load_plugin(FILMS, "mujoco")
            self._renderers[environment] = make_renderer(
                self.configs[environment], *self._setup.picture_size
            )
        progress = self._observer.progress[environment]
        position_w, wxyz = (np.array(part) for part in progress.pose)
        look_at_w = np.array([*progress.center_w, progress.mean_height_m])
        angles_rad = self.robots.joints[environment, : len(self._setup.action_names)]
        return self._renderers[environment].render_picture(position_w, wxyz, angles_rad, look_at_w)

    def close(self, environment: int) -> None:
        """Release the robot and the renderer of an environment."""
        self.robots.stop(environment)
        renderer = self._renderers.pop(environment, None)
        if renderer is not None:
            renderer.close()
        self.has_robot[environment] = False
        self.is_over[environment] = True

    def _start_robot(self, environment: int, seed: int | None, rng: Generator) -> RunConfig:
        """Put an armed robot in the scene of a seed, and return the configuration of the episode.

        Without a seed, random fields without room for their obstacles are drawn again, up to MAX_FIELD_ATTEMPTS times.

        Args:
            environment: Row of the environment.
            seed: Seed of the episode. None, or a seed that the configuration does not allow, draws a seed from `rng`.
            rng: Random generator for seeds.

        Raises:
            ConfigError: The obstacles of the random fields find no place.
            RefusedError: The robot cannot be armed.
        """
        fixed_seed = seed if seed is not None and 0 <= seed <= MAX_SEED else None
        for attempts_left in reversed(range(MAX_FIELD_ATTEMPTS)):
            episode_seed = int(rng.integers(MAX_SEED)) if fixed_seed is None else fixed_seed
            try:
                config = self._setup.make_config(episode_seed)
                self.robots.start(environment, config, self._setup.describe(config))
                return config
            except ConfigError:
                may_draw_again = fixed_seed is None and self._setup.new_fields > 0
                if not may_draw_again or not attempts_left:
                    raise
        raise AssertionError("the last attempt returns or raises")

    def _sum_energy_and_limited_joints(
        self, tick_count: int, is_everyone_active: bool
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Sum the energy and the limited targets of each environment over the ticks of a step.

        Args:
            tick_count: Number of ticks in the step.
            is_everyone_active: Whether all environments took part in all ticks, so that no row needs to be masked.

        Returns:
            Energy in J, which is the sum over joints of |torque x velocity| over time, and the number of targets that
            the limiter changed, both (environments,).
        """
        if not tick_count:
            return np.zeros(self._count), np.zeros(self._count, dtype=np.int64)
        joint_count = len(self._setup.action_names)
        samples = self._joints_by_tick[:tick_count]
        # A cumulative sum adds in order. `sum` would round differently for another number of environments.
        joint_power_w = np.abs(
            samples[:, :, 2 * joint_count :] * samples[:, :, joint_count : 2 * joint_count]
        )
        energy_j = joint_power_w.cumsum(axis=2)[:, :, -1] * self._period_ns * 1e-9
        is_limited = self._is_limited_by_tick[:tick_count]
        if not is_everyone_active:
            active = self._active_by_tick[:tick_count]
            energy_j = np.where(active, energy_j, 0.0)
            is_limited = is_limited & active[:, :, None]
        return energy_j.cumsum(axis=0)[-1], is_limited.sum(axis=(0, 2))


def sum_terms(terms: dict[str, Floats]) -> Floats:
    """Return the rewards, which are the sums of their terms in order."""
    total: Any = 0
    for term in terms.values():
        total = total + term
    return total


def _describe_ending(*, is_stopped: bool, is_goal_reached: bool) -> str:
    """Return how an episode ended: "stopped", "goal" or "time", in this order of precedence."""
    if is_stopped:
        return "stopped"
    if is_goal_reached:
        return "goal"
    return "time"
