"""Many simulated robots: models, motors, heat and sensors, as rows of arrays."""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import JointState, Mode, Power
from snakesim_sim_backend.actuators import INPUT_OF_MODE, INPUTS
from snakesim_sim_backend.batch.batched import BatchedSimulations
from snakesim_sim_backend.batch.heat import HeatArrays
from snakesim_sim_backend.batch.noise import NoiseStreams
from snakesim_sim_backend.batch.placed import place
from snakesim_sim_backend.batch.samples import Mask, Ticks
from snakesim_sim_backend.batch.sensors import SensorArrays, describe_timing
from snakesim_sim_backend.batch.simulations import LoopedSimulations, Simulations
from snakesim_sim_backend.laws.version import choose_laws


def _open_simulations(robots: int, joints: int, threads: int) -> Simulations:
    """Return a batch of simulations, or a loop over one or where the laws run in Python."""
    if robots == 1 or choose_laws() == "python":
        return LoopedSimulations(robots, joints)
    return BatchedSimulations(robots, joints, threads)


class SimulatedRobots:
    """Robots with equal joints and sensors, each in a scene of its own, without a limiter.

    Once in every tick: `enact` and `enact_one`, `advance`, `sample`, as with a backend.

    Attributes:
        sensors: what the robots measure.
        all_robots: the mask of all robots. A call with this object is faster than one with an equal mask.
    """

    def __init__(self, robots: int, config: RunConfig, *, threads: int) -> None:
        """Allocate the simulations, motors and sensors of many robots; each is placed in its scene later.

        Args:
            robots: number of robots.
            config: configuration of one of them; those of the others agree with it in joints and sensors.
            threads: number of threads that step the simulations.
        """
        joints = config.robot.chain.modules
        self._period_ns = config.period_ns
        self._joints = joints
        self._timing = describe_timing(config)
        self._has_heat = config.robot.sensors.power is not None
        self._simulations = _open_simulations(robots, joints, threads)
        self.all_robots: Mask = np.ones(robots, dtype=np.bool_)
        self._noise = NoiseStreams(self.all_robots)
        self._heat = HeatArrays(robots, joints, config.period_ns * 1e-9)
        self.sensors = SensorArrays(self.all_robots, config, self._noise)

        # Motors.
        self._min_torque_nm = np.zeros((robots, joints))
        self._max_torque_nm = np.zeros((robots, joints))
        self._torque_limit_nm = np.zeros((robots, joints))  # of the last setpoints
        self._last_limit_nm: Floats | None = None  # the same array in many ticks
        self._changing = set[int]()  # robots whose torque limits have not reached their new values yet
        self._supplies: list[tuple[list[float], list[float]]] = [([], [])] * robots  # voltage and idle current

    def can_simulate(self, config: RunConfig) -> bool:
        """Return whether a robot of this configuration can be a row."""
        return describe_timing(config) == self._timing

    def place(self, robot: int, config: RunConfig) -> bool:
        """Put a robot at the start of an episode in a row, and read its sensors at tick 0.

        Args:
            robot: row of the robot, whose former simulation is replaced.
            config: configuration of the episode.

        Returns:
            False if its simulation does not fit to the others.

        Raises:
            ConfigError: the settings do not match the robot or the scene.
        """
        placed = place(config)
        if not self._simulations.load(robot, placed):
            return False
        joint_table = config.robot.joint_table
        self._heat.restart(robot, joint_table)
        self._noise.restart(robot, config.seed)
        self.sensors.restart(robot, config)
        self._supplies[robot] = (
            [joint.supply.voltage_v for joint in joint_table],
            [joint.supply.idle_a for joint in joint_table],
        )
        self._changing.discard(robot)
        self._read_motor_range(robot)
        self._torque_limit_nm[robot] = [joint.limits.torque_nm for joint in joint_table]
        self._last_limit_nm = None
        only_this = np.zeros(len(self._supplies), dtype=np.bool_)
        only_this[robot] = True
        ticks = np.zeros(len(self._supplies), dtype=np.int64)
        self.sensors.sample(ticks, only_this, self._simulations, self._heat.winding_c, starts=True)
        return True

    def enact(self, mode: Mode, target: Floats, torque_limit_nm: Floats, robots: Mask) -> None:
        """Give the motors of robots new targets in the mode that they have already.

        Args:
            mode: mode of all joints.
            target: (robots, joints) targets in rad, rad/s or N·m.
            torque_limit_nm: (robots, joints) torque limits.
            robots: (robots,) which robots get new targets.
        """
        inputs = self._simulations.motor_inputs[:, INPUT_OF_MODE[mode] :: INPUTS]
        if robots is self.all_robots:
            inputs[:] = target
        else:
            np.copyto(inputs, target, where=robots[:, None])
        if torque_limit_nm is self._last_limit_nm:
            return
        self._last_limit_nm = torque_limit_nm
        is_changed = torque_limit_nm != self._torque_limit_nm
        for robot in np.flatnonzero(is_changed.any(axis=1) & robots).tolist():
            modes = [mode] * self._joints
            self._simulations.motors[robot].drive(modes, target[robot].tolist(), torque_limit_nm[robot].tolist())
            self._torque_limit_nm[robot] = torque_limit_nm[robot]
            self._changing.add(robot)

    def enact_one(self, robot: int, setpoints: SafeSetpoints) -> None:
        """Give the motors of one robot any setpoints."""
        self._simulations.motors[robot].enact(setpoints)
        self._torque_limit_nm[robot] = setpoints.torque_limit_nm
        self._last_limit_nm = None
        self._changing.add(robot)

    def advance(self, robots: Sequence[int], ticks: Sequence[int]) -> dict[int, str]:
        """Step the physics of some robots through one control period.

        Args:
            robots: rows of these robots.
            ticks: for every row, number of the control cycle that ends with this step, for messages.

        Returns:
            Why a simulation has diverged, by its row.
        """
        simulations = self._simulations
        if self._changing:
            self._change_limits()
        if simulations.motor_state.shape[1]:  # a limit ends wind-up above it, see `Motors.before_steps`
            state = simulations.motor_state
            np.minimum(state, self._max_torque_nm, out=state)
            np.maximum(state, self._min_torque_nm, out=state)
        diverged = simulations.step(robots, ticks)
        if self._has_heat:
            self._warm_windings()
        return diverged

    def sample(self, ticks: Ticks, active: Mask) -> None:
        """Read the sensors of the active robots at their present ticks."""
        self.sensors.sample(ticks, active, self._simulations, self._heat.winding_c)

    def remaining_fractions(self) -> Floats:
        """Return what derating leaves of each torque limit at the measured winding temperatures, (robots, joints)."""
        assert self.sensors.windings is not None
        return self._heat.remaining_fractions(self.sensors.windings.values)

    def make_joint_state(self, robot: int, tick: int, joints_of_robot: Floats) -> JointState:
        """Return the joint states of one robot as the message that a backend would send.

        Args:
            robot: row of the robot.
            tick: number of the control cycle in which they were delivered.
            joints_of_robot: (3 * joints,) angles in rad, velocities in rad/s and torques in N·m.
        """
        joints = self._joints
        numbers = joints_of_robot.tolist()
        return JointState(
            tick=tick,
            timestamp_ns=tick * self._period_ns,
            angle_rad=numbers[:joints],
            velocity_rad_s=numbers[joints : 2 * joints],
            torque_nm=numbers[2 * joints :],
            valid=[True] * joints,
            age_ns=[min(tick, self.sensors.joint_delay_ticks) * self._period_ns] * joints,
        )

    def make_power(self, robot: int, tick: int) -> Power | None:
        """Return the newest power sample of one robot as a message; None if there is none yet.

        It holds what a limiter reads. Currents and the temperatures of the boards are left out.

        Args:
            robot: row of the robot.
            tick: number of the control cycle in which the sample was delivered.
        """
        windings = self.sensors.windings
        if windings is None or not windings.is_known[robot]:
            return None
        voltage_v, idle_a = self._supplies[robot]
        winding_c = windings.values[robot].tolist()
        return Power(
            tick=tick,
            timestamp_ns=tick * self._period_ns,
            voltage_v=voltage_v,
            current_a=idle_a,
            motor_c=winding_c,
            board_c=winding_c,
            leak=[False] * self._joints,
            valid=[True] * self._joints,
        )

    def _change_limits(self) -> None:
        """Apply lowered limits as fast as the motors can follow."""
        motors = self._simulations.motors
        for robot in self._changing:
            motors[robot].before_steps()
            self._read_motor_range(robot)
        self._changing = {robot for robot in self._changing if motors[robot].limit_is_changing}

    def _warm_windings(self) -> None:
        """Let a period of heat pass, and derate hot joints. The torque of the last step stands for the period."""
        heat = self._heat
        heat.pass_period(self._simulations.torque_nm)
        changed = heat.find_changed()
        if not changed:
            return
        fractions = heat.remaining_fractions(heat.winding_c)
        for robot in changed:
            self._simulations.motors[robot].derate(fractions[robot])
            self._changing.add(robot)

    def _read_motor_range(self, robot: int) -> None:
        """Read the torque range of the motors of one robot from its model."""
        low_nm, high_nm = self._simulations.motors[robot].torque_range_nm
        self._min_torque_nm[robot] = low_nm
        self._max_torque_nm[robot] = high_nm
