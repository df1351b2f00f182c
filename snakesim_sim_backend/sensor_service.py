"""The service `sensor`: cameras and lidars in a process of their own, for a backend that has none, such as CAN.

It publishes at the same keys as the simulator does, from the same models: a recording, or what the robot would see in
the world of the scene file at its present pose and joint angles. A driver of a real camera is such a service, too. The
service's name is the first part of its keys, and in lockstep the clock names its samples by that.
"""

import mujoco
import numpy as np

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import HostClient
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, JointState, Message, Pose, RobotDescription
from snakesim_sim_backend.model.build import FREE_QPOS, build_sim_model, view_joint_states
from snakesim_sim_backend.sensors.registry import make_mounted_reader, make_sensor_rng
from snakesim_sim_backend.sensors.scope import SensorReader, SensorScope
from snakesim_sim_backend.settings import SimSettings


class SensorService(Service):
    """Publishes the samples of cameras and lidars that the robot's HAL does not publish."""

    name = "sensor"

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Build the scene.

        Raises:
            ConfigError: The scene cannot be built.
        """
        self._client = client
        self._config = config
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._pose = client.subscribe(keys.POSE, Pose)
        self._sim = build_sim_model(config, SimSettings(), motors=False)
        self._data = mujoco.MjData(self._sim.model)
        self._readers: list[tuple[str, SensorReader]] = []

    def configure(self, robot: RobotDescription) -> None:
        """Make a reader for each sensor of the robot file that the robot's HAL does not have."""
        published = {sensor.key for sensor in robot.sensors}
        self._readers = []
        for key, sensor in self._config.robot.sensors.iterate_mounted():
            if key not in published:
                scope = SensorScope(
                    self._config, self._sim, self._data, make_sensor_rng(key, self._config.seed)
                )
                self._readers.append((key, make_mounted_reader(key, sensor, scope)))

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Return a sample of each sensor, in every cycle, whatever rate the robot file has.

        None while joint angles or pose are unknown.
        """
        joints = self._client.read(self._joints)
        pose = self._client.read(self._pose)
        if joints is None or pose is None:
            return None
        self._set_state(joints, pose)
        return [
            (key, reader.read(clock.tick, joints.timestamp_ns)) for key, reader in self._readers
        ]

    def _set_state(self, joints: JointState, pose: Pose) -> None:
        """Put the model's robot where the real one is."""
        orientation = np.asarray(pose.orientation_wxyz)
        self._data.qpos[:3] = pose.position_w
        self._data.qpos[3:FREE_QPOS] = orientation / np.linalg.norm(pose.orientation_wxyz)
        angles_rad, _ = view_joint_states(self._data, len(joints.angle_rad))
        angles_rad[:] = joints.angle_rad
        mujoco.mj_kinematics(self._sim.model, self._data)
