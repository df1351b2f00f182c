"""The environment: a scenario with an agent as its controller, and the HAL's limiter between agent and motors."""

import os
from collections.abc import Mapping, Sequence
from operator import mul
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from snakesim.configuration import list_overrides, load_checked
from snakesim.environments.actions import Commands, corrected_controller
from snakesim.environments.assisted import AssistedRobot
from snakesim.environments.rewards import complete_weights
from snakesim.environments.stepped import SteppedRobot
from snakesim_gnc.control.observations import Observer, select_parts
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.controller import Observation, SensorSamples, Task
from snakesim_hal.model.plugins import FILMS, find_plugin
from snakesim_hal.model.randomization import make_randomizations
from snakesim_hal.model.scenario import Override, RunConfig, describe_run_robot
from snakesim_hal.wire.messages import JointState

ObservationValues = NDArray[np.float32] | dict[str, NDArray[np.float32]]
MAX_SEED = 2**31
Robot = SteppedRobot | AssistedRobot
MAX_FIELD_ATTEMPTS = 20  # a reset gives up after so many random fields without room for their obstacles


class SnakeEnv(gymnasium.Env[Any, Any]):
    """A Gymnasium environment with one robot in one scenario; see `docs/how-to/environments.md`.

    A pickle holds the arguments and no robot: an environment that is loaded from one needs a `reset`, as Gymnasium's
    own MuJoCo environments do.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

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
            observe: Parts of the observation by name; None takes the default parts.
            flat: Whether an observation is one vector of all parts, rather than a dict of vectors.
            reward: Weights of reward terms that differ from the defaults in `rewards.TERMS`.
            frame_skip: Ticks of the robot in one step.
            duration: Robot time in s until an episode is truncated; None takes the scenario's duration.
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
        self._arguments = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        if scenario is None:
            raise ConfigError(
                "SnakeSIM/Scenario-v0 needs scenario=..., a shipped name or the path of a file",
                code="python/invalid-argument",
            )
        if type(frame_skip) is not int or frame_skip < 1:
            raise ConfigError(
                f"frame_skip={frame_skip!r:.60}: give a whole number of ticks, 1 or more",
                code="python/invalid-argument",
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"render_mode={render_mode!r:.60}: give 'rgb_array', or leave it out", code="python/invalid-argument"
            )
        if not residual_rad > 0:
            raise ConfigError(
                f"residual_rad={residual_rad!r:.60}: give a number > 0, in rad", code="python/invalid-argument"
            )
        controller = corrected_controller(action)
        overrides = list_overrides(set, duration_s=duration)
        if controller is not None:
            if not safe:
                raise ConfigError(
                    f"action={action!r}: a controller commands through the limiter; leave safe=False out",
                    code="python/invalid-argument",
                )
            overrides.insert(0, Override("controller", controller, f"action={action}"))

        # The scenario, and what each seed changes in it.
        self._scenario = os.fspath(scenario)
        self._overrides = overrides
        self._randomizations = make_randomizations(randomize)
        self._new_field = new_field
        self._scenario_config = self._load_config(0)
        self.config: RunConfig = self._scenario_config  # of this episode: `snakesim run` takes it, written to a file

        # The robot.
        self._assisted = controller is not None
        self._safe = safe
        self._frame_skip = frame_skip
        self._robot: Robot | None = None
        self._over = True

        # Rewards and pictures.
        self._weights = complete_weights(reward)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.config.rate_hz / frame_skip}
        self._picture_size = (width, height)
        self._film: Any = None

        self._declare_spaces(action, residual_rad, observe, flat)

    def _declare_spaces(self, action: str, residual_rad: float, observe: Sequence[str] | None, flat: bool) -> None:
        """Set the action space and the observation space, and a name and a unit for every number in them."""
        robot = describe_run_robot(self.config)
        self.description = robot

        self._commands = Commands.of(robot, action, residual_rad)
        self.action_space = _make_box(self._commands.low, self._commands.high)
        self.action_names = list(self._commands.names)
        self.action_units = [self._commands.unit] * len(self.action_names)

        self.parts = select_parts(robot, observe)
        self.observation_names: list[str] = []
        self.observation_units: list[str] = []
        slices: dict[str, slice] = {}
        boxes: dict[str, spaces.Space[Any]] = {}
        for part_name, part in self.parts.items():
            start = len(self.observation_names)
            self.observation_names += [f"{part_name}.{name}" for name in part.names]
            self.observation_units += [part.unit] * len(part.names)
            slices[part_name] = slice(start, len(self.observation_names))
            boxes[part_name] = _make_box(part.low, part.high)
        if flat:
            observer = Observer(robot, self.parts)
            self.observation_space = spaces.Box(observer.low, observer.high)
            self._slices = None
        else:
            self.observation_space = spaces.Dict(boxes)
            self._slices = slices

    def __reduce__(self) -> Any:
        return _rebuild, (type(self), self._arguments, self.spec)

    def check_action(self, action: Any) -> None:
        """Check an action without a step.

        Args:
            action: (joints,) targets, tail to head, in the unit of `action_units`.

        Raises:
            ValueError: The action has another shape, or holds a number that is not finite.
        """
        self._commands.target(action)

    @property
    def digest(self) -> str:
        """Hash of every setpoint as applied in this episode: the same for the same seed and actions, to the bit."""
        return self._require_robot().digest

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationValues, dict[str, Any]]:
        """Start an episode: make the robot in its scene, and arm it.

        Args:
            seed: Seed of sensor noise and of random fields; None draws one from the environment's own generator.
            options: Not used.

        Returns:
            The first observation, and an info dict with `seed`, `time_s`, `advance_m` and `lifecycle`.

        Raises:
            ConfigError: The obstacles of this seed's random field find no place; with `seed=None`, those of
                MAX_FIELD_ATTEMPTS fields.
        """
        super().reset(seed=seed)
        self.close()
        robot = self._make_robot(seed)
        self._robot = robot
        self._observer = Observer(robot.description, self.parts)
        self._task = Task.from_config(self.config)
        self._ticks = 0
        self._ticks_left = round(self.config.duration_s * self.config.rate_hz)
        self._over = False
        observation = self._observe()
        return observation, {"seed": self.config.seed, **self._robot_info()}

    def step(self, action: Any) -> tuple[ObservationValues, float, bool, bool, dict[str, Any]]:
        """Command targets for `frame_skip` ticks, or until the robot is stopped or the time is over.

        Args:
            action: (joints,) targets, tail to head, in the unit of `action_units`.

        Returns:
            Observation, reward, terminated (goal reached, or stopped by a fault), truncated (time over), and an info
            dict with `time_s`, `advance_m`, `lifecycle`, `energy_j` and `reward_terms`. After the last step it also
            has `ended` ("goal", "stopped" or "time") and `digest`.

        Raises:
            gymnasium.error.ResetNeeded: The episode is over, or `reset` was never called.
            ValueError: The action has another shape, or holds a number that is not finite.
        """
        robot = self._require_robot()
        target = self._commands.target(action)
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or its last step did not finish; call reset()")
        self._over = True  # if an interrupt ends this step, some of its ticks are not counted
        start_m = self._observer.progress.along_m
        energy_j = 0.0
        limited = 0  # joints whose target the limiter changed, summed over ticks
        ticks = 0
        while ticks < min(self._frame_skip, self._ticks_left) and robot.lifecycle == "armed":
            robot.step(self._commands.mode, target)
            energy_j += _power_w(robot.joints) * self.config.period_ns * 1e-9
            limited += len(robot.limited)
            ticks += 1
        self._ticks += ticks
        self._ticks_left -= ticks

        observation = self._observe()
        progress = self._observer.progress
        stopped = robot.lifecycle != "armed"
        reached = progress.reached
        values = {
            "advance": progress.along_m - start_m,
            "energy": energy_j,
            "limited": limited / (max(ticks, 1) * len(target)),
            "goal": float(reached),
            "stopped": float(stopped),
        }
        terms = {name: self._weights[name] * value for name, value in values.items()}
        terminated = reached or stopped
        truncated = self._ticks_left == 0
        self._over = terminated or truncated
        info = {**self._robot_info(), "energy_j": energy_j, "reward_terms": terms}
        if self._over:
            info["ended"] = _name_ending(stopped=stopped, reached=reached)
            info["digest"] = robot.digest
        return observation, sum(terms.values()), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture of the robot in its scene, (height, width, 3), drawn as by `snakesim recording video`.

        Raises:
            gymnasium.error.ResetNeeded: There is no robot before the first `reset`, nor after `close`.
        """
        if self.render_mode is None:
            return None
        robot = self._require_robot()
        if self._film is None:
            make_film = find_plugin(FILMS, "mujoco")
            self._film = make_film(self.config, *self._picture_size)
        progress = self._observer.progress
        position_w, wxyz = (np.array(part) for part in progress.pose)
        look_at_w = np.array([*progress.center_w, progress.height_m])
        return self._film.picture(position_w, wxyz, np.array(robot.joints.angle_rad), look_at_w)

    def close(self) -> None:
        """Release the robot and the renderer."""
        robot = self._robot
        film = self._film
        self._robot = None
        self._film = None
        if robot is not None:
            robot.close()
        if film is not None:
            film.close()

    @property
    def _time_s(self) -> float:
        """Robot time since arming."""
        return self._ticks * self.config.period_ns * 1e-9

    def _require_robot(self) -> Robot:
        """Return the robot of this episode. Raises ResetNeeded when there is none."""
        if self._robot is None:
            raise gymnasium.error.ResetNeeded("there is no robot yet; call reset()")
        return self._robot

    def _make_robot(self, seed: int | None) -> Robot:
        """Return an armed robot in the scene of a seed, and set `config` to that scene.

        Without a seed, random fields without room for their obstacles are drawn again. Raises ConfigError.
        """
        given = seed if seed is not None and 0 <= seed <= MAX_SEED else None
        for attempts_left in reversed(range(MAX_FIELD_ATTEMPTS)):
            episode_seed = int(self.np_random.integers(MAX_SEED)) if given is None else given
            try:
                self.config = self._config_of_seed(episode_seed)
                if self._assisted:
                    return AssistedRobot(self.config)
                return SteppedRobot(self.config, safe=self._safe)
            except ConfigError:
                may_draw_again = given is None and self._new_field
                if not may_draw_again or not attempts_left:
                    raise
        raise AssertionError("the last attempt returns or raises")

    def _config_of_seed(self, seed: int) -> RunConfig:
        """Return the configuration of an episode."""
        new_fields = len(self._scenario_config.scene.random_field) if self._new_field else 0
        if not self._randomizations and not new_fields:
            return msgspec.structs.replace(self._scenario_config, seed=seed)  # faster than to load the scenario again
        field_keys = [f"scene.random_field.{i}.seed" for i in range(new_fields)]
        return self._load_config(seed, ["seed", *field_keys])

    def _load_config(self, seed: int, seed_keys: Sequence[str] = ()) -> RunConfig:
        """Load the scenario with the numbers that are drawn for a seed, and with the seed itself at `seed_keys`.

        Raises ConfigError.
        """
        overrides = [*self._overrides]
        overrides += [Override(key, seed, "seed") for key in seed_keys]
        for randomization in self._randomizations:
            overrides += randomization.overrides_for_scene(seed, "randomize")
        return load_checked(self._scenario, overrides, processes=False)

    def _observe(self) -> ObservationValues:
        """Return what a controller would observe at this tick."""
        robot = self._require_robot()
        observation = Observation(
            tick=robot.joints.tick,
            time_s=self._time_s,
            period_s=self.config.period_ns * 1e-9,
            joints=robot.joints,
            world=None,
            trajectory=None,
            sensor_samples=SensorSamples(robot.newest, {}, self._task),
        )
        values = self._observer.update(observation)
        if self._slices is None:
            return values
        return {name: values[part] for name, part in self._slices.items()}

    def _robot_info(self) -> dict[str, Any]:
        """Return the values of an info dict that describe the robot at this tick."""
        robot = self._require_robot()
        info: dict[str, Any] = {
            "time_s": self._time_s,
            "advance_m": self._observer.progress.along_m,
            "lifecycle": robot.lifecycle,
        }
        if robot.limited:
            info["limited"] = {self.action_names[joint]: why for joint, why in robot.limited.items()}
        if robot.lifecycle != "armed":
            info["reason"] = robot.reason
        return info


def _rebuild(env_class: type[SnakeEnv], arguments: dict[str, Any], spec: Any) -> SnakeEnv:
    """Return a new environment like the one that was pickled."""
    env = env_class(**arguments)
    env.spec = spec
    return env


def _name_ending(*, stopped: bool, reached: bool) -> str:
    """Return how an episode ended."""
    if stopped:
        return "stopped"
    if reached:
        return "goal"
    return "time"


def _make_box(low: Sequence[float], high: Sequence[float]) -> spaces.Box:
    return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))


def _power_w(joints: JointState) -> float:
    """Return the sum over joints of |torque x velocity| in W."""
    return sum(map(abs, map(mul, joints.torque_nm, joints.velocity_rad_s)))
