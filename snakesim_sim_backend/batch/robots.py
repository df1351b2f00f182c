"""Many simulated robots: models, motors, heat and sensors, as rows of arrays."""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import JointMode, JointState, Power
from snakesim_sim_backend.actuators import INPUT_INDEX_BY_MODE, INPUTS_PER_MOTOR
from snakesim_sim_backend.batch.batched import BatchedSimulations
from snakesim_sim_backend.batch.heat import HeatArrays
from snakesim_sim_backend.batch.noise import NoiseStreams
from snakesim_sim_backend.batch.placed import create_settled_robot
from snakesim_sim_backend.batch.samples import Mask, Ticks
from snakesim_sim_backend.batch.sensors import SensorArrays, encode_sensor_timing
from snakesim_sim_backend.batch.simulations import LoopedSimulations, SimulationBatch
from snakesim_sim_backend.laws.version import choose_laws


def _open_simulations(robot_count: int, joint_count: int, thread_count: int) -> SimulationBatch:
    """Return a batch of simulations, or a loop over one or where the laws run in Python."""
    if robot_count == 1 or choose_laws() == "python":
        return LoopedSimulations(robot_count, joint_count)
    return BatchedSimulations(robot_count, joint_count, thread_count)


class SimulatedRobots:
    """Robots with equal joints and sensors, each in a scene of its own, without a limiter.

    Once in every tick: `enact` and `enact_one`, `advance`, `sample`, as with a backend.

    Attributes:
        sensors: Sensors of all robots, with their newest samples.
        all_robots: The mask of all robots. A call with this object is faster than one with an equal mask.
    """

    def __init__(self, robot_count: int, config: RunConfig, *, thread_count: int) -> None:
        """Allocate the simulations, motors and sensors of many robots; each is placed in its scene later.

        Args:
            robot_count: Number of robots.
            config: Configuration of one robot. Those of the other robots have the same joints and sensors.
            thread_count: Number of threads that step the simulations.
        """
        joints = config.robot.chain.modules
        self._period_ns = config.period_ns
        self._joints = joints
        self._timing = encode_sensor_timing(config)
        self._models_winding_temperature = config.robot.sensors.power is not None
        self._simulations = _open_simulations(robot_count, joints, thread_count)
        self.all_robots: Mask = np.ones(robot_count, dtype=np.bool_)
        self._noise = NoiseStreams(self.all_robots)
        self._heat = HeatArrays(robot_count, joints, config.period_ns * 1e-9)
        self.sensors = SensorArrays(self.all_robots, config, self._noise)

        # Motors.
        self._min_torque_nm = np.zeros((robot_count, joints))
        self._max_torque_nm = np.zeros((robot_count, joints))
        self._torque_limit_nm = np.zeros((robot_count, joints))  # of the last setpoints
        self._last_limit_nm: Floats | None = None  # the same array in many ticks
        # Robots whose torque limits have not reached their new values yet.
        self._robots_with_pending_limits = set[int]()
        # Supply voltages in V and idle currents in A of the joints, for each robot.
        self._supplies: list[tuple[list[float], list[float]]] = [([], [])] * robot_count

    def can_simulate(self, config: RunConfig) -> bool:
        """Return whether a robot of this configuration can be a row."""
        return encode_sensor_timing(config) == self._timing

    def load_robot(self, robot_index: int, config: RunConfig) -> bool:
        """Replace the simulation of a row by a robot at the start of an episode, and read its sensors at tick 0.

        Args:
            robot_index: Row of the robot.
            config: Configuration of the episode.

        Returns:
            False if the arrays of the new simulation have other sizes than those of the other rows. Then nothing is
            changed.

        Raises:
            ConfigError: The settings do not match the robot or the scene.
        """
        placed = create_settled_robot(config)
        if not self._simulations.load(robot_index, placed):
            return False
        joint_table = config.robot.joint_table
        self._heat.restart(robot_index, joint_table)
        self._noise.restart(robot_index, config.seed)
        self.sensors.restart(robot_index, config)
        self._supplies[robot_index] = (
            [joint.supply.voltage_v for joint in joint_table],
            [joint.supply.idle_a for joint in joint_table],
        )
        self._robots_with_pending_limits.discard(robot_index)
        self._read_motor_range(robot_index)
        self._torque_limit_nm[robot_index] = [joint.limits.torque_nm for joint in joint_table]
        self._last_limit_nm = None
        robot_count = len(self._supplies)
        is_loaded_robot = np.zeros(robot_count, dtype=np.bool_)
        is_loaded_robot[robot_index] = True
        ticks = np.zeros(robot_count, dtype=np.int64)  # an episode starts at tick 0
        self.sensors.sample(
            ticks, is_loaded_robot, self._simulations, self._heat.winding_c, is_reset=True
        )
        return True

    def enact(self, mode: JointMode, target: Floats, torque_limit_nm: Floats, robots: Mask) -> None:
        """Set new targets and torque limits of the motors of some robots, in the mode that their motors have already.

        Args:
            mode: Mode of all joints.
            target: (robots, joints) targets in rad, rad/s or N·m, depending on the mode.
            torque_limit_nm: (robots, joints) torque limits.
            robots: (robots,) mask of the robots that get new targets.
        """
        inputs = self._simulations.motor_inputs[:, INPUT_INDEX_BY_MODE[mode] :: INPUTS_PER_MOTOR]
        if robots is self.all_robots:  # the usual case, which is faster without a mask
            inputs[:] = target
        else:
            np.copyto(inputs, target, where=robots[:, None])
        if torque_limit_nm is self._last_limit_nm:
            return  # the usual case: the same array as in the last tick
        self._last_limit_nm = torque_limit_nm
        is_changed = torque_limit_nm != self._torque_limit_nm
        for robot in np.flatnonzero(is_changed.any(axis=1) & robots).tolist():
            modes = [mode] * self._joints
            self._simulations.motors[robot].set_inputs(
                modes, target[robot].tolist(), torque_limit_nm[robot].tolist()
            )
            self._torque_limit_nm[robot] = torque_limit_nm[robot]
            self._robots_with_pending_limits.add(robot)

    def enact_one(self, robot_index: int, setpoints: SafeSetpoints) -> None:
        """Set the mode, target and torque limit of each motor of one robot."""
        self._simulations.motors[robot_index].enact(setpoints)
        self._torque_limit_nm[robot_index] = setpoints.torque_limit_nm
        self._last_limit_nm = None
        self._robots_with_pending_limits.add(robot_index)

    def advance(self, robots: Sequence[int], ticks: Sequence[int]) -> dict[int, str]:
        """Step the physics of some robots through one control period.

        Args:
            robots: Indices of the robots, which are their rows in all arrays.
            ticks: Control tick of each robot at the end of this step; used only in error messages.

        Returns:
            The reason of the divergence by row, for each simulation that has diverged.
        """
        simulations = self._simulations
        if self._robots_with_pending_limits:
            self._apply_pending_limits()
        has_motor_dynamics = simulations.motor_state.shape[1] > 0
        if has_motor_dynamics:
            # The motor state (MuJoCo's activation) is the torque. Clamp it to limits that have decreased, as
            # `ModelMotors.apply_pending_torque_limits` does.
            motor_state = simulations.motor_state
            np.minimum(motor_state, self._max_torque_nm, out=motor_state)
            np.maximum(motor_state, self._min_torque_nm, out=motor_state)
        divergence_reasons = simulations.step(robots, ticks)
        if self._models_winding_temperature:
            self._update_winding_temperatures()
        return divergence_reasons

    def sample(self, ticks: Ticks, active: Mask) -> None:
        """Read the sensors of the active robots at their current ticks."""
        self.sensors.sample(ticks, active, self._simulations, self._heat.winding_c)

    def remaining_fractions(self) -> Floats:
        """Return the fraction of each torque limit that derating leaves at the measured temperatures.

        Returns:
            (robots, joints) fractions from 0 to 1.
        """
        assert self.sensors.windings is not None
        return self._heat.remaining_fractions(self.sensors.windings.values)

    def make_joint_state(self, robot_index: int, tick: int, joints_of_robot: Floats) -> JointState:
        """Return the joint states of one robot as the message that a backend would send.

        Args:
            robot_index: Row of the robot.
            tick: Number of the control cycle in which the states were delivered.
            joints_of_robot: (3 * joints,) angles in rad, velocities in rad/s and torques in N·m.
        """
        joint_count = self._joints
        values = joints_of_robot.tolist()
        # At first the reading of the start is used.
        age_ticks = min(tick, self.sensors.joint_delay_ticks)
        return JointState(
            tick=tick,
            timestamp_ns=tick * self._period_ns,
            angle_rad=values[:joint_count],
            velocity_rad_s=values[joint_count : 2 * joint_count],
            torque_nm=values[2 * joint_count :],
            valid=[True] * joint_count,
            age_ns=[age_ticks * self._period_ns] * joint_count,
        )

    def make_power(self, robot_index: int, tick: int) -> Power | None:
        """Return the newest power sample of one robot as a message, or None before the first sample.

        Only the values that a limiter reads are exact. The currents are those of idle joints, and the boards have the
        temperatures of the windings.

        Args:
            robot_index: Row of the robot.
            tick: Number of the control cycle in which the sample was delivered.
        """
        windings = self.sensors.windings
        if windings is None or not windings.is_known[robot_index]:
            return None
        voltage_v, idle_a = self._supplies[robot_index]
        winding_temperatures_c = windings.values[robot_index].tolist()
        return Power(
            tick=tick,
            timestamp_ns=tick * self._period_ns,
            voltage_v=voltage_v,
            current_a=idle_a,
            motor_c=winding_temperatures_c,
            board_c=winding_temperatures_c,
            leak=[False] * self._joints,
            valid=[True] * self._joints,
        )

    def _apply_pending_limits(self) -> None:
        """Lower the torque limits of robots with new limits as fast as their motors can follow."""
        motors = self._simulations.motors
        for robot in self._robots_with_pending_limits:
            motors[robot].apply_pending_torque_limits()
            self._read_motor_range(robot)
        self._robots_with_pending_limits = {
            robot for robot in self._robots_with_pending_limits if motors[robot].is_limit_changing
        }

    def _update_winding_temperatures(self) -> None:
        """Heat the windings for a control period by the torque of its last step, and derate hot joints."""
        heat = self._heat
        heat.advance_period(self._simulations.torque_nm)
        changed = heat.find_robots_to_derate()
        if not changed:
            return
        fractions = heat.remaining_fractions(heat.winding_c)
        for robot in changed:
            self._simulations.motors[robot].derate(fractions[robot])
            self._robots_with_pending_limits.add(robot)

    def _read_motor_range(self, robot_index: int) -> None:
        """Read the torque range of the motors of one robot from its model."""
        low_nm, high_nm = self._simulations.motors[robot_index].torque_range_nm
        self._min_torque_nm[robot_index] = low_nm
        self._max_torque_nm[robot_index] = high_nm
