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

from snakesim.configuration import checked, overrides_of
from snakesim.environments.actions import Commands, controller_of
from snakesim.environments.assisted import AssistedRobot
from snakesim.environments.rewards import weights_of
from snakesim.environments.stepped import SteppedRobot
from snakesim_gnc.control.controller import Senses, Task, View
from snakesim_gnc.control.observations import Observer, chosen
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.drawn import draws_of
from snakesim_hal.model.plugins import FILMS, find_plugin
from snakesim_hal.model.scenario import Override, RunConfig, description_of
from snakesim_hal.wire.messages import JointState

Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]
MAX_SEED = 2**31
Robot = SteppedRobot | AssistedRobot
FIELD_TRIES = 20  # random fields that do not fit, until a reset gives up


class SnakeEnv(gymnasium.Env[Any, Any]):
    """One robot in one scenario, stepped; see `docs/environments.md`.

    A pickle holds the arguments, and no robot: what is loaded from it needs a `reset`, as Gymnasium's own MuJoCo
    environments do.
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
        draw: Mapping[str, Sequence[float]] | None = None,
        new_field: bool = True,
        safe: bool = True,
        residual_rad: float = 0.2,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        """scenario: shipped name or path. action: "position", "velocity", "torque", or "residual:CONTROLLER".

        observe: parts of the observation, by name; flat: one vector of them, rather than a dict. reward: weights of
        terms. frame_skip: ticks of the robot in a step. duration: s of robot time until truncation. set: values by
        their dotted keys, as of `snakesim.run`. draw: keys whose number each seed has of its own, between two bounds.
        new_field: each reset draws the scene's random fields anew. safe: the limiter limits every command.
        residual_rad: bound of a correction. width, height: of pictures, in pixels.

        Raises ConfigError for wrong input, in the words of the command.
        """
        self._arguments = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        if scenario is None:
            raise ConfigError("SnakeSIM/Scenario-v0 needs scenario=..., a shipped name or the path of a file")
        if type(frame_skip) is not int or frame_skip < 1:
            raise ConfigError(f"frame_skip={frame_skip!r:.60}: give a whole number of ticks, 1 or more")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode={render_mode!r:.60}: give 'rgb_array', or leave it out")
        if not residual_rad > 0:
            raise ConfigError(f"residual_rad={residual_rad!r:.60}: give a number > 0, in rad")
        controller = controller_of(action)
        overrides = overrides_of(set, duration_s=duration)
        if controller is not None:
            if not safe:
                raise ConfigError(f"action={action!r}: a controller commands through the limiter; leave safe=False out")
            overrides.insert(0, Override("controller", controller, f"action={action}"))
        self._scenario, self._overrides, self._draws = os.fspath(scenario), overrides, draws_of(draw)
        self._scenario_config = self._drawn(0)
        self._assisted, self._safe, self._new_field = controller is not None, safe, new_field
        self._frame_skip, self._size, self.render_mode = frame_skip, (width, height), render_mode
        self._weights = weights_of(reward)
        self.config: RunConfig = self._scenario_config  # of this episode: `snakesim run` takes it, written to a file
        self.metadata = {**self.metadata, "render_fps": self.config.rate_hz / frame_skip}
        self._robot: Robot | None = None
        self._film: Any = None
        self._over = True
        self._declare(action, residual_rad, observe, flat)

    def _declare(self, action: str, residual_rad: float, observe: Sequence[str] | None, flat: bool) -> None:
        """The spaces, with a name and a unit for every number in them."""
        robot = self.description = description_of(self.config)
        self._commands = Commands.of(robot, action, residual_rad)
        self.action_space = _box(self._commands.low, self._commands.high)
        self.action_names = list(self._commands.names)
        self.action_units = [self._commands.unit] * len(self.action_names)
        self.parts = chosen(robot, observe)
        boxes: dict[str, spaces.Space[Any]] = {name: _box(part.low, part.high) for name, part in self.parts.items()}
        parts = self.parts.values()
        every = Observer(robot, self.parts)
        self.observation_space = spaces.Box(every.low, every.high) if flat else spaces.Dict(boxes)
        self.observation_names = [f"{part}.{name}" for part, of in self.parts.items() for name in of.names]
        self.observation_units = [of.unit for of in parts for _ in of.names]
        ends = np.cumsum([len(part.names) for part in parts]).tolist()
        self._slices = None if flat else dict(zip(self.parts, map(slice, [0, *ends], ends), strict=False))

    def __reduce__(self) -> Any:
        return _rebuild, (type(self), self._arguments, self.spec)

    def check_action(self, action: Any) -> None:
        """Raise the ValueError of `step` for what is no action of this environment."""
        self._commands.target(action)

    @property
    def digest(self) -> str:
        """Hash of every setpoint as applied in this episode: the same for the same seed and actions, to the bit."""
        return self._armed().digest

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Lay the robot down, and arm it. seed: of sensor noise, and of random fields; None draws the next."""
        super().reset(seed=seed)
        self.close()
        self._lay_down(seed)
        self._observer, self._task = Observer(self._armed().description, self.parts), Task.of(self.config)
        self._ticks, self._left = 0, round(self.config.duration_s * self.config.rate_hz)
        self._over = False
        observation = self._observe()
        return observation, {"seed": self.config.seed, **self._state()}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command these targets for `frame_skip` ticks, or until the robot is stopped or the time is over."""
        robot = self._armed()
        target = self._commands.target(action)
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or its last step did not finish; call reset()")
        self._over = True  # an interrupt would leave some ticks uncounted
        energy_j, limited, before_m, ticks = 0.0, 0, self._observer.progress.along_m, 0
        while ticks < min(self._frame_skip, self._left) and robot.lifecycle == "armed":
            robot.step(self._commands.mode, target)
            energy_j += _power_w(robot.joints) * self.config.period_ns * 1e-9
            limited += len(robot.limited)
            ticks += 1
        self._ticks, self._left = self._ticks + ticks, self._left - ticks
        observation = self._observe()
        progress = self._observer.progress
        stopped, reached = robot.lifecycle != "armed", progress.reached
        values = {
            "advance": progress.along_m - before_m,
            "energy": energy_j,
            "limited": limited / (max(ticks, 1) * len(target)),
            "goal": float(reached),
            "stopped": float(stopped),
        }
        terms = {name: self._weights[name] * value for name, value in values.items()}
        terminated, truncated = reached or stopped, self._left == 0
        info = {**self._state(), "energy_j": energy_j, "reward_terms": terms}
        self._over = terminated or truncated
        if self._over:
            info["ended"] = "stopped" if stopped else "goal" if reached else "time"
            info["digest"] = robot.digest
        return observation, sum(terms.values()), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture of the robot in its scene, (height, width, 3), drawn as by `snakesim video`.

        Raises:
            gymnasium.error.ResetNeeded: There is no robot before the first `reset`, nor after `close`.
        """
        if self.render_mode is None:
            return None
        robot = self._armed()
        if self._film is None:
            self._film = find_plugin(FILMS, "mujoco")(self.config, *self._size)
        progress = self._observer.progress
        position_w, wxyz = (np.array(part) for part in progress.pose)
        look_at_w = np.array([*progress.center_w, progress.height_m])
        return self._film.picture(position_w, wxyz, np.array(robot.joints.angle_rad), look_at_w)

    def close(self) -> None:
        """Release the robot and the renderer."""
        robot, self._robot, film, self._film = self._robot, None, self._film, None
        if robot is not None:
            robot.close()
        if film is not None:
            film.close()

    @property
    def _time_s(self) -> float:
        """Since the arming."""
        return self._ticks * self.config.period_ns * 1e-9

    def _armed(self) -> Robot:
        if self._robot is None:
            raise gymnasium.error.ResetNeeded("there is no robot yet; call reset()")
        return self._robot

    def _lay_down(self, seed: int | None) -> None:
        """A robot in the scene of a seed. Raises ConfigError when a field does not fit, after some that were drawn."""
        given = seed if seed is not None and 0 <= seed <= MAX_SEED else None
        for tries_left in reversed(range(FIELD_TRIES)):
            drawn = int(self.np_random.integers(MAX_SEED)) if given is None else given
            try:
                self.config = self._of_seed(drawn)
                self._robot = (
                    AssistedRobot(self.config) if self._assisted else SteppedRobot(self.config, safe=self._safe)
                )
                return
            except ConfigError:
                if given is not None or not tries_left or not self._new_field:
                    raise

    def _drawn(self, seed: int, seeds: Sequence[str] = ()) -> RunConfig:
        """The scenario with what is drawn for a seed, and with that seed at these keys. Raises ConfigError."""
        own = [Override(key, seed, "seed") for key in seeds]
        own += [override for draw in self._draws for override in draw.on_field(seed, "draw")]
        return checked(self._scenario, [*self._overrides, *own], processes=False)

    def _of_seed(self, seed: int) -> RunConfig:
        new_fields = len(self._scenario_config.scene.random_field) if self._new_field else 0
        if self._draws or new_fields:
            return self._drawn(seed, ["seed", *(f"scene.random_field.{i}.seed" for i in range(new_fields))])
        return msgspec.structs.replace(self._scenario_config, seed=seed)  # at once

    def _observe(self) -> Observation:
        """As a controller would see it at this tick."""
        robot = self._armed()
        view = View(
            tick=robot.joints.tick,
            time_s=self._time_s,
            period_s=self.config.period_ns * 1e-9,
            joints=robot.joints,
            world=None,
            trajectory=None,
            senses=Senses(robot.newest, {}, self._task),
        )
        flat = self._observer.update(view)
        if self._slices is None:
            return flat
        return {name: flat[where] for name, where in self._slices.items()}

    def _state(self) -> dict[str, Any]:
        """What of the robot is not in an observation."""
        robot = self._armed()
        info: dict[str, Any] = {
            "time_s": self._time_s,
            "advance_m": self._observer.progress.along_m,
            "lifecycle": robot.lifecycle,
        }
        if robot.limited:
            info["limited"] = {self.action_names[joint]: why for joint, why in robot.limited.items()}
        if robot.lifecycle != "armed":
            info["why"] = robot.why
        return info


def _rebuild(kind: type[SnakeEnv], arguments: dict[str, Any], spec: Any) -> SnakeEnv:
    """Return a new environment like the one that was pickled."""
    made = kind(**arguments)
    made.spec = spec
    return made


def _box(low: Sequence[float], high: Sequence[float]) -> spaces.Box:
    return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))


def _power_w(joints: JointState) -> float:
    """Sum over joints of |torque x velocity|."""
    return sum(map(abs, map(mul, joints.torque_nm, joints.velocity_rad_s)))
