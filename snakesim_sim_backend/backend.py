"""The simulated robot behind the HAL: joins model, motors, sensors and physics, which have modules of their own."""

import math

import msgspec
import mujoco
import numpy as np

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.fault_plan import validate_faults_for_backend
from snakesim_hal.model.robot_file.robot import describe_robot
from snakesim_hal.model.scenario import RunConfig, compute_config_hash
from snakesim_hal.physics.motor import validate_position_gains
from snakesim_hal.physics.thermal import ThermalModel
from snakesim_hal.wire.messages import ClockMode, Fault, LifecycleState, RobotDescription
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_sim_backend.model.build import FREE_QPOS, SimModel, build_sim_model, view_joint_states
from snakesim_sim_backend.model.tether import TetherRope
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.sensors.registry import check_sensor_models
from snakesim_sim_backend.sensors.suite import SensorSuite
from snakesim_sim_backend.settings import SimSettings
from snakesim_sim_backend.state.contacts import ObstacleContactReader
from snakesim_sim_backend.state.divergence import MAX_SPEED, DivergenceWatch, log_mujoco_warnings
from snakesim_sim_backend.state.start import place_and_settle_robot
from snakesim_sim_backend.state.truth import TrueState

NAME = "sim"
CLOSED_MESSAGE = "the simulation is closed; open a new backend"
STATES_WITH_MOTORS_OFF: tuple[LifecycleState, ...] = ("disarmed", "estop")
DIVERGED_SPEED_M_S = 10.0 * MAX_SPEED  # of the base, when a divergence is injected


