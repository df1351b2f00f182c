"""The environment: a scenario with an agent as its controller, and the HAL's limiter between agent and motors."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from snakesim.environments.episodes import BatchStepResult, EpisodeBatch
from snakesim.environments.setup import RENDER_MODES, EnvironmentSetup
from snakesim_hal.model.scenario import RunConfig

ObservationValues = NDArray[np.float32] | dict[str, NDArray[np.float32]]
ONLY_ROW = 0  # of the arrays, which have one row for each environment
ONLY_ENVIRONMENT_MASK = np.ones(1, dtype=np.bool_)


class SnakeEnv(gymnasium.Env[Any, Any]):
    """A Gymnasium environment with one robot in one scenario. See `docs/how-to/environments.md`.

    It has the code of `SnakeVectorEnv`, with one environment.

    A pickle holds the arguments and no robot: an environment that is loaded from one needs a `reset`, as Gymnasium's
    own MuJoCo environments do.
    """

    metadata = {"render_modes": RENDER_MODES, "render_fps": 20}

    def __init__(
        self,
        scenario: str | os.PathLike[str] | None = None,
        *,
        action: str = "position",
        observe: Sequence[str] | None = None,
        flat: bool = True,
        reward: Mapping[str, float] | None = None,
        frame_skip: int = 5,
        duration: float | None = None,
        set: Mapping[str, Any] | None = None,
        randomize: Mapping[str, Sequence[float]] | None = None,
        new_field: bool = True,
        safe: bool = True,
        residual_rad: float = 0.2,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Load and check the scenario. `reset` makes the robot.

        Args:
            scenario: Shipped name of a scenario, or path of a scenario file.
            action: What an action is: "position" (rad), "velocity" (rad/s) or "torque" (N·m) of each joint, or
                "residual:CONTROLLER" for corrections in rad to the position targets of that controller.
            observe: Parts of the observation by name. None takes the default parts.
            flat: Whether an observation is one vector of all parts, rather than a dict of vectors.
            reward: Weights of reward terms that differ from the defaults in `rewards.REWARD_TERMS`.
            frame_skip: Ticks of the robot in one step.
            duration: Robot time in s until an episode is truncated. None takes the scenario's duration.
            set: Values by their dotted keys, as in `snakesim.run`.
            randomize: Dotted keys with two bounds each. Every seed has its own number between them.
            new_field: Whether each reset draws the scene's random fields again.
            safe: Whether the HAL's limiter limits every command.
            residual_rad: Largest correction of a joint in rad, for "residual:CONTROLLER".
            render_mode: "rgb_array", or None.
            width: Width of pictures in pixels.
            height: Height of pictures in pixels.

        Raises:
            ConfigError: An argument is wrong. The message is that of the command `snakesim run`.
        """
        self._arguments = {
            name: value for name, value in locals().items() if name not in ("self", "__class__")
        }
        setup = EnvironmentSetup(**self._arguments)
        self.setup = setup  # the same for all environments with these arguments
        self._episodes = EpisodeBatch(setup, 1, thread_count=1)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": setup.render_fps}

        # The spaces, and a name and a unit for every number in them.
        self.description = setup.description
        self.parts = setup.parts
        self.action_space = setup.action_space
        self.action_names = setup.action_names
        self.action_units = setup.action_units
        self.observation_space = setup.observation_space
        self.observation_names = setup.observation_names
        self.observation_units = setup.observation_units

    def __reduce__(self) -> Any:
        return _rebuild_environment, (type(self), self._arguments, self.spec)

    @property
    def config(self) -> RunConfig:
        """The configuration of this episode. `snakesim run` takes it, written to a file."""
        return self._episodes.configs[ONLY_ROW]

    @property
    def digest(self) -> str:
        """Hash of every setpoint as applied in this episode: the same for the same seed and actions, to the bit."""
        self._require_robot()
        return self._episodes.robots.read_digest(ONLY_ROW)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationValues, dict[str, Any]]:
        """Start an episode: make the robot in its scene, and arm it.

        Args:
            seed: Seed of sensor noise and of random fields. None draws one from the environment's own generator.
            options: Not used.

        Returns:
            The first observation, and an info dict with `seed`, `time_s`, `advance_m` and `lifecycle`.

        Raises:
            ConfigError: The obstacles of this seed's random field find no place. With `seed=None`, those of
                MAX_FIELD_ATTEMPTS fields.
        """
        super().reset(seed=seed)
        self._episodes.reset(ONLY_ROW, seed, self.np_random)
        observation = self.setup.split(self._episodes.observe(ONLY_ENVIRONMENT_MASK)[ONLY_ROW])
        return observation, {"seed": self.config.seed, **self._make_robot_info()}

    def step(self, action: Any) -> tuple[ObservationValues, float, bool, bool, dict[str, Any]]:
        """Command targets for `frame_skip` ticks, or until the robot is stopped or the time is over.

        Args:
            action: A target for each joint, tail to head, (joints,), in the unit of `action_units`.

        Returns:
            Observation, reward, terminated (goal reached, or stopped by a fault), truncated (time over), and an info
            dict with `time_s`, `advance_m`, `lifecycle`, `energy_j` and `reward_terms`. After the last step it also
            has `ended` ("goal", "stopped" or "time") and `digest`.

        Raises:
            gymnasium.error.ResetNeeded: The episode is over, or `reset` was never called.
            ValueError: The action has another shape, or holds a number that is not finite.
        """
        self._require_robot()
        target = self.setup.commands.convert_action(action)
        if self._episodes.is_over[ONLY_ROW]:
            raise gymnasium.error.ResetNeeded(
                "the episode is over, or its last step did not finish; call reset()"
            )
        result = self._episodes.step(target[None], ONLY_ENVIRONMENT_MASK)
        return (
            self.setup.split(result.observations[ONLY_ROW]),
            float(result.rewards[ONLY_ROW]),
            bool(result.terminated[ONLY_ROW]),
            bool(result.truncated[ONLY_ROW]),
            self._make_step_info(result),
        )

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture of the robot in its scene, (height, width, 3), drawn as by `snakesim recording video`.

        Raises:
            gymnasium.error.ResetNeeded: There is no robot before the first `reset`, nor after `close`.
        """
        if self.render_mode is None:
            return None
        self._require_robot()
        return self._episodes.render(ONLY_ROW)

    def close(self) -> None:
        """Release the robot and the renderer."""
        self._episodes.close(ONLY_ROW)

    def _require_robot(self) -> None:
        """Raise ResetNeeded if there is no robot."""
        if not self._episodes.has_robot[ONLY_ROW]:
            raise gymnasium.error.ResetNeeded("there is no robot yet; call reset()")

    def _make_robot_info(self) -> dict[str, Any]:
        """Return the part of an info dict that describes the robot at this tick."""
        robots = self._episodes.robots
        lifecycle = robots.read_lifecycle(ONLY_ROW)
        info: dict[str, Any] = {
            "time_s": float(self._episodes.time_s[ONLY_ROW]),
            "advance_m": float(self._episodes.advance_m[ONLY_ROW]),
            "lifecycle": lifecycle,
        }
        joints_with_limits = zip(
            self.action_names, robots.read_limit_names()[ONLY_ROW].tolist(), strict=True
        )
        limited = {joint: name for joint, name in joints_with_limits if name is not None}
        if limited:
            info["limited"] = limited
        if lifecycle != "armed":
            info["reason"] = robots.read_reason(ONLY_ROW)
        return info

    def _make_step_info(self, result: BatchStepResult) -> dict[str, Any]:
        """Return the info dict of a step."""
        terms = {name: float(term[ONLY_ROW]) for name, term in result.terms.items()}
        info = {
            **self._make_robot_info(),
            "energy_j": float(result.energy_j[ONLY_ROW]),
            "reward_terms": terms,
        }
        if ONLY_ROW in result.endings:
            info["ended"] = result.endings[ONLY_ROW]
            info["digest"] = self._episodes.robots.read_digest(ONLY_ROW)
        return info


def _rebuild_environment(
    env_class: type[SnakeEnv], arguments: dict[str, Any], spec: Any
) -> SnakeEnv:
    """Return a new environment like the one that was pickled."""
    env = env_class(**arguments)
    env.spec = spec
    return env
