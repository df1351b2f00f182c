"""The robots of many environments, as rows of arrays, whatever steps them.

Simulated robots are stepped together (`armed`). A robot that does not fit to the others is stepped alone: one on
another backend, with injected faults, with other rates, or under a controller whose targets are corrected.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim.environments.armed import ArmedRobots, Mask, can_arm
from snakesim.environments.array_limiter import LIMIT_NAMES, Masks
from snakesim.environments.assisted import AssistedRobot
from snakesim.environments.stepped import SteppedRobot
from snakesim_gnc.control.observations import sum_contact_forces_n
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, JointMode, LifecycleState, Pose, RobotDescription
from snakesim_sim_backend.batch.sensors import NUMBERS_OF_POSE, NUMBERS_OF_VELOCITY

NAMES_OR_NONE = np.array([name or None for name in LIMIT_NAMES], dtype=object)


class EnvironmentRobots:
    """The robots of environments; each is started on its own, and all are stepped together.

    Attributes:
        joints: Newest angles, velocities and torques of all robots, (robots, 3 * joints). A new array in each tick.
        is_armed: Whether each robot follows commands, (robots,). False once a fault has stopped the robot.
        is_limited: Whether the target of each joint was limited in the last tick, (robots, joints). The array never
            changes afterwards.
    """

    def __init__(
        self, robot_count: int, joint_count: int, *, assisted: bool, safe: bool, thread_count: int
    ) -> None:
        """Allocate the arrays for a number of robots. `start` puts a robot into a row at the start of its episode.

        Args:
            robot_count: Number of robots.
            joint_count: Number of joints of each robot.
            assisted: Whether actions are residuals, which are added to the targets of the scenario's controller.
            safe: If True, targets pass the limiter. If False, the motors get the targets unchanged.
            thread_count: Number of threads that step the physics.
        """
        self._threads = thread_count
        self._robot_count = robot_count
        self._joint_count = joint_count
        self._has_residual_actions = assisted
        self._uses_limiter = safe
        # Robots that are stepped together; None until the first of them starts. All others are stepped on their own.
        self._batch: ArmedRobots | None = None
        self._single_robot_by_row: dict[int, SteppedRobot | AssistedRobot] = {}
        # Angles, velocities, torques.
        self.joints: Floats = np.zeros((robot_count, 3 * joint_count))
        self.is_armed: Mask = np.zeros(robot_count, dtype=np.bool_)
        self.is_limited: Masks = np.zeros((robot_count, joint_count), dtype=np.bool_)

    def start(self, row: int, config: RunConfig, description: RobotDescription) -> None:
        """Start an episode: stop the robot in a row of the arrays, and replace it by a new robot that obeys commands.

        The robot is stepped together with the others if it has the same joints, sensors, rates and model; otherwise it
        is stepped on its own.

        Args:
            row: Row of the robot in all arrays.
            config: Configuration of the episode.
            description: Description of the robot of that configuration.

        Raises:
            ConfigError: The settings do not match the robot or the scene.
            RefusedError: The robot cannot be armed.
        """
        self.stop(row)
        if self._has_residual_actions:
            self._single_robot_by_row[row] = AssistedRobot(config)
        elif not self._start_in_batch(row, config, description):
            self._single_robot_by_row[row] = SteppedRobot(config, safe=self._uses_limiter)
        self._update_arrays()

    def stop(self, row: int) -> None:
        """Stop the robot of a row, which takes part in no tick until the next `start`."""
        single_robot = self._single_robot_by_row.pop(row, None)
        if single_robot is not None:
            single_robot.close()
        if self._batch is not None:
            self._batch.stop(row)

    def step(self, mode: JointMode, target: Floats, active: Mask) -> None:
        """Run one tick of some robots, and update the arrays.

        Args:
            mode: Control mode of all joints.
            target: Targets of all joints, (robots, joints), in the unit of the mode. The array must not change
                afterwards.
            active: Which robots take part, (robots,). They must be armed.
        """
        is_in_batch = active
        if self._single_robot_by_row:
            is_in_batch = active.copy()
            is_in_batch[list(self._single_robot_by_row)] = False
        if self._batch is not None and np.count_nonzero(is_in_batch):
            self._batch.step(mode, target, is_in_batch)
        for robot, single_robot in self._single_robot_by_row.items():
            if active[robot]:
                single_robot.step(mode, target[robot].tolist())
        self._update_arrays()

    # --- what one robot reports ------------------------------------------------------------------------------

    def read_lifecycle(self, robot_index: int) -> LifecycleState:
        """Return the lifecycle state, as a host would publish it."""
        if robot_index in self._single_robot_by_row:
            return self._single_robot_by_row[robot_index].lifecycle
        return "armed" if self.is_armed[robot_index] else "fault"

    def read_reason(self, robot_index: int) -> str:
        """Return why a robot is in its state."""
        if robot_index in self._single_robot_by_row:
            return self._single_robot_by_row[robot_index].reason
        assert self._batch is not None
        return self._batch.reasons[robot_index]

    def read_digest(self, robot_index: int) -> str:
        """Return the digest of all setpoints, as the `command_digest` of a run."""
        if robot_index in self._single_robot_by_row:
            return self._single_robot_by_row[robot_index].digest
        assert self._batch is not None
        return self._batch.read_digest(robot_index)

    def read_limit_names(self) -> NDArray[Any]:
        """Return which limit changed each target in the last tick, (robots, joints) of names; None: none did."""
        names = np.full((self._robot_count, self._joint_count), None, dtype=object)
        if self._batch is not None and np.count_nonzero(self.is_limited):
            names = NAMES_OR_NONE[self._batch.read_active_limits()]
        for robot, single_robot in self._single_robot_by_row.items():
            names[robot] = [
                single_robot.limit_by_joint.get(joint) for joint in range(self._joint_count)
            ]
        return names

    # --- what the sensors besides the joints measure -----------------------------------------------------------

    def read_poses(self) -> tuple[Mask, Floats]:
        """Return which robots have a pose, and the positions and quaternions, (robots, 7)."""
        if self._batch is None:
            is_known = np.zeros(self._robot_count, dtype=np.bool_)
            poses = np.zeros((self._robot_count, NUMBERS_OF_POSE))
        else:
            sensors = self._batch.simulation.sensors
            is_known = sensors.has_poses
            poses = sensors.read_poses()
        if self._single_robot_by_row:
            is_known = is_known.copy()
        for robot, single_robot in self._single_robot_by_row.items():
            pose = single_robot.newest_samples.get(keys.POSE)
            is_known[robot] = isinstance(pose, Pose)
            if isinstance(pose, Pose):
                poses[robot] = [*pose.position_w, *pose.orientation_wxyz]
        return is_known, poses

    def read_velocities(self) -> Floats:
        """Return linear and angular velocities in the world, (robots, 6); zeros for robots without a pose."""
        velocities = np.zeros((self._robot_count, NUMBERS_OF_VELOCITY))
        if self._batch is not None:
            sensors = self._batch.simulation.sensors
            velocities = np.where(sensors.has_poses[:, None], sensors.read_velocities(), 0.0)
        for robot, single_robot in self._single_robot_by_row.items():
            pose = single_robot.newest_samples.get(keys.POSE)
            velocities[robot] = 0.0
            if isinstance(pose, Pose):
                velocities[robot] = [*pose.velocity_w, *pose.angular_velocity_w]
        return velocities

    def read_contact_forces(self) -> Floats:
        """Return the sum of the sizes of all contact forces on every link, (robots, links) in N."""
        if self._batch is None:
            forces_n = np.zeros((self._robot_count, self._joint_count + 1))
        else:
            forces_n = self._batch.simulation.sensors.read_contact_forces()
        for robot, single_robot in self._single_robot_by_row.items():
            sample = single_robot.newest_samples.get(keys.CONTACTS)
            contacts = sample if isinstance(sample, Contacts) else None
            forces_n[robot] = sum_contact_forces_n(contacts, self._joint_count + 1)
        return forces_n

    # --- rows ------------------------------------------------------------------------------------------------

    def _start_in_batch(
        self, robot_index: int, config: RunConfig, description: RobotDescription
    ) -> bool:
        """Start a robot among those that are stepped together. Return False if it cannot be stepped with them."""
        if not can_arm(config):
            return False
        if self._batch is None:
            self._batch = ArmedRobots(
                self._robot_count,
                config,
                description,
                safe=self._uses_limiter,
                thread_count=self._threads,
            )
        return self._batch.can_start(config) and self._batch.start(robot_index, config, description)

    def _update_arrays(self) -> None:
        """Copy the newest values of all robots into `joints`, `is_armed` and `is_limited`."""
        if self._batch is not None:
            self.joints = self._batch.joints
            self.is_armed = self._batch.is_armed
            self.is_limited = self._batch.is_limited
        if not self._single_robot_by_row:
            return
        self.joints = self.joints.copy()
        self.is_armed = self.is_armed.copy()
        self.is_limited = self.is_limited.copy()
        for robot, single_robot in self._single_robot_by_row.items():
            joints = single_robot.joints
            self.joints[robot] = [*joints.angle_rad, *joints.velocity_rad_s, *joints.torque_nm]
            self.is_armed[robot] = single_robot.lifecycle == "armed"
            self.is_limited[robot] = [
                joint in single_robot.limit_by_joint for joint in range(self._joint_count)
            ]