class SimBackend(Backend):
    """The backend on MuJoCo. Deterministic: seed and commands decide every byte."""

    Settings = SimSettings

    @classmethod
    def check(cls, config: RunConfig, settings: SimSettings) -> tuple[ClockMode, ...]:
        """Check that the simulator can run a configuration, before anything is started.

        Args:
            config: Configuration of the run.
            settings: Settings of the simulator, which are not needed here.

        Returns:
            The clock modes that the simulator supports, which are all of them.

        Raises:
            ConfigError: The simulator does not support a gain, a sensor or an injected fault of the run.
        """
        del settings
        validate_position_gains(config.robot)
        check_sensor_models(config.robot)
        supported_faults = ["diverge"]
        explanation = "the simulator has neither modules nor buses"
        if config.robot.sensors.power is not None:
            supported_faults.append("overheat")
        else:
            explanation += (
                ", and without [sensors.power] in the robot file heat would not be measured"
            )
        validate_faults_for_backend(
            config, supported_kinds=supported_faults, bus_count=0, reason=explanation
        )
        return ("lockstep", "realtime", "free")

    def __init__(
        self, config: RunConfig, settings: SimSettings, *, laws: LawsVersion | None = None
    ) -> None:
        """Build the scene, place the robot in it, and let it come to rest.

        Args:
            config: Configuration of the run, with its robot and its scene.
            settings: Parameters of the physics.
            laws: Version of the laws that computes ground and friction. None for the C version if it can be loaded.

        Raises:
            ConfigError: The settings do not match the robot or the scene.
        """
        description = describe_robot(
            config.robot,
            backend=NAME,
            period_ns=config.period_ns,
            lease_ns=config.lease_ns,
            config_hash=compute_config_hash(config),
            emulated=True,
            simulated_time=True,
        )
        log_mujoco_warnings()
        self._tick = 0
        self._open = True
        self._period_s = config.period_ns * 1e-9

        # Physics and motors, with the snake at rest.
        has_contact_sensor = config.robot.sensors.contacts is not None
        self._sim = build_sim_model(config, settings, laws=laws, measures_force=has_contact_sensor)
        self._description = msgspec.structs.replace(description, laws=self._sim.laws)
        model = self._sim.model
        self._data = mujoco.MjData(model)
        self._physics = PhysicsStepper(self._sim, self._data)
        self._motors = ModelMotors(
            model, self._data, config.robot, self._period_s, settings.motor_gain_scale
        )
        place_and_settle_robot(
            self._sim, self._data, self._physics, config, self._motors, settings.settle_s
        )
        self._tether_rope: TetherRope | None = None
        if settings.tether is not None:
            self._tether_rope = TetherRope(model, self._data, settings.tether)
            self._tether_rope.tighten()

        # Heat and sensors.
        self._simulates_heat = config.robot.sensors.power is not None
        self._windings = ThermalModel(config.robot.joint_table)
        self._sensors = SensorSuite(
            self._sim, self._data, config, self._motors, self._physics, self._windings
        )
        self._divergence_watch = DivergenceWatch(
            model, self._data, self._physics, self._sim.steps_per_tick
        )

        # IMUs cost time, and only their values in the last step of a tick are read.
        self._flags_with_sensors = int(model.opt.disableflags)
        self._flags_without_sensors = self._flags_with_sensors | int(
            mujoco.mjtDisableBit.mjDSBL_SENSOR
        )
        self._steps_without_sensors = 0
        if model.nsensor:
            self._steps_without_sensors = self._sim.steps_per_tick - 1
        self._steps_with_sensors = self._sim.steps_per_tick - self._steps_without_sensors
        self._option = model.opt

    def describe(self) -> RobotDescription:
        """Return the robot of the robot file."""
        return self._description

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the sensor samples of `tick`; after a divergence, those of the last good state."""
        if not self._open:
            raise BackendError(CLOSED_MESSAGE, code="backend/closed")
        return self._sensors.sample(tick, timestamp_ns)

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Give the motors new setpoints. While disarmed they are off, whatever the setpoints."""
        if lifecycle in STATES_WITH_MOTORS_OFF:
            self._motors.switch_off()
        else:
            self._motors.enact(setpoints)

    def advance(self) -> None:
        """Step the physics through one control period, check for divergence, and update the winding temperatures.

        Raises:
            BackendError: The simulation has diverged, or is closed.
        """
        if not self._open:
            raise BackendError(CLOSED_MESSAGE, code="backend/closed")
        self._motors.apply_pending_torque_limits()
        self._tick += 1
        try:
            if self._steps_without_sensors:
                self._option.disableflags = self._flags_without_sensors
                self._physics.step(self._steps_without_sensors)
                self._option.disableflags = self._flags_with_sensors
            self._physics.step(self._steps_with_sensors)
            self._divergence_watch.check(self._tick)
        except mujoco.FatalError as error:
            raise BackendError(
                f"MuJoCo cannot go on at tick {self._tick}: {error}", code="simulator/diverged"
            ) from error
        if self._simulates_heat:
            self._update_winding_temperatures()

    def _update_winding_temperatures(self) -> None:
        """Heat the windings for a control period by the torque of its last step, and derate hot joints."""
        self._windings.advance_temperatures(
            self._period_s, np.square(self._motors.get_applied_torque_nm())
        )
        remaining_fraction = self._windings.compute_remaining_fractions()
        if remaining_fraction is not None:
            self._motors.derate(remaining_fraction)

    def faults(self) -> list[Fault]:
        """Return faults for samples that came too late in real time; they stop nothing.

        A divergence is raised by `advance`.
        """
        if not self._sensors.dropped_counts:
            return []
        return [
            Fault(tick=self._tick, what="sample_late", cause=cause, scope="none")
            for cause in self._sensors.describe_dropped_samples()
        ]

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Begin or end an injected fault; return False for a fault that the simulator does not have.

        `diverge` makes the base impossibly fast, as in a divergence. `overheat` heats a winding.
        """
        match injection.target_type, injection.kind:
            case "joint", "overheat" if self._simulates_heat:
                hold = begins and injection.end_s != math.inf
                self._windings.inject_heat(injection.target_index, heat=begins, hold=hold)
                return True
            case "simulator", "diverge":
                if begins:
                    self._data.qvel[0] = DIVERGED_SPEED_M_S
                return True
            case _:
                return False

    def close(self) -> None:
        """Switch the motors off; nothing moves any more. `true_state` stays readable."""
        if self._open:
            self._motors.switch_off()
            self._sensors.close()
            self._open = False

    # --- for tests, benchmarks and reports; not available to GNC --------------------------------------------

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

    @property
    def tether_tension_n(self) -> float | None:
        """Force in the tether over the last physics step; None without a tether."""
        if self._tether_rope is None:
            return None
        return self._tether_rope.measure_tension_n()

    def true_state(self) -> TrueState:
        """Return the exact state, without noise, rate or delay."""
        data = self._data
        angles_rad, velocities_rad_s = view_joint_states(data, self._motors.count)
        return TrueState(
            time_s=data.time,
            base_position_w=data.qpos[:3].copy(),
            base_orientation_wxyz=data.qpos[3:FREE_QPOS].copy(),
            base_velocity_w=data.qvel[:3].copy(),
            angles_rad=angles_rad.copy(),
            velocities_rad_s=velocities_rad_s.copy(),
            torques_nm=self._motors.get_applied_torque_nm().copy(),
            contacts=list(ObstacleContactReader(self._sim, data, self._physics.contacts).read()),
        )
