"""Simulates snakes whose joints follow a wave on flat ground, with MuJoCo and with a momentum balance."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_operator.features.reproduce.gait_motion import GroundFriction, find_friction_per_load
from snakesim_operator.features.reproduce.planar_chain import PlanarChain
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS, SimModel, build_sim_model
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import make_config

SERVO_NM_PER_RAD = 300.0
SERVO_NM_S_PER_RAD = 10.0
PERIODS = 6
SKIPPED_PERIODS = 2  # at the start
# In the momentum balance, friction decreases toward 0 below this sliding speed.
SMOOTHING_SPEED_M_S = 0.002
BALANCE_STEP_S = 0.0005


@dataclass(frozen=True)
class JointWave:
    """Joint angles amplitude * sin(rate t + phase i) + bend, with i counted from the middle of the body."""

    amplitude: float = 0.5  # rad
    phase: float = 0.9  # rad
    rate: float = float(np.pi)  # rad/s
    bend: float = 0.0  # rad

    def at(self, time_s: float, count: int) -> Floats:
        """Return the angles of all joints in rad, (count,)."""
        places = np.arange(count) - 0.5 * (count - 1)
        return self.amplitude * np.sin(self.rate * time_s + self.phase * places) + self.bend

    def rates_at(self, time_s: float, count: int) -> Floats:
        """Return the velocities of all joints in rad/s, (count,)."""
        places = np.arange(count) - 0.5 * (count - 1)
        return self.amplitude * self.rate * np.cos(self.rate * time_s + self.phase * places)

    @property
    def reversed(self) -> "JointWave":
        """Return the wave of a body whose head and tail are exchanged."""
        return JointWave(self.amplitude, -self.phase, self.rate, self.bend)

    @property
    def period_s(self) -> float:
        """Return the period of the wave in s."""
        return 2 * np.pi / self.rate


@dataclass(frozen=True)
class BodyTrack:
    """Center of mass and vector from tail to head at the end of every step, (steps, 2) in m."""

    center: Floats
    axis: Floats
    step_s: float
    period_s: float

    @property
    def drift_mm_s(self) -> float:
        """Return the mean speed of the center along the mean axis of each period."""
        steps_per_period = round(self.period_s / self.step_s)
        period_drifts_mm_s: list[float] = []
        for k in range(SKIPPED_PERIODS, PERIODS - 1):
            axis = self.axis[k * steps_per_period : (k + 1) * steps_per_period].mean(axis=0)
            displacement_m = (
                self.center[(k + 1) * steps_per_period] - self.center[k * steps_per_period]
            )
            period_drifts_mm_s.append(
                float(displacement_m @ axis / np.linalg.norm(axis)) / self.period_s * 1e3
            )
        return float(np.mean(period_drifts_mm_s))


def simulate_wave(
    wave: JointWave,
    ground: dict[str, Any],
    robot: dict[str, Any] | None = None,
    *,
    step_s: float = 0.002,
    yaw_rad: float = 0.0,
) -> BodyTrack:
    """Simulate `planar13` on flat ground with MuJoCo, with joints that follow a wave by stiff servos.

    Args:
        wave: Joint angles as a function of time.
        ground: Section `[ground]` of the scene.
        robot: Differences from `planar13`, as in a robot file.
        step_s: Physics step.
        yaw_rad: Heading at the start.

    Returns:
        The motion of the body over PERIODS periods of the wave.
    """
    config = make_config(robot, {"ground": ground})
    sim = build_sim_model(config, SimSettings(timestep_s=step_s), motors=False)
    data = mujoco.MjData(sim.model)
    data.qpos[2] = config.robot.module.radius_m
    data.qpos[3] = np.cos(yaw_rad / 2)
    data.qpos[6] = np.sin(yaw_rad / 2)
    return follow_wave(sim, data, PhysicsStepper(sim, data), wave)


def follow_wave(
    sim: SimModel,
    data: mujoco.MjData,
    physics: PhysicsStepper,
    wave: JointWave,
    stiffness: float = 1.0,
) -> BodyTrack:
    """Let the joints of a snake follow a wave by stiff servos.

    Args:
        sim: Model of the snake, without motors.
        data: Its state, with the pose of the base at the start.
        physics: Advances this state.
        wave: Joint angles as a function of time.
        stiffness: Factor of stiffness and damping of the servos.

    Returns:
        The motion of the body over PERIODS periods of the wave.
    """
    model = sim.model
    assert sim.feet is not None
    servo_nm_per_rad = stiffness * SERVO_NM_PER_RAD
    servo_nm_s_per_rad = stiffness * SERVO_NM_S_PER_RAD
    joint_count = model.nv - FREE_DOFS
    model.dof_damping[FREE_DOFS:] = servo_nm_s_per_rad
    model.dof_frictionloss[FREE_DOFS:] = 0.0
    data.qpos[FREE_QPOS:] = wave.at(0.0, joint_count)
    physics.reset()
    step_s = model.opt.timestep
    tail, head = sim.feet.geoms[[0, -1]]
    step_count = int(PERIODS * wave.period_s / step_s) + 1
    center_m = np.empty((step_count, 2))
    axis_m = np.empty((step_count, 2))
    for k in range(step_count):
        end_time_s = (k + 1) * step_s
        position_torques_nm = servo_nm_per_rad * (
            wave.at(end_time_s, joint_count) - data.qpos[FREE_QPOS:]
        )
        data.qfrc_applied[FREE_DOFS:] = position_torques_nm + servo_nm_s_per_rad * wave.rates_at(
            end_time_s, joint_count
        )
        physics.step(1)
        center_m[k] = data.subtree_com[sim.first_link_body, :2]
        axis_m[k] = (data.geom_xpos[head] - data.geom_xpos[tail])[:2]
    return BodyTrack(center_m, axis_m, step_s, wave.period_s)


def integrate_momentum_balance(
    wave: JointWave,
    coefficients: DirectionalFriction,
    viscous_s_per_m: complex = 0.0,
    step_s: float = BALANCE_STEP_S,
    *,
    in_the_middle: bool = False,
    separate_limits: bool = False,
) -> BodyTrack:
    """Compute the motion of `planar13` without MuJoCo, by a momentum balance in the plane with prescribed joint angles.

    Friction is smoothed below SMOOTHING_SPEED_M_S.

    Args:
        wave: Joint angles as a function of time.
        coefficients: Coefficients of dry friction, by the direction of sliding.
        viscous_s_per_m: Viscous friction over the normal force: along the link, and as imaginary part across it.
        step_s: Step of the integrator.
        in_the_middle: Whether the ground contacts are in the middle of each link, as those of wheels there.
        separate_limits: Whether friction along the link and across it do not limit each other, as with rolling wheels.

    Returns:
        The motion of the body over PERIODS periods of the wave.
    """
    friction = GroundFriction(coefficients, viscous_s_per_m.real, viscous_s_per_m.imag)

    def find_friction(slips: NDArray[np.complex128]) -> NDArray[np.complex128]:
        if separate_limits:
            along = find_friction_per_load(
                slips.real.astype(np.complex128), friction, SMOOTHING_SPEED_M_S
            )
            across = find_friction_per_load(
                (1j * slips.imag).astype(np.complex128), friction, SMOOTHING_SPEED_M_S
            )
            return along + across
        return find_friction_per_load(slips, friction, SMOOTHING_SPEED_M_S)

    robot = make_config().robot
    joint_count = len(robot.link_lengths_m) - 1
    chain = PlanarChain(robot, has_middle_contacts=in_the_middle)
    step_count = int(PERIODS * wave.period_s / step_s) + 1
    center_m = np.empty((step_count, 2))
    axis_m = np.empty((step_count, 2))
    for k in range(step_count):
        time_s = k * step_s
        angles_rad = wave.at(time_s, joint_count)
        rates_rad_s = wave.rates_at(time_s, joint_count)
        instant = chain.advance(angles_rad, rates_rad_s, find_friction, step_s)
        center_m[k] = instant.center.real, instant.center.imag
        axis_m[k] = instant.axis.real, instant.axis.imag
    return BodyTrack(center_m, axis_m, step_s, wave.period_s)
