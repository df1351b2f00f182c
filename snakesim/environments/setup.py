"""The arguments of environments, checked, and what follows from them: spaces, and the configuration of each episode."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces

from snakesim.configuration import load_and_validate_config, make_overrides
from snakesim.environments.actions import ActionTargets, parse_corrected_controller
from snakesim.environments.rewards import fill_reward_weights
from snakesim_gnc.control.observations import ObservationBuilder, select_observation_parts
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import KeyOverride, RunConfig, describe_run_robot
from snakesim_hal.model.scene_file.randomization import parse_randomizations
from snakesim_hal.wire.messages import RobotDescription

RENDER_MODES = ["rgb_array"]
MAX_SEED = 2**31


class EnvironmentSetup:
    """The checked arguments of environments, and what all environments with the same arguments share.

    Attributes:
        config: Configuration of the scenario, without what a seed changes.
        new_fields: Number of random fields that each reset draws again.
    """

    def __init__(
        self,
        *,
        scenario: str | os.PathLike[str] | None,
        action: str,
        observe: Sequence[str] | None,
        flat: bool,
        reward: Mapping[str, float] | None,
        frame_skip: int,
        duration: float | None,
        set: Mapping[str, Any] | None,
        randomize: Mapping[str, Sequence[float]] | None,
        new_field: bool,
        safe: bool,
        residual_rad: float,
        render_mode: str | None,
        width: int,
        height: int,
    ) -> None:
        """Load and check the scenario. The arguments are those of `SnakeEnv`.

        Raises:
            ConfigError: An argument is wrong. The message is that of the command `snakesim run`.
        """
        if scenario is None:
            raise ConfigError(
                "SnakeSIM/Scenario-v0 needs scenario=..., a shipped name or the path of a file",
                code="python/invalid-argument",
            )
        _validate_step_arguments(frame_skip, render_mode, residual_rad)
        # The controller whose targets the actions correct; None if the actions are targets themselves.
        corrected_controller = parse_corrected_controller(action)
        overrides = make_overrides(set, duration_s=duration)
        if corrected_controller is not None:
            if not safe:
                raise ConfigError(
                    f"action={action!r}: a controller commands through the limiter; leave safe=False out",
                    code="python/invalid-argument",
                )
            overrides.insert(0, KeyOverride("controller", corrected_controller, f"action={action}"))

        # The scenario, and what each seed changes in it.
        self._scenario = os.fspath(scenario)
        self._overrides = overrides
        self._randomizations = parse_randomizations(randomize)
        self.config: RunConfig = self._load_config(0)
        self.new_fields = len(self.config.scene.random_field) if new_field else 0

        # Steps, rewards and pictures.
        self.is_assisted = corrected_controller is not None
        self.is_safe = safe
        self.frame_skip = frame_skip
        self.weights = fill_reward_weights(reward)
        self.render_mode = render_mode
        self.render_fps = self.config.rate_hz / frame_skip
        self.picture_size = (width, height)

        self.description = describe_run_robot(self.config)
        self.commands = ActionTargets.for_robot(self.description, action, residual_rad)
        self._declare_spaces(observe, flat)

    def _declare_spaces(self, observe: Sequence[str] | None, flat: bool) -> None:
        """Set the action space and the observation space, and a name and a unit for every value in them.

        An observation consists of parts, such as the joint angles. In a flat space the values of all parts are one
        vector. Otherwise the space is a dict of the parts.

        Args:
            observe: Names of the parts of an observation. None takes the default parts of `select_observation_parts`.
            flat: Whether an observation is one vector instead of a dict.
        """
        self.action_space = _make_box(self.commands.low, self.commands.high)
        self.action_names = list(self.commands.names)
        self.action_units = [self.commands.unit] * len(self.action_names)

        self.parts = select_observation_parts(self.description, observe)
        self.observation_names: list[str] = []
        self.observation_units: list[str] = []
        slice_by_part: dict[str, slice] = {}
        space_by_part: dict[str, spaces.Space[Any]] = {}
        for part_name, part in self.parts.items():
            start = len(self.observation_names)
            self.observation_names += [f"{part_name}.{name}" for name in part.names]
            self.observation_units += [part.unit] * len(part.names)
            slice_by_part[part_name] = slice(start, len(self.observation_names))
            space_by_part[part_name] = _make_box(part.low, part.high)
        self.observation_space: spaces.Space[Any]
        # Of each part in an observation; None for a flat space.
        self.slices: dict[str, slice] | None = None
        if flat:
            observer = ObservationBuilder(self.description, self.parts)
            self.observation_space = spaces.Box(observer.low, observer.high)
        else:
            self.observation_space = spaces.Dict(space_by_part)
            self.slices = slice_by_part

    def make_config(self, seed: int) -> RunConfig:
        """Return the configuration of an episode.

        Args:
            seed: Seed of the run and of the random obstacle fields. It also decides the randomized parameters.

        Raises:
            ConfigError: A randomized value is not allowed.
        """
        if not self._randomizations:  # faster than to load the scenario again
            return self._replace_seeds(seed)
        field_keys = [f"scene.random_field.{i}.seed" for i in range(self.new_fields)]
        return self._load_config(seed, ["seed", *field_keys])

    def describe(self, config: RunConfig) -> RobotDescription:
        """Return the description of the robot of an episode.

        The hash of the configuration in it may be that of another seed. Nothing reads this hash here.
        """
        has_equal_times = (config.period_ns, config.lease_ns) == (
            self.config.period_ns,
            self.config.lease_ns,
        )
        if config.robot is self.config.robot and has_equal_times:
            return self.description
        return describe_run_robot(config)

    def split(self, observations: Any) -> Any:
        """Return observations as the observation space has them: unchanged, or a dict of their parts."""
        if self.slices is None:
            return observations
        return {name: observations[..., part] for name, part in self.slices.items()}

    def _replace_seeds(self, seed: int) -> RunConfig:
        """Return the configuration of the scenario with another seed, also of its random fields."""
        if not self.new_fields:
            return msgspec.structs.replace(self.config, seed=seed)
        fields = [
            msgspec.structs.replace(field, seed=seed) for field in self.config.scene.random_field
        ]
        scene = msgspec.structs.replace(self.config.scene, random_field=fields)
        return msgspec.structs.replace(self.config, seed=seed, scene=scene)

    def _load_config(self, seed: int, seed_keys: Sequence[str] = ()) -> RunConfig:
        """Load the scenario with the parameters that a seed randomizes.

        Args:
            seed: Seed that decides the randomized parameters.
            seed_keys: Dotted keys of the configuration that get the seed itself as their value.

        Raises:
            ConfigError: The scenario or a randomized value is wrong.
        """
        overrides = [*self._overrides]
        overrides += [KeyOverride(key, seed, "seed") for key in seed_keys]
        for randomization in self._randomizations:
            overrides += randomization.sample_overrides(seed, "randomize")
        return load_and_validate_config(self._scenario, overrides, processes=False)


def _validate_step_arguments(frame_skip: int, render_mode: str | None, residual_rad: float) -> None:
    """Raise ConfigError unless the arguments that decide what a step does are valid.

    Args:
        frame_skip: Number of ticks in each step.
        render_mode: Kind of pictures that `render` returns. None if there are none.
        residual_rad: Largest correction of a controller's target, in rad.

    Raises:
        ConfigError: An argument is wrong.
    """
    if type(frame_skip) is not int or frame_skip < 1:
        raise ConfigError(
            f"frame_skip={frame_skip!r:.60}: give a whole number of ticks, 1 or more",
            code="python/invalid-argument",
        )
    if render_mode not in (None, *RENDER_MODES):
        raise ConfigError(
            f"render_mode={render_mode!r:.60}: give 'rgb_array', or leave it out",
            code="python/invalid-argument",
        )
    if not residual_rad > 0:
        raise ConfigError(
            f"residual_rad={residual_rad!r:.60}: give a number > 0, in rad",
            code="python/invalid-argument",
        )


def _make_box(low: Sequence[float], high: Sequence[float]) -> spaces.Box:
    return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))
