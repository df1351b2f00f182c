"""The episodes of many environments, stepped together: what `SnakeEnv` and `SnakeVectorEnv` have in common.

A step of all environments is, in this order:

1. `Robots.step` once in each tick: commands, limiters, motors, physics, heat, sensors
2. `Observers.observe`: observations and advance, once
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
from snakesim.environments.observing import Observers
from snakesim.environments.robots import Robots
from snakesim.environments.setup import MAX_SEED, EnvironmentSetup
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.controller import Task
from snakesim_hal.model.plugins import FILMS, find_plugin
from snakesim_hal.model.scenario import RunConfig

MAX_FIELD_ATTEMPTS = 20  # a reset gives up after so many random fields without room for their obstacles


@dataclass(frozen=True)
class StepResult:
    """The result of a step, a row for each environment; rows of environments that took no step mean nothing."""

    observations: NDArray[np.float32]
    rewards: Floats
    terminated: Mask
    truncated: Mask
    energy_j: Floats
    terms: dict[str, Floats]  # of the reward, weighted
    endings: dict[int, str]  # how the episodes ended that did


class Episodes:
    """The present episodes of a number of environments.

    Attributes:
        robots: the robots.
        configs: configuration of each episode.
        is_over: (environments,), whether an environment needs a reset before its next step.
        time_s: (environments,), robot time since arming.
        advance_m: (environments,), advance towards the goal.
    """

    def __init__(self, setup: EnvironmentSetup, count: int, threads: int) -> None:
        """Make room for environments. `reset` makes their robots.

        Args:
            setup: what they share.
            count: their number.
            threads: number of threads that step the physics.
        """
        self._setup = setup
        self._count = count
        joints = len(setup.action_names)
        self.robots = Robots(count, joints, assisted=setup.is_assisted, safe=setup.is_safe, threads=threads)
        self._observers = Observers(count, setup.description, setup.parts)
        self.configs: list[RunConfig] = [setup.config] * count
        self._period_ns: NDArray[np.int64] = np.full(count, setup.config.period_ns)
        self.has_robot: Mask = np.zeros(count, dtype=np.bool_)
        self.is_over: Mask = np.ones(count, dtype=np.bool_)
        self._ticks: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
        self._ticks_left: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
        self._films: dict[int, Any] = {}

        # What is collected in the ticks of a step.
        ticks = setup.frame_skip
        self._tick_active: Masks = np.zeros((ticks, count), dtype=np.bool_)
        self._tick_joints: Floats = np.zeros((ticks, count, 3 * joints))
        self._tick_is_limited = np.zeros((ticks, count, joints), dtype=np.bool_)

    @property
    def time_s(self) -> Floats:
        """Robot time since arming, (environments,)."""
        return np.asarray(self._ticks * self._period_ns * 1e-9, dtype=np.float64)

    @property
    def advance_m(self) -> Floats:
        """Advance towards the goal, (environments,)."""
        return np.array([progress.along_m for progress in self._observers.progress])

    def reset(self, environment: int, seed: int | None, random: Generator) -> None:
        """Start an episode: make the robot in its scene, and arm it.

        Args:
            environment: its row.
            seed: seed of sensor noise and of random fields. None draws one.
            random: draws seeds.

        Raises:
            ConfigError: The obstacles of this seed's random field find no place. With `seed=None`, those of
                MAX_FIELD_ATTEMPTS fields.
        """
        self.close(environment)
        config = self._start_robot(environment, seed, random)
        self.configs[environment] = config
        self._observers.restart(environment, self._setup.describe(config), Task.from_config(config))
        self._period_ns[environment] = config.period_ns
        self._ticks[environment] = 0
        self._ticks_left[environment] = round(config.duration_s * config.rate_hz)
        self.has_robot[environment] = True
        self.is_over[environment] = False

    def observe(self, environments: Mask) -> NDArray[np.float32]:
        """Return what controllers would observe at this tick; only the rows of these environments mean something."""
        return self._observers.observe(self.robots, self.time_s, environments)

    def step(self, actions: Floats, environments: Mask) -> StepResult:
        """Command targets for `frame_skip` ticks, or until robots are stopped or their time is over.

        Args:
            actions: (environments, joints), in the unit of the actions. It must not change afterwards.
            environments: (environments,), those that take the step; none of them is over.
        """
        setup = self._setup
        self.is_over = self.is_over | environments  # if an interrupt ends this step, some of its ticks are not counted
        start_m = self.advance_m
        ticks = np.zeros(self._count, dtype=np.int64)
        count = 0  # of ticks
        all_active = True
        shortest = int(self._ticks_left[environments].min(initial=setup.frame_skip))
        active = environments
        is_armed: Mask | None = None  # as of the last computation of `active`
        for tick in range(setup.frame_skip):
            if is_armed is not self.robots.is_armed or tick >= shortest:
                is_armed = self.robots.is_armed
                active = environments & is_armed & (ticks < self._ticks_left)
                all_active = all_active and bool(active.all())
                if not np.count_nonzero(active):
                    break
            self.robots.step(setup.commands.mode, actions, active)
            self._tick_active[tick] = active
            self._tick_joints[tick] = self.robots.joints
            self._tick_is_limited[tick] = self.robots.is_limited
            ticks = ticks + active
            count += 1
        self._ticks = self._ticks + ticks
        self._ticks_left = self._ticks_left - ticks

        observations = self.observe(environments)
        energy_j, limited = self._sum_ticks(count, all_active)
        reached = np.array([progress.reached for progress in self._observers.progress])
        stopped = ~self.robots.is_armed
        values = {
            "advance": self.advance_m - start_m,
            "energy": energy_j,
            "limited": limited / (np.maximum(ticks, 1) * actions.shape[1]),
            "goal": reached.astype(np.float64),
            "stopped": stopped.astype(np.float64),
        }
        terms = {name: setup.weights[name] * value for name, value in values.items()}
        terminated = (reached | stopped) & environments
        truncated = (self._ticks_left == 0) & environments
        self.is_over = np.where(environments, terminated | truncated, self.is_over)
        endings: dict[int, str] = {}
        for environment in np.flatnonzero(terminated | truncated).tolist():
            endings[environment] = _name_ending(stopped=stopped[environment], reached=reached[environment])
        return StepResult(observations, sum_terms(terms), terminated, truncated, energy_j, terms, endings)

    def render(self, environment: int) -> NDArray[np.uint8]:
        """Return a picture of a robot in its scene, (height, width, 3), drawn as by `snakesim recording video`."""
        if environment not in self._films:
            make_film = find_plugin(FILMS, "mujoco")
            self._films[environment] = make_film(self.configs[environment], *self._setup.picture_size)
        progress = self._observers.progress[environment]
        position_w, wxyz = (np.array(part) for part in progress.pose)
        look_at_w = np.array([*progress.center_w, progress.height_m])
        angles_rad = self.robots.joints[environment, : len(self._setup.action_names)]
        return self._films[environment].picture(position_w, wxyz, angles_rad, look_at_w)

    def close(self, environment: int) -> None:
        """Release the robot and the renderer of an environment."""
        self.robots.stop(environment)
        film = self._films.pop(environment, None)
        if film is not None:
            film.close()
        self.has_robot[environment] = False
        self.is_over[environment] = True

    def _start_robot(self, environment: int, seed: int | None, random: Generator) -> RunConfig:
        """Put an armed robot in the scene of a seed, and return the configuration of the episode.

        Without a seed, random fields without room for their obstacles are drawn again. Raises ConfigError.
        """
        given = seed if seed is not None and 0 <= seed <= MAX_SEED else None
        for attempts_left in reversed(range(MAX_FIELD_ATTEMPTS)):
            episode_seed = int(random.integers(MAX_SEED)) if given is None else given
            try:
                config = self._setup.make_config(episode_seed)
                self.robots.start(environment, config, self._setup.describe(config))
                return config
            except ConfigError:
                may_draw_again = given is None and self._setup.new_fields > 0
                if not may_draw_again or not attempts_left:
                    raise
        raise AssertionError("the last attempt returns or raises")

    def _sum_ticks(self, count: int, all_active: bool) -> tuple[Floats, NDArray[np.int64]]:
        """Return the energy in J and the number of limited targets of each environment in a step.

        Args:
            count: number of ticks in the step.
            all_active: whether all environments took part in all of them.
        """
        if not count:
            return np.zeros(self._count), np.zeros(self._count, dtype=np.int64)
        joints = len(self._setup.action_names)
        samples = self._tick_joints[:count]
        # The sums are made in order, so that they do not depend on how many environments there are.
        joint_power_w = np.abs(samples[:, :, 2 * joints :] * samples[:, :, joints : 2 * joints])
        energy_j = joint_power_w.cumsum(axis=2)[:, :, -1] * self._period_ns * 1e-9
        is_limited = self._tick_is_limited[:count]
        if not all_active:
            active = self._tick_active[:count]
            energy_j = np.where(active, energy_j, 0.0)
            is_limited = is_limited & active[:, :, None]
        return energy_j.cumsum(axis=0)[-1], is_limited.sum(axis=2).sum(axis=0)


def sum_terms(terms: dict[str, Floats]) -> Floats:
    """Return the rewards, which are the sums of their terms in order."""
    total: Any = 0
    for term in terms.values():
        total = total + term
    return total


def _name_ending(*, stopped: bool, reached: bool) -> str:
    """Return how an episode ended."""
    if stopped:
        return "stopped"
    if reached:
        return "goal"
    return "time"
