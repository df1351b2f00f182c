"""Makes small simulated robots without noise, and drives their backend tick by tick."""

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
    """Return `base` with the values of `change`, merged table by table. A key `x!` replaces the whole of x."""
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
    """Return the configuration of a run with a straight robot without noise on flat ground with friction 0.3.

    The robot is at the origin, and its head points along x.

    Args:
        robot: Changes of the robot file, see `merge_tables`.
        scene: Changes of the scene.
        base_robot: Name of the shipped robot.
        **top: Changes of the scenario.
    """
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
    """Open the simulator with this configuration and these settings."""
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
        """Set the mode and the target of all joints, or a list with one for each joint, and the same torque limit."""
        modes = mode if isinstance(mode, list) else [mode] * self.count
        targets = target if isinstance(target, list) else [float(target)] * self.count
        limits = [self.config.robot.limits.torque_nm if limit is None else limit] * self.count
        self.sim.enact(SafeSetpoints(modes, targets, limits), "armed")

    def sample(self) -> Samples:
        """Return the samples of the current tick."""
        return self.sim.sample(self.tick, self.tick * self.config.period_ns)

    def sample_only_sensor(self, kind: type[MessageT]) -> MessageT:
        """Return the message of the only sensor with messages of this type at the current tick."""
        (message,) = (
            message for message in self.sample().by_key.values() if isinstance(message, kind)
        )
        return message

    def advance(self, seconds: float = 0.0) -> None:
        """Advance the simulator by a time, but at least by one tick."""
        for _ in range(max(round(seconds * 1e9 / self.config.period_ns), 1)):
            self.sim.advance()
            self.tick += 1


def make_resting_body(
    config: RunConfig, settings: SimSettings, angle_rad: float = 0.0
) -> tuple[SimModel, MjData, PhysicsStepper]:
    """Return a body without motors on the ground, whose joints are all at this angle."""
    sim = build_sim_model(config, settings, motors=False)
    data = MjData(sim.model)
    data.qpos[2] = config.robot.module.radius_m
    view_joint_states(data, config.robot.chain.modules)[0][:] = angle_rad
    physics = PhysicsStepper(sim, data)
    physics.reset()
    return sim, data, physics
