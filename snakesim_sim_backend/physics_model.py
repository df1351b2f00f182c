"""The simulated body for joint modules that are emulated elsewhere: MuJoCo without motors.

The firmware of the joint modules is not part of this model. It computes the torques of its motors, passes them in for
one physics step at a time, and reads its encoders, strain gauges and force sensors here.
"""

import msgspec
import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.robot_file.sensors import ImuSensor, PoseSensor
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.physics_model import LinkLoad, PhysicsModel
from snakesim_hal.wire.messages import Imu, Pose
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.model.build import FREE_DOFS, SimModel, build_sim_model, view_joint_states
from snakesim_sim_backend.model.tether import TetherRope
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.sensors.imu import ImuReader
from snakesim_sim_backend.sensors.pose import PoseReader
from snakesim_sim_backend.settings import PhysicsModelSettings, SimSettings
from snakesim_sim_backend.state.divergence import (
    MAX_ACCELERATION,
    DivergenceWatch,
    log_mujoco_warnings,
)
from snakesim_sim_backend.state.loads import LinkLoadReader
from snakesim_sim_backend.state.start import place_and_settle_robot

STEPS_PER_CHECK = 10  # the search for the cause of a divergence repeats them under the last torques
MAX_ACCELERATION_SQUARED = MAX_ACCELERATION**2
DISABLE_SENSORS_FLAG = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


