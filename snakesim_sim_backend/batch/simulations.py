"""The seam to MuJoCo: the states of many simulations as arrays, and one call that steps all of them for a period."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_native.load import load_shared_library
from snakesim_sim_backend.actuators import INPUTS_PER_MOTOR, ModelMotors
from snakesim_sim_backend.batch.placed import PlacedRobot, view_link_rotations
from snakesim_sim_backend.laws.version import choose_laws
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS
from snakesim_sim_backend.state.divergence import DivergenceWatch

Mask = NDArray[np.bool_]  # (robots,)


def describe_loop_cost() -> str:
    """Return what it costs that simulations are stepped in a loop here; empty if they are not."""
    if choose_laws() == "c":
        return ""
    loaded = load_shared_library(LAWS_LIBRARY)
    return (
        f"many environments are stepped in a loop on one thread, and {LAWS_LIBRARY.python_cost}. "
        f"Reason: {loaded.problem}"
    )


@dataclass(frozen=True)
class ContactArrays:
    """Contacts of links with obstacles, in the order of robots, and of MuJoCo within a robot."""

    robot: NDArray[np.intp]  # (n,), row of the robot
    link: NDArray[np.intp]  # (n,), 0 at the tail
    force_w: Floats  # (n, 3), N, on the link
    rotation: Floats  # (n, 9), world_from_link, row by row


NO_CONTACT_ARRAYS = ContactArrays(
    np.empty(0, np.intp), np.empty(0, np.intp), np.empty((0, 3)), np.empty((0, 9))
)


class SimulationBatch(ABC):
    """Simulations of robots with equal joints, each in a scene of its own.

    Attributes:
        base_pose: (robots, 7), position in m and quaternion wxyz of the tail end.
        base_velocity: (robots, 6), in m/s in the world, and rad/s in the frame of the base.
        angle_rad: (robots, joints).
        velocity_rad_s: (robots, joints).
        torque_nm: (robots, joints), of the motors over the last physics step.
        motor_state: (robots, n), what the motors remember; n is 0 for motors without lag.
        motor_inputs: (robots, 3 * joints), position, velocity and feed-forward torque of each motor.
        motors: The motors of each robot, for what happens seldom: other modes and other limits.
    """

    base_pose: Floats
    base_velocity: Floats
    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats
    motor_state: Floats
    motor_inputs: Floats
    motors: list[ModelMotors]

    @abstractmethod
    def load(self, robot_index: int, placed: PlacedRobot) -> bool:
        """Replace the simulation of a row.

        Args:
            robot_index: Row of the robot.
            placed: New simulation, at the start of an episode.

        Returns:
            False if the arrays of the new simulation have other sizes than those of the other rows. Then nothing is
            changed.
        """

    @abstractmethod
    def step(self, rows: Sequence[int], tick_by_row: Sequence[int]) -> dict[int, str]:
        """Step simulations through one control period.

        Args:
            rows: Rows of the robots to step. The other rows are left alone.
            tick_by_row: Number of the control cycle of every row of the batch, for messages.

        Returns:
            The reason of the divergence by row, for each simulation that has diverged.
        """

    @abstractmethod
    def find_obstacle_contacts(self, robots: Mask) -> ContactArrays:
        """Return the contacts of these robots with obstacles over the last physics step."""


class MotorArrays:
    """The arrays of one robot that its motors read and write, with the names that MjData gives them."""

    def __init__(self, simulations: SimulationBatch, robot_index: int, history: Floats) -> None:
        self.history = history
        self.act = simulations.motor_state[robot_index]
        self.actuator_force = simulations.torque_nm[robot_index]
        self.ctrl = simulations.motor_inputs[robot_index]


NO_MOTORS: ModelMotors = None  # pyright: ignore[reportAssignmentType] - of rows that are not loaded yet


class LoopedSimulations(SimulationBatch):
    """One MuJoCo state for each robot, stepped one after the other.

    For a single robot the arrays are views of MuJoCo's.
    """

    def __init__(self, robot_count: int, joint_count: int) -> None:
        """Allocate the arrays. `load` has to be called for a row before it is stepped.

        Args:
            robot_count: Number of robots, which is the number of rows.
            joint_count: Number of joints of each robot.
        """
        self._joint_count = joint_count
        self._placed_robots: list[PlacedRobot | None] = [None] * robot_count
        self._divergence_watches: list[DivergenceWatch | None] = [None] * robot_count
        self.motors = [NO_MOTORS] * robot_count
        self.base_pose = np.zeros((robot_count, FREE_QPOS))
        self.base_velocity = np.zeros((robot_count, FREE_DOFS))
        self.angle_rad = np.zeros((robot_count, joint_count))
        self.velocity_rad_s = np.zeros((robot_count, joint_count))
        self.torque_nm = np.zeros((robot_count, joint_count))
        self.motor_state = np.zeros((robot_count, 0))
        self.motor_inputs = np.zeros((robot_count, INPUTS_PER_MOTOR * joint_count))

    def load(self, robot_index: int, placed: PlacedRobot) -> bool:
        data = placed.data
        if self.motor_state.shape[1] != len(data.act):
            if any(
                other is not None for i, other in enumerate(self._placed_robots) if i != robot_index
            ):
                return False
            self.motor_state = np.zeros((len(self._placed_robots), len(data.act)))
        self._placed_robots[robot_index] = placed
        self.motors[robot_index] = placed.motors
        self._divergence_watches[robot_index] = DivergenceWatch(
            placed.sim.model, data, placed.physics, placed.sim.steps_per_tick
        )
        if len(self._placed_robots) == 1:
            self._bind_views(data)
            return True
        placed.motors.bind_state(MotorArrays(self, robot_index, data.history))
        self.motor_state[robot_index] = data.act
        self._copy_state(data, robot_index)
        return True

    def step(self, rows: Sequence[int], tick_by_row: Sequence[int]) -> dict[int, str]:
        """Step the physics of some robots through one control period, one after the other.

        Args:
            rows: Rows of the robots to step. The other rows are left alone.
            tick_by_row: Number of the control cycle that ends with this step, of every row of the batch, for messages.

        Returns:
            The reason of the divergence by row, for each simulation that has diverged. The state of such a simulation
            is its last good one.
        """
        divergence_reasons: dict[int, str] = {}
        # The arrays of a single robot are views of MuJoCo's, so that nothing has to be copied to or from its state.
        must_copy = len(self._placed_robots) > 1
        for row in rows:
            tick = tick_by_row[row]
            placed = self._placed_robots[row]
            watch = self._divergence_watches[row]
            assert placed is not None and watch is not None
            if must_copy:
                placed.data.ctrl[: INPUTS_PER_MOTOR * self._joint_count] = self.motor_inputs[row]
                placed.data.act[:] = self.motor_state[row]
            try:
                placed.physics.step(placed.sim.steps_per_tick)
                watch.check(tick)
            except mujoco.FatalError as error:
                divergence_reasons[row] = f"MuJoCo cannot go on at tick {tick}: {error}"
            except BackendError as error:
                divergence_reasons[row] = str(error)
            if must_copy:
                self.motor_state[row] = placed.data.act
                self._copy_state(placed.data, row)
        return divergence_reasons

    def find_obstacle_contacts(self, robots: Mask) -> ContactArrays:
        rows: list[int] = []
        links: list[int] = []
        forces_w: list[list[float]] = []
        rotations: list[Floats] = []
        for robot, placed in enumerate(self._placed_robots):
            if placed is None or not robots[robot]:
                continue
            for number, *force_w in placed.read_obstacle_contacts():
                link = int(number)
                rows.append(robot)
                links.append(link)
                forces_w.append(force_w)
                rotations.append(view_link_rotations(placed)[link].copy())
        if not rows:
            return NO_CONTACT_ARRAYS
        return ContactArrays(
            np.array(rows), np.array(links), np.array(forces_w), np.array(rotations)
        )

    def _copy_state(self, data: mujoco.MjData, robot_index: int) -> None:
        """Copy what a step has changed into the row of a robot."""
        joints = self._joint_count
        self.base_pose[robot_index] = data.qpos[:FREE_QPOS]
        self.base_velocity[robot_index] = data.qvel[:FREE_DOFS]
        self.angle_rad[robot_index] = data.qpos[FREE_QPOS : FREE_QPOS + joints]
        self.velocity_rad_s[robot_index] = data.qvel[FREE_DOFS : FREE_DOFS + joints]
        self.torque_nm[robot_index] = data.actuator_force[:joints]

    def _bind_views(self, data: mujoco.MjData) -> None:
        """Make the arrays of a single robot views of MuJoCo's."""
        joints = self._joint_count
        self.base_pose = data.qpos[None, :FREE_QPOS]
        self.base_velocity = data.qvel[None, :FREE_DOFS]
        self.angle_rad = data.qpos[None, FREE_QPOS : FREE_QPOS + joints]
        self.velocity_rad_s = data.qvel[None, FREE_DOFS : FREE_DOFS + joints]
        self.torque_nm = data.actuator_force[None, :joints]
        self.motor_state = data.act[None, :]
        self.motor_inputs = data.ctrl[None, : INPUTS_PER_MOTOR * joints]
