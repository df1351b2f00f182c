"""Measures the CPU time of a physics step with each law of the ground, for a snake that undulates."""

import statistics
import time
from typing import Any

import mujoco

from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS, build_sim_model
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import make_config
from snakesim_testing.sim.waves import SERVO_NM_PER_RAD, JointWave

WAVE = JointWave(0.3, 0.7, 4.0)
STEPS_PER_ROUND = 100
WARM_UP_STEPS = 100
STEPS_PER_TARGET = 5  # physics steps with the same torques
DAMPING_NM_S_PER_RAD = 10.0  # of the joints


class TimedSnake:
    """A snake on some ground, whose physics steps are timed."""

    def __init__(self, robot: dict[str, Any], scene: dict[str, Any], laws: LawsVersion) -> None:
        config = make_config(robot, scene)
        sim = build_sim_model(config, SimSettings(), motors=False, laws=laws)
        self._model = sim.model
        self._data = mujoco.MjData(sim.model)
        self._data.qpos[2] = config.robot.module.radius_m
        self._joint_count = config.robot.chain.modules
        self._physics = PhysicsStepper(sim, self._data)
        self._physics.reset()
        self._model.dof_damping[FREE_DOFS:] = DAMPING_NM_S_PER_RAD
        self._step_count = 0
        self._step(WARM_UP_STEPS)

    def measure_us(self) -> float:
        """Return the mean CPU time of the physics steps of one round, in microseconds."""
        return self._step(STEPS_PER_ROUND) / STEPS_PER_ROUND * 1e6

    def _step(self, step_count: int) -> float:
        """Make some steps, and return their CPU time in s, without that of the wave."""
        cpu_s = 0.0
        joints = slice(FREE_QPOS, FREE_QPOS + self._joint_count)
        for _ in range(0, step_count, STEPS_PER_TARGET):
            target_rad = WAVE.at(self._step_count * self._model.opt.timestep, self._joint_count)
            torques = SERVO_NM_PER_RAD * (target_rad - self._data.qpos[joints])
            self._data.qfrc_applied[FREE_DOFS : FREE_DOFS + self._joint_count] = torques
            start_s = time.thread_time()
            self._physics.step(STEPS_PER_TARGET)
            cpu_s += time.thread_time() - start_s
            self._step_count += STEPS_PER_TARGET
        return cpu_s


def measure_medians_us(
    cases: dict[str, tuple[dict[str, Any], dict[str, Any]]], round_count: int
) -> dict[str, dict[LawsVersion, float]]:
    """Return the median CPU time of a step in microseconds, for each case and each version of the laws.

    All cases and versions run in every round, so that a busy machine affects them equally.

    Args:
        cases: Settings of the robot and of the scene, by the name of the case.
        round_count: Number of rounds.
    """
    versions: tuple[LawsVersion, ...] = ("c", "python")
    snakes: dict[tuple[str, LawsVersion], TimedSnake] = {
        (name, version): TimedSnake(robot, scene, version)
        for name, (robot, scene) in cases.items()
        for version in versions
    }
    times_us: dict[tuple[str, LawsVersion], list[float]] = {key: [] for key in snakes}
    for _ in range(round_count):
        for key, snake in snakes.items():
            times_us[key].append(snake.measure_us())
    return {
        name: {version: statistics.median(times_us[name, version]) for version in versions}
        for name in cases
    }