class MujocoPhysicsModel(PhysicsModel):
    """The physics model on MuJoCo. Deterministic: the start and the torques decide every byte.

    Angles, velocities and the pose are present values. Loads, shaft torques and IMU readings are forces and
    accelerations, so they are those of the last step; before the first one, of the start.
    """

    Settings = PhysicsModelSettings

    def __init__(self, config: RunConfig, settings: PhysicsModelSettings) -> None:
        """Build the scene of a run without motors, and place the robot in it at rest, as `SimBackend` does.

        Emulated drives then move the robot by the torques that they compute.

        Args:
            config: Configuration of the run, with its robot and its scene.
            settings: Parameters of the physics.

        Raises:
            ConfigError: The settings do not match the robot or the scene.
        """
        log_mujoco_warnings()
        self._sim = build_sim_model(config, settings, motors=False)
        self._model = self._sim.model
        self._data = mujoco.MjData(self._model)
        self.step_s: float = self._model.opt.timestep
        self._data.qpos[:] = _compute_rest_coordinates(
            config, settings, yields=bool(self._sim.yielding)
        )
        self._physics = PhysicsStepper(self._sim, self._data)
        self._physics.reset()
        if settings.tether is not None:
            TetherRope(self._model, self._data, settings.tether).tighten()
        self._bind_mujoco_arrays(config)
        self._make_sensors(config)

        # Detection of divergence.
        self._step_count = 0
        # Steps since the last check of the whole state, which is made at the latest after STEPS_PER_CHECK.
        self._unchecked_steps = 0
        self._has_diverged = False
        self._divergence_watch = DivergenceWatch(
            self._model, self._data, self._physics, STEPS_PER_CHECK, "step"
        )

    def _bind_mujoco_arrays(self, config: RunConfig) -> None:
        """Make the views of MuJoCo's arrays that a step reads and writes."""
        data = self._data
        count = config.robot.chain.modules
        joints = slice(FREE_DOFS, FREE_DOFS + count)
        self._angles, self._velocities = view_joint_states(data, count)
        self._motor_torques = data.qfrc_applied[joints]
        self._viscous_torques = data.qfrc_damper[joints]
        self._all_accelerations = data.qacc
        self._joint_accelerations = data.qacc[joints]
        self._armature = self._model.dof_armature[joints]
        self._all_velocities = data.qvel
        self._velocities_before_step = data.qvel.copy()
        # MuJoCo lists equality constraints first, of which there are none, then the dry friction of joints.
        self._joints_with_friction = [
            i for i, joint in enumerate(config.robot.joint_table) if joint.motor.friction_nm > 0
        ]

    def _make_sensors(self, config: RunConfig) -> None:
        """Make the readers, and switch off what MuJoCo computes for IMUs: it costs more than all else; see `imu`."""
        self._loads = LinkLoadReader(self._sim, self._data, self._physics)
        self._pose = PoseReader(self._data, PoseSensor(), np.zeros)
        self._imu = None
        if config.robot.sensors.imu is not None:
            links = config.robot.chain.modules + 1
            self._imu = ImuReader(self._data, ImuSensor(), links, np.zeros)
        self._flags_with_sensors = int(self._model.opt.disableflags)
        self._flags_without_sensors = self._flags_with_sensors | DISABLE_SENSORS_FLAG
        self._model.opt.disableflags = self._flags_without_sensors

    def advance(self, torque_nm: Floats) -> None:
        """Make one physics step under the torques of the motors.

        Args:
            torque_nm: (n_joints,) torques during the step, tail to head.

        Raises:
            BackendError: The simulation has diverged, in this step or before. Its state is the last good one.
        """
        if self._has_diverged:
            # The watch raises the error of the divergence again, so nothing below runs.
            self._divergence_watch.check(self._step_count)
        self._motor_torques[:] = torque_nm
        self._velocities_before_step[:] = self._all_velocities
        self._step_count += 1
        try:
            self._physics.step(1)
        except mujoco.FatalError as error:
            # `_has_diverged` is for states that the watch has rejected. After this error, the next call steps again.
            raise BackendError(
                f"MuJoCo cannot go on at step {self._step_count}: {error}",
                code="simulator/diverged",
            ) from error
        self._unchecked_steps += 1
        # Divergence shows here first. It is detected in the same step, because firmware would read NaN otherwise.
        is_plausible = (
            self._all_accelerations.dot(self._all_accelerations) < MAX_ACCELERATION_SQUARED
        )
        if self._unchecked_steps == STEPS_PER_CHECK or not is_plausible:
            self._check_and_store_state()

    def _check_and_store_state(self) -> None:
        """Store a good state. If the simulation has diverged, restore the last good state and raise BackendError."""
        self._has_diverged = True
        try:
            self._divergence_watch.check(self._step_count)
        except BackendError:
            # Those of the state that the watch has restored.
            self._velocities_before_step[:] = self._all_velocities
            raise
        self._has_diverged = False
        self._unchecked_steps = 0

    @property
    def angle_rad(self) -> Floats:
        """Joint angles now, (n_joints,), tail to head; a view."""
        return self._angles

    @property
    def velocity_rad_s(self) -> Floats:
        """Joint velocities now, (n_joints,); a view."""
        return self._velocities

    def shaft_torque_nm(self) -> Floats:
        """Return the torque through each joint's shaft, (n_joints,), as a strain gauge measures it.

        The gauge is between the gear and the outer link. The rotor, seen through its gear, is between motor and gauge,
        and so is the friction inside the joint module:

            armature * acceleration = motor torque + viscous and dry friction - shaft torque

        So at rest it is the motor's torque minus dry friction, and in motion also minus the torque that accelerates the
        rotor. End stops act on the outer link, beyond the gauge: a motor that pushes against its stop is measured in
        full, a load on the stop is not.
        """
        torque_nm = self._motor_torques + self._viscous_torques
        torque_nm -= self._armature * self._joint_accelerations
        # MuJoCo lists dry friction as the first constraints, one for each joint that has some.
        friction_joints = self._joints_with_friction
        if friction_joints:
            torque_nm[friction_joints] += self._data.efc_force[: len(friction_joints)]
        return torque_nm

    def loads(self) -> list[LinkLoad]:
        """Return the resultant of the contacts of every link that obstacles push."""
        return self._loads.read()

    def imu(self) -> Imu | None:
        """Return angular velocity and specific force of every link, without noise; None for a robot without IMUs.

        Its timestamp is the time since the start.
        """
        if self._imu is None:
            return None
        # MuJoCo computes sensors from the velocities before a step, and from everything else of the step itself.
        velocities_now = self._all_velocities.copy()
        self._all_velocities[:] = self._velocities_before_step
        self._model.opt.disableflags = self._flags_with_sensors
        mujoco.mj_sensorVel(self._model, self._data)
        mujoco.mj_sensorAcc(self._model, self._data)
        self._model.opt.disableflags = self._flags_without_sensors
        self._all_velocities[:] = velocities_now
        return self._imu.read(0, self._timestamp_ns())

    def pose(self) -> Pose:
        """Return the base's pose and velocity, without noise. Its timestamp is the time since the start."""
        return self._pose.read(0, self._timestamp_ns())

    def _timestamp_ns(self) -> int:
        return round(self._data.time * 1e9)

    # --- for tests and benchmarks ---------------------------------------------------------------------------

    @property
    def sim(self) -> SimModel:
        """The compiled model."""
        return self._sim

    @property
    def physics(self) -> PhysicsStepper:
        """The physics steps, and the forces that MuJoCo does not compute."""
        return self._physics

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state."""
        return self._data


def _compute_rest_coordinates(
    config: RunConfig, settings: PhysicsModelSettings, *, yields: bool
) -> Floats:
    """Return the coordinates at which `SimBackend` comes to rest, (nq,): its motors hold the start angles until then.

    On rough ground they depend on the step by millimeters, so the step is the default one of `SimBackend`, unless
    obstacles that yield need a shorter one.
    """
    step_s = min(SimSettings().timestep_s, settings.contact_time_s / 2)
    if yields:
        step_s = min(step_s, settings.timestep_s)
    sim = build_sim_model(config, msgspec.structs.replace(settings, timestep_s=step_s))
    data = mujoco.MjData(sim.model)
    motors = ModelMotors(sim.model, data, config.robot, config.period_ns * 1e-9)
    place_and_settle_robot(sim, data, PhysicsStepper(sim, data), config, motors, settings.settle_s)
    return data.qpos
