"""The service `sensor`: cameras and lidars in a process of their own, for a backend that has none, such as CAN.

It publishes at the same keys as the simulator does, from the same models: what the robot would see if it stood in the
scene file's world where its joints and its pose say, or a recording. A real camera's driver is such a service, too: the
name is the first part of its keys, and in lockstep the clock names its samples by that.
"""

import mujoco
import numpy as np

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Client
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Description, JointState, Message, Pose
from snakesim_sim_backend.model import FREE_QPOS, build, of_joints
from snakesim_sim_backend.sensors.registry import mounted_reader, own_noise
from snakesim_sim_backend.sensors.scope import Reader, Scope
from snakesim_sim_backend.settings import SimSettings


class SensorService(Service):
    """What looks around."""

    name = "sensor"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Raises ConfigError for a sensor that cannot be made."""
        self._client, self._config = client, config
        self._joints, self._pose = client.subscribe(keys.JOINTS, JointState), client.subscribe(keys.POSE, Pose)
        self._sim = build(config, SimSettings(), motors=False)
        self._data = mujoco.MjData(self._sim.model)
        self._readers: list[tuple[str, Reader]] = []

    def configure(self, robot: Description) -> None:
        """Look with the sensors of the robot file that its HAL does not have."""
        config, listed = self._config, {sensor.key for sensor in robot.sensors}
        self._readers = [
            (key, mounted_reader(key, sensor, Scope(config, self._sim, self._data, own_noise(key, config.seed))))
            for key, sensor in config.robot.sensors.mounted()
            if key not in listed
        ]

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """A sample of each, at every turn, whatever rate the robot file says; None while joints or pose are unknown."""
        joints, pose = self._client.read(self._joints), self._client.read(self._pose)
        if joints is None or pose is None:
            return None
        self._data.qpos[:3] = pose.position_w
        self._data.qpos[3:FREE_QPOS] = np.asarray(pose.orientation_wxyz) / np.linalg.norm(pose.orientation_wxyz)
        of_joints(self._data, len(joints.angle_rad))[0][:] = joints.angle_rad
        mujoco.mj_kinematics(self._sim.model, self._data)
        return [(key, reader.read(clock.tick, joints.timestamp_ns)) for key, reader in self._readers]
