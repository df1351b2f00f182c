"""Robots and scenes for the tests: small, noiseless, and changed in one place at a time."""

from typing import Any, TypeVar

import msgspec
from mujoco import MjData

from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.model.files import read_table_with_base
from snakesim_hal.model.scenario import RunConfig, validate_start_pose
from snakesim_hal.wire.messages import JointMode, Message
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.model.build import SimModel, build_sim_model, view_joint_states
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings

MessageT = TypeVar("MessageT", bound=Message)
G = 9.81
QUIET = {
    "joints": {},
    "contacts": {"rate_hz": 10000.0},
    "imu": {"rate_hz": 10000.0},
    "pose": {"rate_hz": 10000.0},
}


def merge_tables(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """`base` with the leaves of `change` put over it; a key `x!` replaces the whole of x."""
    result = dict(base)
    for key, value in change.items():
        if key.endswith("!"):
            result[key[:-1]] = value
        elif isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = merge_tables(result[key], value)
        else:
            result[key] = value
    return result


def make_config(
    robot: dict[str, Any] | None = None,
    scene: dict[str, Any] | None = None,
    *,
    base_robot: str = "planar13",
    **top: Any,
) -> RunConfig:
    """A run of a straight, noiseless robot at the origin, heading along x, on flat ground of friction 0.3."""
    quiet = merge_tables(read_table_with_base(base_robot, "robots").values, {"sensors!": QUIET})
    table = {
        "name": "test",
        "controller": "hold",
        "services": {},
        "start": {"on_route": False},
        "robot": merge_tables(quiet, robot or {}),
        "scene": merge_tables({"name": "test", "ground": {"friction": 0.3}}, scene or {}),
    }
    config = msgspec.convert(merge_tables(table, top), RunConfig)
    validate_start_pose(config)
    return config


def open_sim(config: RunConfig, **settings: Any) -> SimBackend:
    """A backend on that configuration."""
    return SimBackend(config, msgspec.convert(settings, SimSettings))


class SimulatorRig:
    """Drives a backend tick by tick, as the host does."""

    def __init__(self, config: RunConfig, **settings: Any) -> None:
        self.config = config
        self.sim = open_sim(config, **settings)
        self.count = config.robot.chain.modules
        self.tick = 0

    def command(
        self,
        mode: JointMode | list[JointMode],
        target: float | list[float] = 0.0,
        limit: float | None = None,
    ) -> None:
        """The same for all joints, or one each."""
        modes = mode if isinstance(mode, list) else [mode] * self.count
        targets = target if isinstance(target, list) else [float(target)] * self.count
        limits = [self.config.robot.limits.torque_nm if limit is None else limit] * self.count
        self.sim.enact(SafeSetpoints(modes, targets, limits), "armed")

    def sample(self) -> Samples:
        """The samples of the present tick."""
        return self.sim.sample(self.tick, self.tick * self.config.period_ns)

    def sample_only_sensor(self, kind: type[MessageT]) -> MessageT:
        """The message of the only sensor with such messages at the present tick."""
        (message,) = (
            message for message in self.sample().by_key.values() if isinstance(message, kind)
        )
        return message

    def advance(self, seconds: float = 0.0) -> None:
        """At least one tick."""
        for _ in range(max(round(seconds * 1e9 / self.config.period_ns), 1)):
            self.sim.advance()
            self.tick += 1


def make_resting_body(
    config: RunConfig, settings: SimSettings, angle_rad: float = 0.0
) -> tuple[SimModel, MjData, PhysicsStepper]:
    """A body without motors on the ground, every joint at this angle."""
    sim = build_sim_model(config, settings, motors=False)
    data = MjData(sim.model)
    data.qpos[2] = config.robot.module.radius_m
    view_joint_states(data, config.robot.chain.modules)[0][:] = angle_rad
    physics = PhysicsStepper(sim, data)
    physics.reset()
    return sim, data, physics
