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
from snakesim_hal.wire.messages import Contacts, Description, LifecycleState, Mode, Pose
from snakesim_sim_backend.batch.sensors import NUMBERS_OF_POSE, NUMBERS_OF_VELOCITY

NAMES_OR_NONE = np.array([name or None for name in LIMIT_NAMES], dtype=object)


class Robots:
    """The robots of environments; each is started on its own, and all are stepped together.

    Attributes:
        joints: (robots, 3 * joints), newest angles, velocities and torques. A new array in each tick.
        is_armed: (robots,), whether the robot obeys commands; False once a fault has stopped it.
        is_limited: (robots, joints), whose target was limited in the last tick. A new array in each tick.
    """

    def __init__(self, robots: int, joints: int, *, assisted: bool, safe: bool, threads: int) -> None:
        """Make room for robots.

        Args:
            robots: their number.
            joints: number of joints of each.
            assisted: whether actions correct the targets of the scenario's controller.
            safe: whether targets pass the limiter.
            threads: number of threads that step the physics.
        """
        self._threads = threads
        self._count = robots
        self._joint_count = joints
        self._assisted = assisted
        self._safe = safe
        self._armed: ArmedRobots | None = None
        self._alone: dict[int, SteppedRobot | AssistedRobot] = {}
        self.joints: Floats = np.zeros((robots, 3 * joints))
        self.is_armed: Mask = np.zeros(robots, dtype=np.bool_)
        self.is_limited: Masks = np.zeros((robots, joints), dtype=np.bool_)

    def start(self, robot: int, config: RunConfig, description: Description) -> None:
        """Put an armed robot in a row.

        Args:
            robot: the row.
            config: configuration of its episode.
            description: the robot of that configuration.

        Raises:
            ConfigError: the settings do not match the robot or the scene.
            RefusedError: the robot cannot be armed.
        """
        self.stop(robot)
        if self._assisted:
            self._alone[robot] = AssistedRobot(config)
        elif not self._start_together(robot, config, description):
            self._alone[robot] = SteppedRobot(config, safe=self._safe)
        self._collect()

    def stop(self, robot: int) -> None:
        """Release the robot of a row."""
        alone = self._alone.pop(robot, None)
        if alone is not None:
            alone.close()
        if self._armed is not None:
            self._armed.stop(robot)

    def step(self, mode: Mode, target: Floats, active: Mask) -> None:
        """Run one tick.

        Args:
            mode: mode of all joints.
            target: (robots, joints), in the unit of the mode. It must not change afterwards.
            active: (robots,), which robots take part; they must be armed.
        """
        together = active
        if self._alone:
            together = active.copy()
            together[list(self._alone)] = False
        if self._armed is not None and np.count_nonzero(together):
            self._armed.step(mode, target, together)
        for robot, alone in self._alone.items():
            if active[robot]:
                alone.step(mode, target[robot].tolist())
        self._collect()

    # --- what one robot reports ------------------------------------------------------------------------------

    def read_lifecycle(self, robot: int) -> LifecycleState:
        """Return the lifecycle state, as a host would publish it."""
        if robot in self._alone:
            return self._alone[robot].lifecycle
        return "armed" if self.is_armed[robot] else "fault"

    def read_reason(self, robot: int) -> str:
        """Return why a robot is in its state."""
        if robot in self._alone:
            return self._alone[robot].reason
        assert self._armed is not None
        return self._armed.reasons[robot]

    def read_digest(self, robot: int) -> str:
        """Return the digest of all setpoints, as the `command_digest` of a run."""
        if robot in self._alone:
            return self._alone[robot].digest
        assert self._armed is not None
        return self._armed.read_digest(robot)

    def read_limit_names(self) -> NDArray[Any]:
        """Return which limit changed each target in the last tick, (robots, joints) of names; None: none did."""
        names = np.full((self._count, self._joint_count), None, dtype=object)
        if self._armed is not None and np.count_nonzero(self.is_limited):
            names = NAMES_OR_NONE[self._armed.read_active_limits()]
        for robot, alone in self._alone.items():
            names[robot] = [alone.limited.get(joint) for joint in range(self._joint_count)]
        return names

    # --- what the sensors besides the joints measure -----------------------------------------------------------

    def read_poses(self) -> tuple[Mask, Floats]:
        """Return which robots have a pose, and the positions and quaternions, (robots, 7)."""
        if self._armed is None:
            is_known = np.zeros(self._count, dtype=np.bool_)
            poses = np.zeros((self._count, NUMBERS_OF_POSE))
        else:
            sensors = self._armed.simulated.sensors
            is_known = sensors.has_poses
            poses = sensors.read_poses()
        if self._alone:
            is_known = is_known.copy()
        for robot, alone in self._alone.items():
            pose = alone.newest.get(keys.POSE)
            is_known[robot] = isinstance(pose, Pose)
            if isinstance(pose, Pose):
                poses[robot] = [*pose.position_w, *pose.orientation_wxyz]
        return is_known, poses

    def read_velocities(self) -> Floats:
        """Return linear and angular velocities in the world, (robots, 6); zeros for robots without a pose."""
        velocities = np.zeros((self._count, NUMBERS_OF_VELOCITY))
        if self._armed is not None:
            sensors = self._armed.simulated.sensors
            velocities = np.where(sensors.has_poses[:, None], sensors.read_velocities(), 0.0)
        for robot, alone in self._alone.items():
            pose = alone.newest.get(keys.POSE)
            velocities[robot] = 0.0
            if isinstance(pose, Pose):
                velocities[robot] = [*pose.velocity_w, *pose.angular_velocity_w]
        return velocities

    def read_contact_forces(self) -> Floats:
        """Return the sum of the sizes of all contact forces on every link, (robots, links) in N."""
        if self._armed is None:
            forces_n = np.zeros((self._count, self._joint_count + 1))
        else:
            forces_n = self._armed.simulated.sensors.read_contact_forces()
        for robot, alone in self._alone.items():
            sample = alone.newest.get(keys.CONTACTS)
            contacts = sample if isinstance(sample, Contacts) else None
            forces_n[robot] = sum_contact_forces_n(contacts, self._joint_count + 1)
        return forces_n

    # --- rows ------------------------------------------------------------------------------------------------

    def _start_together(self, robot: int, config: RunConfig, description: Description) -> bool:
        """Start a robot among those that are stepped together. Returns False if it does not fit to them."""
        if not can_arm(config):
            return False
        if self._armed is None:
            self._armed = ArmedRobots(self._count, config, description, safe=self._safe, threads=self._threads)
        return self._armed.can_start(config) and self._armed.start(robot, config, description)

    def _collect(self) -> None:
        """Make the arrays of all robots."""
        if self._armed is not None:
            self.joints = self._armed.joints
            self.is_armed = self._armed.is_armed
            self.is_limited = self._armed.is_limited
        if not self._alone:
            return
        self.joints = self.joints.copy()
        self.is_armed = self.is_armed.copy()
        self.is_limited = self.is_limited.copy()
        for robot, alone in self._alone.items():
            joints = alone.joints
            self.joints[robot] = [*joints.angle_rad, *joints.velocity_rad_s, *joints.torque_nm]
            self.is_armed[robot] = alone.lifecycle == "armed"
            self.is_limited[robot] = [joint in alone.limited for joint in range(self._joint_count)]
