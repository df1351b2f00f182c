"""The simulated body for joint modules that are emulated elsewhere: MuJoCo without motors.

The modules' firmware is not part of this model. It computes its motors' torques, passes them in for one physics step
at a time, and reads back its encoders, strain gauges and force sensors.
"""

import msgspec
import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.sensors import ImuSensor, PoseSensor
from snakesim_hal.physics.physics_model import LinkLoad
from snakesim_hal.wire.messages import Imu, Pose
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.divergence import MAX_ACCELERATION, DivergenceWatch, log_warnings
from snakesim_sim_backend.loads import LoadReader
from snakesim_sim_backend.model import FREE_DOFS, SimModel, build, of_joints
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.sensors.imu import ImuReader
from snakesim_sim_backend.sensors.pose import PoseReader
from snakesim_sim_backend.settings import PhysicsModelSettings, SimSettings
from snakesim_sim_backend.start import place_robot
from snakesim_sim_backend.tether import Rope

STEPS_PER_CHECK = 10  # the search for the cause repeats them under the last torques
MAX_SQUARED = MAX_ACCELERATION**2
NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


class MujocoPhysicsModel:
    """A `PhysicsModel` on MuJoCo. Deterministic: start and torques decide every byte.

    Angles, velocities and the pose are present values. Loads, shaft torques and IMU readings are forces and
    accelerations, so they are those of the last step; before the first one, of the start.
    """

    Settings = PhysicsModelSettings

    def __init__(self, config: RunConfig, settings: PhysicsModelSettings) -> None:
        """Lay the snake down as `SimBackend` does, at rest. Raises ConfigError."""
        log_warnings()
        self._sim = build(config, settings, motors=False)
        self._model, self._data = self._sim.model, mujoco.MjData(self._sim.model)
        model, data = self._model, self._data
        self.step_s: float = model.opt.timestep
        data.qpos[:] = _rest(config, settings, yields=bool(self._sim.yielding))
        self._physics = Physics(self._sim, data)
        self._physics.begin()
        if settings.tether is not None:
            Rope(model, data, settings.tether).tighten()
        count = config.robot.chain.modules
        hinges = slice(FREE_DOFS, FREE_DOFS + count)
        self._angles, self._velocities = of_joints(data, count)
        self._torques, self._passive = data.qfrc_applied[hinges], data.qfrc_damper[hinges]
        self._qacc, self._accelerations = data.qacc, data.qacc[hinges]
        self._armature = model.dof_armature[hinges]
        # Of all constraints MuJoCo lists equalities first, of which there are none, then the friction of the joints.
        self._rubbing = [i for i, joint in enumerate(config.robot.joint_table) if joint.motor.friction_nm > 0]
        self._speeds, self._speeds_before = data.qvel, data.qvel.copy()
        self._loads = LoadReader(self._sim, data, self._physics)
        self._pose = PoseReader(data, PoseSensor(), np.zeros)
        self._imu = None
        if config.robot.sensors.imu is not None:
            self._imu = ImuReader(data, ImuSensor(), count + 1, np.zeros)
        self._flags = int(model.opt.disableflags)
        model.opt.disableflags = self._flags | NO_SENSORS  # IMUs cost more than all else here; see `imu`
        self._steps, self._unchecked, self._diverged = 0, 0, False
        self._watch = DivergenceWatch(model, data, self._physics, STEPS_PER_CHECK, "step")

    def advance(self, torque_nm: Floats) -> None:
        """One physics step under these motor torques, (n_joints,).

        Raises BackendError when it has diverged, and from then on always; the last state known to be good stays.
        """
        if self._diverged:
            self._watch.check(self._steps)  # raises again
        self._torques[:] = torque_nm
        self._speeds_before[:] = self._speeds
        self._steps += 1
        try:
            self._physics.step(1)
        except mujoco.FatalError as error:
            raise BackendError(f"MuJoCo cannot go on at step {self._steps}: {error}") from error
        self._unchecked += 1
        # Divergence shows here first; it is detected in the same step, or firmware would read NaN.
        if self._unchecked == STEPS_PER_CHECK or not self._qacc.dot(self._qacc) < MAX_SQUARED:
            self._diverged = True
            try:
                self._watch.check(self._steps)
            except BackendError:
                self._speeds_before[:] = self._speeds  # those of the last good state, to which the watch has gone back
                raise
            self._diverged, self._unchecked = False, 0

    @property
    def angle_rad(self) -> Floats:
        """Joint angles now, (n_joints,), tail to head; a view."""
        return self._angles

    @property
    def velocity_rad_s(self) -> Floats:
        """Joint velocities now, (n_joints,); a view."""
        return self._velocities

    def shaft_torque_nm(self) -> Floats:
        """Torque through each joint's shaft, as measured by a strain gauge between gear and outer link, (n_joints,).

        The rotor, seen through its gear, is between motor and gauge, and so is the friction inside the module:

            armature * acceleration = motor torque + viscous and dry friction - shaft torque

        So at rest it is the motor's torque minus dry friction, and in motion also minus the torque that accelerates the
        rotor. End stops act on the outer link, beyond the gauge: a motor that pushes against its stop is measured in
        full, a load on the stop is not.
        """
        torque = self._torques + self._passive
        torque -= self._armature * self._accelerations
        if self._rubbing:
            torque[self._rubbing] += self._data.efc_force[: len(self._rubbing)]
        return torque

    def loads(self) -> list[LinkLoad]:
        """Resultant of the contacts of every link that obstacles push."""
        return self._loads.read()

    def imu(self) -> Imu | None:
        """Angular velocity and specific force of every link, without noise; None for a robot that has no IMUs.

        Its stamp is the time since the start.
        """
        if self._imu is None:
            return None
        model, data = self._model, self._data
        speeds = self._speeds.copy()
        self._speeds[:] = self._speeds_before  # all that MuJoCo computes sensors from, but these, is of the step made
        model.opt.disableflags = self._flags
        mujoco.mj_sensorVel(model, data)
        mujoco.mj_sensorAcc(model, data)
        model.opt.disableflags = self._flags | NO_SENSORS
        self._speeds[:] = speeds
        return self._imu.read(0, self._timestamp_ns())

    def pose(self) -> Pose:
        """Pose and velocity of the base, without noise. Its stamp is the time since the start."""
        return self._pose.read(0, self._timestamp_ns())

    def _timestamp_ns(self) -> int:
        return round(self._data.time * 1e9)

    # --- for tests and benchmarks ---------------------------------------------------------------------------

    @property
    def sim(self) -> SimModel:
        """The compiled model."""
        return self._sim

    @property
    def physics(self) -> Physics:
        """The steps, and the forces that MuJoCo does not compute."""
        return self._physics

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state."""
        return self._data


def _rest(config: RunConfig, settings: PhysicsModelSettings, *, yields: bool) -> Floats:
    """The rest pose of `SimBackend`, (nq,): motors are needed to hold the start angles until then.

    On rough ground it depends on the step by millimetres, so the step is the default one of `SimBackend`, unless
    obstacles that yield may need a shorter one.
    """
    step_s = min(SimSettings().timestep_s, settings.contact_time_s / 2)
    if yields:
        step_s = min(step_s, settings.timestep_s)
    sim = build(config, msgspec.structs.replace(settings, timestep_s=step_s))
    data = mujoco.MjData(sim.model)
    motors = Motors(sim.model, data, config.robot, config.period_ns * 1e-9)
    place_robot(sim, data, Physics(sim, data), config, motors, settings.settle_s)
    return data.qpos
