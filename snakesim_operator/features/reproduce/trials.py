"""Runs configurations in worker processes, for the experiments."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_operator.base.worker_pool import WorkerPool
from snakesim_operator.features.reproduce.gait_motion import (
    GaitMotion,
    GroundFriction,
    measure_gait,
)
from snakesim_operator.results.metrics.intervals import compute_mean_interval
from snakesim_operator.run.in_process import simulate

SCENARIO = "scales"  # flat ground without obstacles
LINKS = 31  # of the chain that stands for a continuous body
SKIPPED_PERIODS = 2  # in which the body reaches its speed
MEASURED_PERIODS = 2
# Papers prescribe the shape of the body, so the servos are stiff. Velocities are differences of measured places, so the
# sensors have no noise.
CHAIN = (
    "robot=planar13",
    "robot.motor.stiffness_nm_per_rad=300",
    "robot.motor.damping_nm_s_per_rad=5",
    "robot.sensors.joints.angle_noise_rad=0",
    "robot.sensors.joints.velocity_noise_rad_s=0",
    "robot.sensors.joints.torque_noise_nm=0",
    "robot.sensors.pose.position_noise_m=0",
    "robot.sensors.pose.angle_noise_rad=0",
)


@dataclass(frozen=True, kw_only=True)
class GaitRun:
    """A run of a gait on flat ground."""

    settings: tuple[str, ...]  # as of `--set`
    period_s: float

    @cached_property
    def config(self) -> RunConfig:
        """Return the configuration."""
        duration_s = (SKIPPED_PERIODS + MEASURED_PERIODS) * self.period_s + 0.1
        return make_config(SCENARIO, (*CHAIN, *self.settings, f"duration_s={duration_s:g}"))

    @property
    def robot(self) -> RobotFile:
        """Return the robot."""
        return self.config.robot

    @property
    def friction(self) -> GroundFriction:
        """Return the friction of the ground."""
        return GroundFriction.from_config(self.config)


def make_serpenoid_run(
    winding_angle_rad: float,
    wavelength: float,
    period_s: float,
    friction: Sequence[str],
    module_count: int = LINKS - 1,
) -> GaitRun:
    """Return a run of Hirose's serpenoid curve without directional control.

    Args:
        winding_angle_rad: Angle between the axis of the curve and its steepest tangent.
        wavelength: Length of a wave in body lengths.
        period_s: Period of the wave.
        friction: Settings of the friction.
        module_count: Number of joints.
    """
    settings = (
        f"robot.chain.modules={module_count}",
        "controller=serpenoid",
        "control.k_theta=0",
        f"control.winding_angle_rad={winding_angle_rad:.6g}",
        f"control.wavelength={wavelength:.6g}",
        f"control.period_s={period_s:.6g}",
        *friction,
    )
    return GaitRun(settings=settings, period_s=period_s)


def set_viscous(along_s_per_m: float, across_s_per_m: float) -> tuple[str, ...]:
    """Return the settings of ground that rubs in proportion to speed only."""
    return (
        "scene.ground.friction=0",
        f"scene.ground.viscous.along_s_per_m={along_s_per_m:g}",
        f"scene.ground.viscous.across_s_per_m={across_s_per_m:g}",
    )


def set_skin(forward: float, backward: float, sideways: float) -> tuple[str, ...]:
    """Return the settings of dry friction that depends on direction."""
    return (
        f"robot.skin.forward={forward:.6g}",
        f"robot.skin.backward={backward:.6g}",
        f"robot.skin.sideways={sideways:.6g}",
        f"scene.ground.friction={sideways:.6g}",
    )


def make_config(scenario: str, settings: Sequence[str]) -> RunConfig:
    """Return the configuration of a shipped scenario with settings, as of `--set`."""
    return load_scenario(scenario, [parse_set_option(text) for text in settings]).config


def measure_gait_run(run: GaitRun) -> GaitMotion:
    """Run a gait, and measure its motion. Runs in a worker."""
    return measure_gait(simulate(run.config).record, run.period_s, SKIPPED_PERIODS)


class ExperimentTrials:
    """Runs the trials of experiments on workers of this computer."""

    def __init__(self, pool: WorkerPool, seeds: int, *, is_quick: bool = False) -> None:
        """Use a pool.

        Args:
            pool: Calls functions in worker processes.
            seeds: Number of seeds of experiments whose result depends on it.
            is_quick: Whether fewer and shorter runs are enough, for a test.
        """
        self._pool = pool
        self.seeds = seeds
        self.is_quick = is_quick

    def measure(self, runs: Sequence[GaitRun]) -> list[GaitMotion]:
        """Run gaits, and return their motions in the same order."""
        return self.call(measure_gait_run, [(run,) for run in runs])

    def call(self, function: Callable[..., Any], calls: Sequence[Sequence[Any]]) -> list[Any]:
        """Call a function of a module in workers, once for each tuple of arguments, and return the values in order."""
        return self._pool.run_and_collect(function, calls)


def find_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval of the mean over seeds; None for a single seed."""
    if len(values) < 2:
        return None
    return compute_mean_interval(values)
